"""What the physics misses: laws that innovations follow, looked for after inference.

At the best draw of a block the extended filter gives gains, the path and innovations.
A law that the model lacks is an additional wrench in each step, and what a unit of its
coefficient would do to the innovations is found by filtering again, gains fixed, with
that wrench added: the filter carries a push in one step on to the next as it carries
everything else, and joints and friction answer it as they answer any push. (The wrench
is evaluated along the path found without the law, which is exact to first order.) The
rest is a linear regression, `residual_regression`.

With laws in the tens a check costs as much as some hundred likelihoods, and compiles
nothing that sampling has not compiled, but where commands have a delay.
"""

from typing import Any, NamedTuple

import jax
import numpy as np

from boomdp_jax.inference.doubts.residual_laws import LAWS, Law, Path
from boomdp_jax.inference.doubts.residual_regression import (
    LawFit,
    absorb,
    fit_law,
    white_by_body,
)
from boomdp_jax.inference.doubts.residual_spread import SpreadGrowth, spread_growth
from boomdp_jax.inference.doubts.step_doubts import Linearised, StepError, step_error
from boomdp_jax.inference.doubts.uneven_clock import ClockError, clock_error
from boomdp_jax.inference.fits.fit import Host
from boomdp_jax.inference.hypotheses.body_numbers import get_number
from boomdp_jax.inference.hypotheses.decode import decode
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.evaluate import pushed_innovations
from boomdp_jax.inference.likelihoods.filter_points import filter_points
from boomdp_jax.inference.likelihoods.kalman import Filtered
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.readings.track_data import TrackData
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.physics.actuator import delayed

FEWEST_ROWS = 12
"""Steps below which nothing is looked for."""

_GROUPS = ((0, 1), (2,), (3, 4), (5,))
_GROUP = np.array([0, 0, 1, 2, 2, 3])
# Differences are taken over so much: first pushes as a share of the motion's noise, and
# moves in prior sds; then what changes all innovations together by so much, so that
# rounding in single precision does not tell, nor curvature.
_FIRST_PUSH, _FIRST_MOVE = 0.3, 1e-2
_PUSH_CHANGE, _MOVE_CHANGE = 3.0, 0.3
_MOVES = (1e-3, 3e-2)
# Least noise of the motion that the first push is measured by, as a share of readings'.
_LEAST_NOISE = 0.01
_POINTS = 16


class BodyLaw(NamedTuple):
    """A law of one body and what speaks for it."""

    body: int
    """Place in the block."""
    law: Law
    fit: LawFit


class ResidualCheck(NamedTuple):
    """What was found in one block."""

    num_rows: int
    """Steps with readings."""
    laws: list[BodyLaw]
    """Best first; none where readings were too few, or where the filter failed."""
    whiteness: list[dict[str, float]]
    """Of each body, p-value by channel group."""
    growth: tuple[SpreadGrowth | None, ...] = ()
    """Of each body, whether its readings err more the faster it moves."""
    correlation: tuple[dict[str, float], ...] = ()
    """Of each body, of innovations one after the other, by the same groups."""
    step: StepError | None = None
    """What finer steps would change; None: it was not asked."""
    clock: ClockError | None = None
    """How much steps vary in length; None: it was not asked."""


def check_residuals(targets: StructureTarget, draws: BlockDraws) -> list[ResidualCheck]:
    """Look for laws that a batch of equal blocks lacks.

    Args:
        targets: stacked along a leading object axis.
        draws: of each object.

    Returns:
        One check per object.
    """
    likelihood: Any = targets.log_likelihood
    seen = np.asarray(likelihood.data.last_mask).any(axis=(2, 3))
    checks = [ResidualCheck(int(num), [], []) for num in seen.sum(axis=1)]
    asked = np.flatnonzero(seen.sum(axis=1) >= FEWEST_ROWS)
    if not asked.size or draws.impulse_scale is None:
        return checks
    log_density = np.where(np.isfinite(draws.log_density), draws.log_density, -np.inf)
    best = np.argmax(log_density[asked], axis=1)
    structure = draws.structure[asked, best].astype(int)
    z = draws.z[asked, best].astype(float)
    noise = NoiseFit(
        draws.noise_scale[asked, best].astype(float),
        draws.impulse_scale[asked, best].astype(float),
    )
    filtered = filter_points(targets, asked, structure, z, noise)
    for place, index in enumerate(asked):
        checks[index] = _Block(
            targets,
            int(index),
            int(structure[place]),
            z[place],
            noise.take(np.array([place])),
            jax.tree.map(lambda leaf, place=place: leaf[place], filtered),
            _like_best(draws, int(index), int(best[place])),
        ).check()
    return checks


