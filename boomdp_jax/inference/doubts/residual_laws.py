"""Laws that a model may lack, each as the wrench that a coefficient of one would add.

They are laws of one body, evaluated along the path that it was found to take. A law
with two coefficients is a vector in the plane.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# One less the length of the mean of a body's axis while it is pushed, about half the
# variance of its angle, from which it turns enough to tell its axes from turned ones.
_LEAST_TURNED = 0.001


class Path(NamedTuple):
    """Where a body was in the middle of each step, and what pushed it."""

    pose: Float[np.ndarray, "time 3"]
    twist: Float[np.ndarray, "time 3"]
    wrench: Float[np.ndarray, "time 3"]
    """As the model has it act, world frame [N, N, N m]."""
    change: Float[np.ndarray, "time 3"]
    """Of the wrench from the step before, per second; none where a run begins."""
    change_ahead: Float[np.ndarray, "time 3"]
    """Of the wrench to the step after, per second; none where a run ends."""
    spread: Float[np.ndarray, "time 2"]
    """How well velocity [m/s] and spin [rad/s] are known."""
    progress: Float[np.ndarray, " time"]
    """How far the recording has gone, from -1/2 to 1/2 of its length."""
    since_begin: Float[np.ndarray, " time"]
    """Steps of its run before each step."""
    until_end: Float[np.ndarray, " time"]
    """Steps of its run after each step."""


class Law(NamedTuple):
    """One candidate."""

    name: str
    text: str
    """What it says, for people; its coefficients follow."""
    unit: str
    wrench: Callable[[Path], list[Float[np.ndarray, "time 3"]]]
    """Per unit of each coefficient."""
    meaning: Callable[[np.ndarray], str] | None = None
    """What coefficients come to, for people."""
    is_of_axes: bool = False
    """Whether it says how axes of wrenches lie; see `less_noise`."""


def _along(direction: np.ndarray, size: np.ndarray) -> np.ndarray:
    """A force along a direction, `[time, 2]` and `[time]`."""
    return np.column_stack([direction * size[:, None], np.zeros(len(size))])


def _torque(size: np.ndarray) -> np.ndarray:
    return np.column_stack([np.zeros((len(size), 2)), size])


def _axis(path: Path, number: int) -> np.ndarray:
    """The body's own x or y axis in the world, `[time, 2]`."""
    angle = path.pose[:, 2] + 0.5 * np.pi * number
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _speed(path: Path) -> np.ndarray:
    return np.hypot(path.twist[:, 0], path.twist[:, 1])


def _direction(path: Path) -> np.ndarray:
    """Of the velocity; short where it is not known."""
    size = np.sqrt(_speed(path) ** 2 + path.spread[:, 0] ** 2)
    return path.twist[:, :2] / np.maximum(size, 1e-12)[:, None]


def _turning(path: Path) -> np.ndarray:
    """Sign of the spin; small where it is not known."""
    spin = path.twist[:, 2]
    return spin / np.maximum(np.hypot(spin, path.spread[:, 1]), 1e-12)


def _force_along(path: Path, number: int) -> np.ndarray:
    """Part of the applied force along the body's own x or y axis."""
    return np.sum(path.wrench[:, :2] * _axis(path, number), axis=1)


def _own_velocity(path: Path, number: int) -> np.ndarray:
    return np.sum(path.twist[:, :2] * _axis(path, number), axis=1)


def _constant(path: Path, part: int) -> np.ndarray:
    return np.tile(np.eye(3)[part], (len(path.pose), 1))


def _limited(part: np.ndarray, place: int = 0) -> np.ndarray:
    """What a limit takes away from a part of the wrench, but for a share of the part.

    The hyperbolic tangent of its size by the root mean square of sizes, less the share
    of the part that is most like it, which is a matter of the mass. Of commands that
    are normal it has 0.76 to 0.97 of the variance of what limits of half to one and a
    half times that size leave so.

    Args:
        part: components that are limited together, `[time, component]`.
        place: of the first of them in a wrench.
    """
    size = np.linalg.norm(part, axis=1)
    acts = size > 0.0
    usual = np.sqrt(np.mean(size[acts] ** 2)) if np.any(acts) else 1.0
    share = np.where(acts, np.tanh(size / usual) * usual / np.where(acts, size, 1.0), 0)
    share = share - np.sum(share * size**2) / max(float(size @ size), 1e-300)
    wrench = np.zeros((len(part), 3))
    wrench[:, place : place + part.shape[1]] = part * share[:, None]
    return wrench


