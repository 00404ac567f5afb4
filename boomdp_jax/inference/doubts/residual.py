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

from boomdp_jax.inference.doubts.corrections import (
    Persistence,
    moved_by_readings,
    persistence_by_body,
)
from boomdp_jax.inference.doubts.less_noise import (
    NUM_RIVALS,
    group_scale,
    is_worth_asking,
    weighed_again,
)
from boomdp_jax.inference.doubts.residual_laws import LAWS, Law, Path
from boomdp_jax.inference.doubts.residual_regression import (
    LawFit,
    absorb,
    fit_law,
    white_by_body,
)
from boomdp_jax.inference.doubts.residual_spread import SpreadGrowth, spread_growth
from boomdp_jax.inference.doubts.responses import Responses
from boomdp_jax.inference.doubts.step_doubts import Linearised, StepError, step_error
from boomdp_jax.inference.doubts.uneven_clock import ClockError, clock_error
from boomdp_jax.inference.fits.fit import Host
from boomdp_jax.inference.hypotheses.body_numbers import get_number
from boomdp_jax.inference.hypotheses.decode import decode
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.filter_points import filter_points
from boomdp_jax.inference.likelihoods.kalman import Filtered
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.readings.track_data import TrackData
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.physics.actuator import delayed

FEWEST_ROWS = 12
"""Steps below which nothing is looked for."""


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
    persistence: tuple[dict[str, Persistence], ...] = ()
    """Of each body, by channel group of the twist, how corrections of it add up."""
    by_chance: tuple[float, ...] = ()
    """Of each body, changes of velocity by noise of the motion per those that what
    pushes it would make alone; zero where nothing pushes it."""


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
        self._responses = Responses(
            targets,
            index,
            structure,
            z,
            self._used,
            noise,
            filtered,
            self._command,
            self._gain,
            self._inertia,
            self._dt,
        )

    def check(self) -> ResidualCheck:
        """Regress innovations on every law of every body."""
        counts = self._responses.counts
        rows = np.flatnonzero(counts[:, 1].any(axis=(1, 2)))
        base = self._responses.innovations(self._z[None, None])[0, 0]
        if not np.all(np.isfinite(base)):
            return ResidualCheck(len(rows), [], [])
        first, last = moved_by_readings(self._filtered.gains, base)
        before, after = self._states(first, last)
        paths = self._paths(0.5 * (before + after))
        pushes = [
            (body, law, np.stack(law.wrench(path)))
            for body, path in enumerate(paths)
            for law in LAWS
        ]
        scale = group_scale(base, counts)
        moves = self._responses.by_moves(base, scale)
        wrenches = [(body, push) for body, _, each in pushes for push in each]
        answers = self._responses.by_pushes(base, scale, wrenches)

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
        found = self._with_less_noise(found, paths, rows)
        found.sort(key=lambda one: -one.fit.log_bayes_factor)
        growth = self._growth(base, counts, paths)
        track = np.cumsum(np.asarray(self._data.is_start) > 0)
        white, correlated = white_by_body(base[:, 1], counts[:, 1], track)
        place = (self._targets, self._index, self._structure, self._z, self._filtered)
        known_moves = (self._used, self._is_normal, base / scale, moves, scale)
        best = Linearised(*place, self._command, *known_moves)
        step = step_error(best, self._others)
        clock = self._clock(base, before, after)
        going_on = persistence_by_body(first, last, track)
        return ResidualCheck(
            len(rows),
            found,
            white,
            growth,
            correlated,
            step,
            clock,
            going_on,
            self._by_chance(rows),
        )

    def _by_chance(self, rows: np.ndarray) -> tuple[float, ...]:
        kick = self._wrench[rows, :, :2] * self._dt[rows, None, None]
        kick = np.sqrt(np.mean(np.sum(kick**2, axis=2), axis=0))
        noise = np.sqrt(2.0) * self._noise.impulse[0, :, 0] * self._inertia[:, 0]
        share = np.where(kick > 0.0, noise / np.where(kick > 0.0, kick, 1.0), 0.0)
        return tuple(float(each) for each in share)

    def _with_less_noise(
        self, found: list[BodyLaw], paths: list[Path], rows: np.ndarray
    ) -> list[BodyLaw]:
        """The same laws, those of axes that hold all along at less noise as well.

        Unless another law explains more, of which these are a part.
        """
        axes = [x for x in found if x.law.is_of_axes and is_worth_asking(x.fit)]
        best = max(found, key=lambda one: one.fit.log_bayes_factor, default=None)
        if best is None or not best.law.is_of_axes or not axes:
            return found
        others = [one for one in found if not one.law.is_of_axes]
        others.sort(key=lambda one: -one.fit.log_bayes_factor)
        asked = [*axes, *others[:NUM_RIVALS]]
        wrenches = [
            (one.body, push)
            for one in asked
            for push in one.law.wrench(paths[one.body])
        ]
        levels = [
            each.at_noise(wrenches, rows)
            for each in (self._responses, *self._responses.quieter())
        ]
        z = self._z[self._used]
        fits = weighed_again([one.fit for one in asked], levels, z, self._is_normal)
        first = max(range(len(asked)), key=lambda place: fits[place].log_bayes_factor)
        if first >= len(axes):
            return found
        again = [one._replace(fit=fit) for one, fit in zip(axes, fits, strict=False)]
        return again + [one for one in found if not any(one is each for each in axes)]

    def _states(
        self, first: np.ndarray, last: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """At both ends of each step, by what is known before its end is read.

        What is read there must not enter what it is regressed on.

        Args:
            first: by how much the reading that a step starts from moved the estimate.
            last: the reading that ends it.
        """
        before = np.asarray(self._filtered.starts, float).reshape(first.shape) + first
        after = np.asarray(self._filtered.after.mean, float).reshape(last.shape) - last
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