def _like_best(draws: BlockDraws, index: int, best: int) -> np.ndarray:
    """Coordinates of the best draw, and of all of its structure."""
    structure = np.asarray(draws.structure)[index]
    z = np.asarray(draws.z, float)[index]
    return np.concatenate([z[[best]], z[structure == structure[best]]])


class _Block:
    """One object of a batch at its best draw."""

    def __init__(
        self,
        targets: StructureTarget,
        index: int,
        structure: int,
        z: np.ndarray,
        noise: NoiseFit,
        filtered: Filtered,
        others: np.ndarray,
    ):
        self._targets, self._index, self._structure = targets, index, structure
        self._z, self._noise, self._filtered = z, noise, filtered
        self._others = others
        likelihood: Any = targets.log_likelihood
        known = (likelihood.coordinates, likelihood.data)
        coordinates, data = jax.tree.map(lambda leaf: np.asarray(leaf)[index], known)
        active = np.asarray(targets.structures)[index, structure]
        params = decode(
            coordinates, z[None].astype(targets.log_prior.dtype), active[None]
        )
        first = jax.tree.map(lambda leaf: leaf[0], params)
        self._data: TrackData = data
        steps = data.steps
        late = steps.commands is not None
        command = delayed(first, steps.commands) if late else steps.action
        self._command = np.asarray(command, float)
        gain, bias = (get_number(first, f"actuator.{x}") for x in ("gain", "bias"))
        num_bodies = self._command.shape[1]
        self._gain = np.ones(num_bodies) if gain is None else np.asarray(gain, float)
        self._wrench = self._gain[:, None] * self._command
        if bias is not None:
            self._wrench = self._wrench + np.asarray(bias, float)
        scene = coordinates.scene
        mass = np.asarray(first.density, float) * np.asarray(scene.area, float)
        gyration = np.asarray(scene.gyration, float)
        inertia, self._radius = mass * gyration, np.sqrt(gyration)
        self._inertia = np.stack([mass, mass, inertia], axis=-1)
        self._dt = np.broadcast_to(np.asarray(steps.dt, float), len(self._command))
        host = Host.of(targets)
        self._used = np.flatnonzero(host.in_use[structure])
        self._is_normal = host.is_normal[self._used]

    def check(self) -> ResidualCheck:
        """Regress innovations on every law of every body."""
        counts = self._counts()
        rows = np.flatnonzero(counts[:, 1].any(axis=(1, 2)))
        base = self._innovations(self._z[None, None])[0, 0]
        if not np.all(np.isfinite(base)):
            return ResidualCheck(len(rows), [], [])
        before, after = self._states(base)
        paths = self._paths(0.5 * (before + after))
        pushes = [
            (body, law, np.stack(law.wrench(path)))
            for body, path in enumerate(paths)
            for law in LAWS
        ]
        scale = _group_scale(base, counts)
        moves = self._by_moves(base, scale)
        wrenches = [(body, push) for body, _, each in pushes for push in each]
        answers = self._by_pushes(base, scale, wrenches)

        def flat(values: np.ndarray) -> np.ndarray:
            return values[..., rows, :, :, :].reshape(*values.shape[:-4], len(rows), -1)

        known = absorb(
            flat(base / scale), flat(moves), self._z[self._used], self._is_normal
        )
        found, begin = [], 0
        for body, law, each in pushes:
            columns = answers[begin : begin + len(each)]
            begin += len(each)
            fit = fit_law(known, flat(columns))
            if fit is not None:
                found.append(BodyLaw(body, law, fit))
        found.sort(key=lambda one: -one.fit.log_bayes_factor)
        growth = self._growth(base, counts, paths)
        track = np.cumsum(np.asarray(self._data.is_start) > 0)
        white, correlated = white_by_body(base[:, 1], counts[:, 1], track)
        place = (self._targets, self._index, self._structure, self._z, self._filtered)
        known_moves = (self._used, self._is_normal, base / scale, moves, scale)
        best = Linearised(*place, self._command, *known_moves)
        step = step_error(best, self._others)
        clock = self._clock(base, before, after)
        return ResidualCheck(len(rows), found, white, growth, correlated, step, clock)

    def _counts(self) -> np.ndarray:
        counts = self._filtered.gains.counts
        return np.asarray(counts).reshape(len(self._command), 2, -1, 6)

    def _innovations(
        self, z: np.ndarray, extra: np.ndarray | None = None
    ) -> np.ndarray:
        """Whitened, of lists of points, each list with further commands.

        Args:
            z: coordinates, `[list, point, dim]`.
            extra: commands, `[list, time, body, 3]`; None: none.
        """
        action = np.broadcast_to(self._command, (len(z), *self._command.shape))
        if extra is not None:
            action = action + extra
        gains = jax.tree.map(
            lambda leaf: np.broadcast_to(leaf, (len(z), *leaf.shape)),
            self._filtered.gains,
        )
        return pushed_innovations(
            self._targets,
            np.full(len(z), self._index),
            np.full(len(z), self._structure),
            gains,
            action,
            z,
        )

    def _states(self, innovation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """At both ends of each step, by what is known before its end is read.

        What is read there must not enter what it is regressed on.
        """
        gains = self._filtered.gains
        shape = (len(self._command), -1, 6)

        def moved(gain, whitening, error) -> np.ndarray:
            """By how much a reading moves the estimate."""
            seen = np.diagonal(whitening, axis1=1, axis2=2) > 0
            root = whitening + np.eye(seen.shape[1]) * ~seen[:, None]
            miss = np.linalg.solve(root, error.reshape(len(error), -1, 1))
            return (gain @ miss)[..., 0].reshape(shape)

        parts = jax.tree.map(lambda leaf: np.asarray(leaf, float), gains)
        before = np.asarray(self._filtered.starts, float)
        before = before + moved(parts.first, parts.first_whitening, innovation[:, 0])
        after = np.asarray(self._filtered.after.mean, float)
        after = after - moved(parts.last, parts.last_whitening, innovation[:, 1])
        return before, after

    def _clock(
        self, innovation: np.ndarray, before: np.ndarray, after: np.ndarray
    ) -> ClockError | None:
        """Whether rows last as long as told; not asked where bodies may collide."""
        likelihood: Any = self._targets.log_likelihood
        if likelihood.coordinates.contact is not None:
            return None
        rate = (after - before) / self._dt[:, None, None]
        rate[..., :3] = 0.5 * (before + after)[..., 3:]
        flat = (len(rate), -1)
        whitening = np.asarray(self._filtered.gains.last_whitening, float)
        rate = (whitening @ rate.reshape(flat)[..., None])[..., 0]
        return clock_error(innovation[:, 1].reshape(flat), rate, self._dt)

    def _paths(self, middle: np.ndarray) -> list[Path]:
        """Path of each body, by states half-way through each step."""
        shape = middle.reshape(len(middle), -1, 6).shape
        variance = np.diagonal(self._filtered.after.covariance, axis1=1, axis2=2)
        spread = np.sqrt(np.asarray(variance, float)).reshape(shape)
        change = np.diff(self._wrench, axis=0, prepend=self._wrench[:1])
        change[np.asarray(self._data.is_start) > 0] = 0.0
        ahead = np.roll(change, -1, axis=0) / self._dt[:, None, None]
        change = change / self._dt[:, None, None]
        length = np.where(np.asarray(self._data.is_used) > 0, self._dt, 0.0)
        progress = (np.cumsum(length) - 0.5 * length) / np.sum(length) - 0.5
        edges = _from_edges(np.asarray(self._data.is_start) > 0)
        paths = []
        for body in range(middle.shape[1]):
            own = spread[:, body]
            both = np.column_stack([np.hypot(own[:, 3], own[:, 4]), own[:, 5]])
            place = middle[:, body]
            applied = (self._wrench[:, body], change[:, body], ahead[:, body])
            rest = (both, progress, *edges)
            paths.append(Path(place[:, :3], place[:, 3:], *applied, *rest))
        return paths

    def _by_moves(self, base: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Derivative by coordinates in use, `[coordinate, time, 2, body, 6]`."""
        num = len(self._used)

        def change(step: np.ndarray) -> np.ndarray:
            moved = np.tile(self._z, (num, 1))
            moved[np.arange(num), self._used] += step
            moved = np.pad(moved, ((0, -num % _POINTS), (0, 0)), mode="edge")
            found = self._innovations(moved.reshape(-1, _POINTS, len(self._z)))
            found = found.reshape(-1, *base.shape)[:num]
            return (found - base) / scale

        if not num:
            return np.zeros((0, *base.shape))
        step = np.full(num, _FIRST_MOVE)
        slope = _length(change(step)) / step
        step = np.clip(_MOVE_CHANGE / np.maximum(slope, 1e-9), *_MOVES)
        return np.nan_to_num(change(step) / step[:, None, None, None, None])

    def _by_pushes(
        self, base: np.ndarray, scale: np.ndarray, wrenches: list
    ) -> np.ndarray:
        """The same by pushes of bodies, `[push, time, 2, body, 6]`."""
        noise = np.maximum(
            self._noise.impulse[0], _LEAST_NOISE * self._noise.reading[0][:, 2:]
        )[:, [0, 0, 1]]
        unit, extra = [], []
        for body, push in wrenches:
            kick = push * self._dt[:, None] / self._inertia[body] / noise[body]
            size = np.sqrt(np.mean(np.sum(kick**2, axis=1)))
            unit.append(_FIRST_PUSH / size if size > 0 else 0.0)
            whole = np.zeros_like(self._command)
            whole[:, body] = push / self._gain[body]
            extra.append(whole)
        unit, extra = np.array(unit), np.stack(extra)

        def change(step: np.ndarray) -> np.ndarray:
            z = np.tile(self._z, (len(step), 1, 1))
            found = self._innovations(z, step[:, None, None, None] * extra)[:, 0]
            return (found - base) / scale

        slope = _length(change(unit)) / np.where(unit > 0, unit, 1.0)
        step = np.where(slope > 0, _PUSH_CHANGE / np.where(slope > 0, slope, 1.0), unit)
        step = np.clip(step, 1e-3 * unit, 1e3 * unit)
        safe = np.where(step > 0, step, 1.0)
        return change(step) / safe[:, None, None, None, None]

    def _growth(
        self, base: np.ndarray, counts: np.ndarray, paths: list[Path]
    ) -> tuple[SpreadGrowth | None, ...]:
        return tuple(
            spread_growth(
                base[:, 1, body], counts[:, 1, body], path.twist, self._radius[body]
            )
            for body, path in enumerate(paths)
        )


def _from_edges(is_start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the same run before each step, and after it, `[time]`."""
    row = np.arange(len(is_start))
    begin = np.maximum.accumulate(np.where(is_start, row, 0))
    last = np.where(np.append(is_start[1:], True), row, len(row))
    return row - begin, np.minimum.accumulate(last[::-1])[::-1] - row


def _length(change: np.ndarray) -> np.ndarray:
    """Root of the sum of squares of each."""
    return np.sqrt(np.sum(change**2, axis=(1, 2, 3, 4)))


def _group_scale(innovation: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """How much larger innovations of a channel group are than they should be, or one.

    The draw's noise is one of many; where it is low, that would be evidence for
    anything.
    """
    square = np.sum(innovation**2, axis=(0, 1))
    num = np.sum(counts, axis=(0, 1))
    out = np.ones_like(square)
    for group in _GROUPS:
        channels = list(group)
        each = square[:, channels].sum(axis=1) / np.maximum(
            num[:, channels].sum(axis=1), 1.0
        )
        out[:, channels] = np.sqrt(np.maximum(each, 1.0))[:, None]
    return out
