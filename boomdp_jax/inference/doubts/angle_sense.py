r"""Angles that are in degrees, or counted clockwise, by what a point of the body does.

A body on a pin, on a wheel, or pushed along one of its own axes has a point that does
not move along some direction of the body's own frame. From one reading to the next, d
apart and turned by $\phi$ about a mean angle $\theta$, that reads

$$n \cdot R(-\theta)\, d + 2 c \sin(\phi / 2) = 0$$

with the same unit vector n and number c all along, exactly so for a pin. Images have y
downwards, protractors degrees: where angles are read otherwise than told, nothing of
the kind holds until they are put right. No model and no masses are needed to see it;
inference, that takes angles as told, finds a free body with noisy motion, sure of its
wrong mass.
"""

import numpy as np
from jaxtyping import Float, Int

from boomdp_jax.core.history import History
from boomdp_jax.inference.readings.reading_sequence import readings_in_order, scatter
from boomdp_jax.physics.scene_arrays import has_contact
from boomdp_jax.physics.scene_spec import SceneSpec

_DEGREE = np.pi / 180.0
_SENSES = {
    -1.0: "counted the other way round; expected counterclockwise where x is to the "
    "right and y up, which images that have y downwards are not",
    _DEGREE: "in degrees; expected radians",
    -_DEGREE: "in degrees and counted the other way round; expected radians, "
    "counterclockwise where x is to the right and y up",
}
"""Factors that put angles right, and what is said of them."""
# How many times less than with angles as told, and than along a direction of the world,
# a point moves, and which share of all motion that is at most: in mean squares, of
# either half of the readings along what the other half says.
_TIMES_LESS, _MOST = 20.0, 0.005
# Moves are over so many readings that most are so many times as far as their noise.
_LAGS, _FAR = (1, 2, 4, 8), 30.0
_FEWEST = 25
"""Moves in each half."""
_LEAST_TURNED = 0.3
"""How far a body has to have turned, by angles put right [rad]: of less nothing can be
told, and short paths of free bodies look as if they were held."""


class _Moves:
    """Of a body from reading to reading."""

    def __init__(
        self, pose: Float[np.ndarray, "reading 3"], run: Int[np.ndarray, " reading"]
    ):
        is_read = np.all(np.isfinite(pose), axis=1)
        pose, run = pose[is_read], run[is_read]
        noise = scatter(pose[:, :2], run) or 0.0
        for lag in _LAGS:
            first = np.flatnonzero(run[lag:] == run[:-lag])
            if lag > _LAGS[0] and len(first) < 2 * _FEWEST:
                break
            self._first, self._last = first, first + lag
            self.away = pose[self._last, :2] - pose[first, :2]
            far = np.median(np.hypot(*self.away.T)) if len(first) else 0.0
            if far >= _FAR * noise:
                break
        self._angle = pose[:, 2]

    def turned(self, factor: float) -> float:
        """Range of angles, times a factor [rad]."""
        return float(np.ptp(self._angles(factor)))

    def held(self, factor: float, *, is_turning: bool = True) -> float:
        """Mean square by which a point moves along its direction, the worse half's.

        Args:
            factor: of angles.
            is_turning: whether the direction is one of the body's, or of the world.
        """
        angle = self._angles(factor)
        first, last = angle[self._first], angle[self._last]
        middle = is_turning * 0.5 * (first + last)
        cos, sin = np.cos(middle), np.sin(middle)
        x, y = self.away.T
        along = np.column_stack([cos * x + sin * y, cos * y - sin * x])
        lever = 2.0 * np.sin(0.5 * (last - first))
        half = len(along) // 2
        early, late = slice(None, half), slice(half, None)
        return max(
            _left(along[one], lever[one], along[other], lever[other])
            for one, other in ((early, late), (late, early))
        )

    def _angles(self, factor: float) -> Float[np.ndarray, " reading"]:
        change = np.diff(factor * self._angle, prepend=factor * self._angle[:1])
        return factor * self._angle[0] + np.cumsum(np.angle(np.exp(1j * change)))


def angle_sense_reasons(spec: SceneSpec, history: History) -> list[str]:
    """Reasons for doubt about the unit of angles, or which way they are counted.

    With 80 rows of 50 ms, noise of 1 mm and 5 mrad, all boxes on a pin or a wheel were
    named whose angles were in degrees or counted clockwise; of MuJoCo's, 150 rows of 20
    ms, most of which hardly turn, 27 and 29 of 100. Of 5,000 right recordings of those
    and of free and rubbing boxes none was. What slides in a corner is, without contact
    in its scene.

    Args:
        spec: the scene, for names.
        history: its readings.

    Returns:
        One line for each body of which a point is held to a direction of the body only
        where angles are taken otherwise than told. What is free shows nothing; discs,
        and scenes with contact, are not asked.
    """
    readings, reasons = readings_in_order(spec, history), []
    # What slides along walls, and discs that go round something, may be held so.
    if has_contact(spec.bodies):
        return []
    for body in np.flatnonzero(~np.asarray(spec.is_static)):
        if spec.bodies[body].radius > 0.0:
            continue
        moves = _Moves(readings.values[:, body, :3], readings.run)
        if len(moves.away) < 2 * _FEWEST:
            continue
        found = {
            factor: moves.held(factor)
            for factor in _SENSES
            if moves.turned(factor) > _LEAST_TURNED
        }
        if not found:
            continue
        best = min(found, key=lambda factor: found[factor])
        others = moves.held(1.0), moves.held(best, is_turning=False)
        size = float(np.mean(np.sum(moves.away**2, axis=1)))
        if found[best] < min(min(others) / _TIMES_LESS, _MOST * size):
            reasons.append(
                f"{spec.names[body]}: its angles look as if they were {_SENSES[best]} "
                "(only then is one of its points held, as by a pin or a wheel)"
            )
    return reasons


def _left(
    along: np.ndarray, lever: np.ndarray, other: np.ndarray, other_lever: np.ndarray
) -> float:
    """Mean square of some moves along the direction in which others are least."""
    size = float(lever @ lever)
    slope = lever @ along / size if size > 0.0 else np.zeros(2)
    rest = along - lever[:, None] * slope
    direction = np.linalg.eigh(rest.T @ rest)[1][:, 0]
    moved = (other - other_lever[:, None] * slope) @ direction
    return float(np.mean(moved**2))