def _quarter_turned(path: Path) -> np.ndarray:
    """The applied force turned counterclockwise by a quarter turn."""
    x, y, _ = path.wrench.T
    return np.column_stack([-y, x, np.zeros(len(x))])


def _mirrored(path: Path, matrix: np.ndarray) -> np.ndarray:
    """What the applied force has beyond itself where it is mirrored."""
    change = path.wrench[:, :2] @ (matrix - np.eye(2)).T
    return np.column_stack([change, np.zeros(len(change))])


def _out_of_own_frame(path: Path) -> np.ndarray:
    """What a force of these components along the body's own axes has beyond it.

    Nothing where the body hardly turns while it is pushed: then its axes are but axes
    that are turned against the world's.
    """
    x, y, _ = path.wrench.T
    force = np.hypot(x, y)
    mean = np.sum(force[:, None] * _axis(path, 0), axis=0)
    if np.hypot(*mean) > (1.0 - _LEAST_TURNED) * np.sum(force):
        return np.zeros_like(path.wrench)
    turned = _along(_axis(path, 0), x) + _along(_axis(path, 1), y)
    return turned - path.wrench * [1.0, 1.0, 0.0]


def _turn(coefficient: np.ndarray) -> str:
    """The angle: its tangent is known where forces alone tell the mass, else its sine.

    In the first case the mass has taken up the cosine.
    """
    (share,) = coefficient
    low, high = np.degrees([np.arctan(share), np.arcsin(np.clip(share, -1.0, 1.0))])
    ends = [f"{angle:.2g}" for angle in ((low,) if abs(share) > 1.0 else (low, high))]
    return f"an angle of {' to '.join(dict.fromkeys(ends))} degrees, counterclockwise"


def _own_axis_law(letter: str, number: int) -> tuple[Law, Law]:
    """Friction along one of the body's axes, and another mass along it."""
    return (
        Law(
            f"viscous_{letter}",
            f"a force along its own {letter} in proportion to its velocity along it",
            "N s/m",
            lambda p: [_along(_axis(p, number), _own_velocity(p, number))],
        ),
        Law(
            f"force_gain_{letter}",
            f"a further share of the applied force along its own {letter}",
            "",
            lambda p: [_along(_axis(p, number), _force_along(p, number))],
        ),
    )


def _negated_laws() -> tuple[Law, Law]:
    """An axis of wrenches that points the other way round.

    Where only forces tell the mass, one of them is the other's negative.
    """
    return (
        Law(
            "x_negated",
            "what the applied force would add if its x were counted the other way "
            "round (if negative: its y), a share of",
            "",
            lambda p: [_mirrored(p, np.diag([-1.0, 1.0]))],
            is_of_axes=True,
        ),
        Law(
            "y_negated",
            "what the applied force would add if its y were counted the other way "
            "round (if negative: its x), a share of",
            "",
            lambda p: [_mirrored(p, np.diag([1.0, -1.0]))],
            is_of_axes=True,
        ),
    )


def _rows(number: int) -> str:
    return "row" if number == 1 else f"{number} rows"


def _edge_laws(num_rows: int) -> tuple[Law, Law]:
    """Commands that do not act yet, or no longer, in some rows of each run."""
    return (
        Law(
            f"begin_{num_rows}",
            f"a further share of the applied wrench in the first {_rows(num_rows)} of "
            "each run, as where it is recorded before it acts",
            "",
            lambda p: [p.wrench * (p.since_begin < num_rows)[:, None]],
        ),
        Law(
            f"end_{num_rows}",
            f"a further share of the applied wrench in the last {_rows(num_rows)} of "
            "each run, as where it is recorded after it has ceased to act",
            "",
            lambda p: [p.wrench * (p.until_end < num_rows)[:, None]],
        ),
    )


