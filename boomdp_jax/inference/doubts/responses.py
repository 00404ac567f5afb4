"""What innovations of a block at one hypothesis answer to: coordinates, and pushes."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.inference.doubts.less_noise import FACTORS, AtNoise
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.evaluate import pushed_innovations
from boomdp_jax.inference.likelihoods.filter_points import filter_points
from boomdp_jax.inference.likelihoods.kalman import Filtered
from boomdp_jax.inference.likelihoods.target import StructureTarget

# Differences are taken over so much: first pushes as a share of the motion's noise, and
# moves in prior sds; then what changes all innovations together by so much, so that
# rounding in single precision does not tell, nor curvature.
_FIRST_PUSH, _FIRST_MOVE = 0.3, 1e-2
_PUSH_CHANGE, _MOVE_CHANGE = 3.0, 0.3
_MOVES = (1e-3, 3e-2)
# Least noise of the motion that the first push is measured by, as a share of readings'.
_LEAST_NOISE = 0.01
_POINTS = 16


class Responses(NamedTuple):
    """One object of a batch, at one hypothesis and one level of noise."""

    targets: StructureTarget
    index: int
    structure: int
    z: Float[np.ndarray, " dim"]
    used: Int[np.ndarray, " coordinate"]
    """Coordinates in use."""
    noise: NoiseFit
    """Of one point."""
    filtered: Filtered
    command: Float[np.ndarray, "time body 3"]
    gain: Float[np.ndarray, " body"]
    """Of the actuator: what acts per command."""
    inertia: Float[np.ndarray, "body 3"]
    dt: Float[np.ndarray, " time"]

    @property
    def counts(self) -> Float[np.ndarray, "time 2 body 6"]:
        """One for each innovation that counts."""
        counts = self.filtered.gains.counts
        return np.asarray(counts).reshape(len(self.command), 2, -1, 6)

    def quieter(self) -> list["Responses"]:
        """The same with less noise of the motion, `FACTORS` of it."""
        num = len(FACTORS)
        noise = NoiseFit(
            np.repeat(self.noise.reading, num, axis=0),
            self.noise.impulse * np.array(FACTORS)[:, None, None],
        )
        place = np.full(num, self.index), np.full(num, self.structure)
        filtered = filter_points(self.targets, *place, np.tile(self.z, (num, 1)), noise)
        return [
            self._replace(
                noise=noise.take(np.array([level])),
                filtered=jax.tree.map(lambda leaf, level=level: leaf[level], filtered),
            )
            for level in range(num)
        ]

    def at_noise(self, wrenches: list, rows: Int[np.ndarray, " row"]) -> AtNoise:
        """What models with laws and without are compared by.

        Args:
            wrenches: as for `by_pushes`.
            rows: that were read.
        """
        base = self.innovations(self.z[None, None])[0, 0]
        one = np.ones(base.shape[2:])
        return AtNoise(
            base[rows],
            self.counts[rows],
            float(np.sum(self.filtered.gains.log_volumes)),
            self.by_moves(base, one)[:, rows],
            self.by_pushes(base, one, wrenches)[:, rows],
        )

    def innovations(self, z: np.ndarray, extra: np.ndarray | None = None) -> np.ndarray:
        """Whitened, of lists of points, each list with further commands.

        Args:
            z: coordinates, `[list, point, dim]`.
            extra: commands, `[list, time, body, 3]`; None: none.
        """
        action = np.broadcast_to(self.command, (len(z), *self.command.shape))
        if extra is not None:
            action = action + extra
        gains = jax.tree.map(
            lambda leaf: np.broadcast_to(leaf, (len(z), *leaf.shape)),
            self.filtered.gains,
        )
        return pushed_innovations(
            self.targets,
            np.full(len(z), self.index),
            np.full(len(z), self.structure),
            gains,
            action,
            z,
        )

    def by_moves(self, base: np.ndarray, scale: np.ndarray) -> np.ndarray:
        """Derivative by coordinates in use, `[coordinate, time, 2, body, 6]`."""
        num = len(self.used)

        def change(step: np.ndarray) -> np.ndarray:
            moved = np.tile(self.z, (num, 1))
            moved[np.arange(num), self.used] += step
            moved = np.pad(moved, ((0, -num % _POINTS), (0, 0)), mode="edge")
            found = self.innovations(moved.reshape(-1, _POINTS, len(self.z)))
            found = found.reshape(-1, *base.shape)[:num]
            return (found - base) / scale

        if not num:
            return np.zeros((0, *base.shape))
        step = np.full(num, _FIRST_MOVE)
        slope = _length(change(step)) / step
        step = np.clip(_MOVE_CHANGE / np.maximum(slope, 1e-9), *_MOVES)
        return np.nan_to_num(change(step) / step[:, None, None, None, None])

    def by_pushes(
        self, base: np.ndarray, scale: np.ndarray, wrenches: list
    ) -> np.ndarray:
        """The same by pushes of bodies, `[push, time, 2, body, 6]`."""
        noise = np.maximum(
            self.noise.impulse[0], _LEAST_NOISE * self.noise.reading[0][:, 2:]
        )[:, [0, 0, 1]]
        unit, extra = [], []
        for body, push in wrenches:
            kick = push * self.dt[:, None] / self.inertia[body] / noise[body]
            size = np.sqrt(np.mean(np.sum(kick**2, axis=1)))
            unit.append(_FIRST_PUSH / size if size > 0 else 0.0)
            whole = np.zeros_like(self.command)
            whole[:, body] = push / self.gain[body]
            extra.append(whole)
        unit, extra = np.array(unit), np.stack(extra)

        def change(step: np.ndarray) -> np.ndarray:
            z = np.tile(self.z, (len(step), 1, 1))
            found = self.innovations(z, step[:, None, None, None] * extra)[:, 0]
            return (found - base) / scale

        slope = _length(change(unit)) / np.where(unit > 0, unit, 1.0)
        step = np.where(slope > 0, _PUSH_CHANGE / np.where(slope > 0, slope, 1.0), unit)
        step = np.clip(step, 1e-3 * unit, 1e3 * unit)
        safe = np.where(step > 0, step, 1.0)
        return change(step) / safe[:, None, None, None, None]


def _length(change: np.ndarray) -> np.ndarray:
    """Root of the sum of squares of each."""
    return np.sqrt(np.sum(change**2, axis=(1, 2, 3, 4)))