LAWS: tuple[Law, ...] = (
    Law(
        "constant_force",
        "a constant force along x and y, as on a floor that slopes",
        "N",
        lambda p: [_constant(p, 0), _constant(p, 1)],
    ),
    Law("constant_torque", "a constant torque", "N m", lambda p: [_constant(p, 2)]),
    Law(
        "coulomb",
        "a force of constant size along its velocity",
        "N",
        lambda p: [_along(_direction(p), np.ones(len(p.pose)))],
    ),
    Law(
        "viscous",
        "a force in proportion to its velocity",
        "N s/m",
        lambda p: [_along(p.twist[:, :2], np.ones(len(p.pose)))],
    ),
    Law(
        "drag",
        "a force along its velocity in proportion to the square of its speed",
        "N s²/m²",
        lambda p: [_along(p.twist[:, :2], _speed(p))],
    ),
    *_own_axis_law("x", 0),
    *_own_axis_law("y", 1),
    Law(
        "turned",
        "a share of the applied force turned by a quarter turn, as where wrenches and "
        "poses have axes of their own",
        "",
        lambda p: [_quarter_turned(p)],
        _turn,
        is_of_axes=True,
    ),
    *_negated_laws(),
    Law(
        "exchanged",
        "what the applied force would add if its x were y and its y were x, a share of",
        "",
        lambda p: [_mirrored(p, np.array([[0.0, 1.0], [1.0, 0.0]]))],
        is_of_axes=True,
    ),
    Law(
        "own_frame",
        "what the applied force would add if its components were along the body's own "
        "axes, a share of",
        "",
        lambda p: [_out_of_own_frame(p)],
        is_of_axes=True,
    ),
    Law(
        "spin_coulomb",
        "a torque of constant size along its spin",
        "N m",
        lambda p: [_torque(_turning(p))],
    ),
    Law(
        "spin_viscous",
        "a torque in proportion to its spin",
        "N m s/rad",
        lambda p: [_torque(p.twist[:, 2])],
    ),
    Law(
        "spin_drag",
        "a torque along its spin in proportion to the square of that",
        "N m s²/rad²",
        lambda p: [_torque(p.twist[:, 2] * np.abs(p.twist[:, 2]))],
    ),
    Law(
        "torque_gain",
        "a further share of the applied torque",
        "",
        lambda p: [_torque(p.wrench[:, 2])],
    ),
    Law(
        "force_limit",
        "more of small forces and less of large ones than of usual ones, as where what "
        "acts is limited (the other way round if negative), a share of",
        "",
        lambda p: [_limited(p.wrench[:, :2])],
    ),
    Law(
        "axis_limit",
        "more of small components of forces and less of large ones, as where each is "
        "limited by itself (the other way round if negative), a share of",
        "",
        lambda p: [_limited(p.wrench[:, :1]) + _limited(p.wrench[:, 1:2], 1)],
    ),
    Law(
        "torque_limit",
        "more of small torques and less of large ones than of usual ones, as where "
        "what acts is limited (the other way round if negative), a share of",
        "",
        lambda p: [_limited(p.wrench[:, 2:], 2)],
    ),
    Law(
        "drift",
        "a further share of the applied force, and one of the torque, by which the end "
        "of the recording exceeds its begin, as where its mass changes",
        "",
        lambda p: [
            p.wrench * p.progress[:, None] * [1.0, 1.0, 0.0],
            p.wrench * p.progress[:, None] * [0.0, 0.0, 1.0],
        ],
    ),
    Law(
        "delay",
        "the applied wrench as it was before, by",
        "s",
        lambda p: [-p.change],
    ),
    # Where wrenches are held over several steps the two differ: one says what acts in
    # the first step of a push, the other in the step before it.
    Law(
        "advance",
        "the applied wrench as it comes to be only in later rows, ahead by",
        "s",
        lambda p: [p.change_ahead],
    ),
    Law(
        "lever",
        "a torque of the applied force, as if that acted off its centre of mass, in "
        "its own frame at",
        "m",
        lambda p: [_torque(_force_along(p, 1)), _torque(-_force_along(p, 0))],
    ),
    Law(
        "heading",
        "a torque in proportion to sine and cosine of its angle, as of a weight or a "
        "spring",
        "N m",
        lambda p: [_torque(np.sin(p.pose[:, 2])), _torque(np.cos(p.pose[:, 2]))],
    ),
    *_edge_laws(1),
    *_edge_laws(2),
    *_edge_laws(3),
    *_edge_laws(5),
    *_edge_laws(8),
)
"""Candidates, the same for every body."""
