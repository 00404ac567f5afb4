r"""Whether steps of a likelihood are short enough for what was inferred by them.

The engine takes a row in a few parts. Where those are too long for a body, which turns
fast about a pin or stops and goes on a floor, rows end beside where the model's own
laws would lead, and masses and drags make up for it: wrong ones, with narrow intervals.
So after inference every row is stepped in four times as many parts as well, from where
the filter has it. What that changes is handed on from row to row by the filter's
derivatives and gains, which gives by how much the whitened innovations u would differ.
With J their derivative by the coordinates and P the precision of the prior, that moves
the posterior by

$$\delta = -(J^T J + P)^{-1} J^T (u_{fine} - u),$$

of which the covariance is the matrix's inverse. Shifts are stated in standard
deviations. Noise of the motion that was taken to be large enough to cover what steps
are off by is in the whitening, and so casts no doubt.

Nothing is compiled for it but how arrays are picked: a row in four times as many parts
is four rows of a quarter of its length.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from boomdp_jax.inference.likelihoods.evaluate import single_steps
from boomdp_jax.inference.likelihoods.kalman import Filtered
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.posteriors.summary import CHANNELS
from boomdp_jax.inference.readings.track_data import TrackData

_TIMES = 4
"""As many parts a row as the likelihood has. A rule of first order is left with a
quarter of its error, which makes shifts a quarter too small."""
# Draws whose rows are stepped; the shift is the median over them.
_MOST_DRAWS = 4
# Shift of a coordinate from which on it is a doubt [posterior sd]. Of 42 objects that
# MuJoCo moved (seven families, 50 rows of 20 ms) the largest was 0.78, where nothing
# has dry friction 0.09; with a fifth of the noise 21 objects had 0.48 at most. Two
# welded boxes on a dry floor in rows of 50 ms had 3.8 to 4.2 (masses up to 3 % off, by
# up to five sds), a cart in rows of 0.4 s 5 to 11.
_MOST_SHIFT = 1.0
# Where finer steps explain readings worse by so much [nat], the world steps as the
# model does: it is the engine itself. By 14 000 of carts that it moved so, read
# exactly, and by 1300 of the welded boxes. Those that moved finely they explained
# better, by 20 to 45 and by 118; of 21 of MuJoCo's objects it was less than one.
_DECISIVE = 5.0
_UNITS = ("m", "rad", "m/s", "rad/s")
_GROUPS = ((0, 1), (2,), (3, 4), (5,))


class StepError(NamedTuple):
    """What finer steps would change in one block."""

    num_parts: int
    """Of a row, as the likelihood has them."""
    length: float
    """Of a row, the median [s]."""
    shift: Float[np.ndarray, " coordinate"]
    """By which coordinates would move [posterior sd]; zero for those not in use."""
    error: Float[np.ndarray, "body 4"]
    """Root mean square of what rows end off by [m, rad, m/s, rad/s]."""
    gain: float
    """By how much likelier readings are in finer steps, with all numbers moved [nat].
    """


class Linearised(NamedTuple):
    """A block at its best draw, and all that is known there to first order."""

    targets: StructureTarget
    """Stacked along a leading object axis, of which it is one."""
    index: int
    structure: int
    z: Float[np.ndarray, " coordinate"]
    filtered: Filtered
    """On the host."""
    command: Float[np.ndarray, "time body 3"]
    """In effect [N, N, N m]."""
    used: np.ndarray
    """Coordinates in use."""
    is_normal: Bool[np.ndarray, " use"]
    """Which of those are standard normal a priori; the others are free."""
    innovation: Float[np.ndarray, "time 2 body 6"]
    """Whitened, and divided by `scale`."""
    moves: Float[np.ndarray, "use time 2 body 6"]
    """Their derivative by coordinates in use."""
    scale: Float[np.ndarray, "body 6"]
    """How much larger than they should be innovations were."""


def step_error(
    known: Linearised, z: Float[np.ndarray, "draw coordinate"]
) -> StepError | None:
    """Compare rows with rows in four times as many parts.

    Args:
        known: of a block with rows in use.
        z: some draws of its structure, the best one first.

    Returns:
        What those change; None where bodies may collide, whose steps are cut where they
        do, where nothing is inferred, and where steps are not finite.
    """
    likelihood: Any = known.targets.log_likelihood
    coordinates = likelihood.coordinates
    if coordinates.contact is not None or not len(known.used):
        return None
    target = jax.tree.map(lambda leaf: np.asarray(leaf)[known.index], known.targets)
    data: TrackData = target.log_likelihood.data
    rows = np.asarray(data.is_used)
    z = z[np.linspace(0, len(z) - 1, min(len(z), _MOST_DRAWS)).astype(int)]
    off = _off(target, known, z)
    off[:, ~rows] = 0.0
    if not rows.any() or not np.all(np.isfinite(off)):
        return None
    jacobian = np.nan_to_num(known.moves).reshape(len(known.used), -1)
    change = np.stack([_innovations(each, data, known.filtered) for each in off])
    change = (change / known.scale).reshape(len(z), -1)
    # What neither readings nor the prior tell anything of does not move.
    prior = np.maximum(known.is_normal, 1e-9)
    covariance = np.linalg.inv(jacobian @ jacobian.T + np.diag(prior))
    moved = -covariance @ np.median(change @ jacobian.T, axis=0)
    shift = np.zeros(z.shape[1])
    shift[known.used] = moved / np.sqrt(np.diagonal(covariance))

    def misfit(innovation: np.ndarray) -> float:
        """Where all numbers are what makes it least."""
        pull = jacobian @ innovation + prior * known.z[known.used]
        return float(innovation @ innovation - pull @ covariance @ pull)

    innovation = known.innovation.reshape(-1)
    gain = 0.5 * (misfit(innovation) - misfit(innovation + change[0]))
    square = np.mean(np.median(off, axis=0)[rows] ** 2, axis=0)
    error = [np.sqrt(square[:, list(group)].sum(axis=-1)) for group in _GROUPS]
    length = np.broadcast_to(np.asarray(data.steps.dt, float), rows.shape)[rows]
    return StepError(
        coordinates.scene.num_substeps,
        float(np.median(length)),
        shift,
        np.stack(error, axis=-1),
        gain,
    )


def _off(target: StructureTarget, known: Linearised, z: np.ndarray) -> np.ndarray:
    """Where rows end in finer parts, from where they end, `[draw, time, body, 6]`."""
    start = np.asarray(known.filtered.starts, float)
    start = np.broadcast_to(start, (len(z), *start.shape))
    none = np.zeros(len(z), int)
    own = (none, none + known.structure)
    whole = single_steps(_shortened(target, known.command, 1), *own, start, z[:, None])
    targets = _shortened(target, known.command, _TIMES)
    state = start
    for _ in range(_TIMES):
        state = state + single_steps(targets, *own, state, z[:, None])[:, 0]
    return state - start - whole[:, 0]


def _shortened(
    target: StructureTarget, command: np.ndarray, times: int
) -> StructureTarget:
    """A stack of one object with rows of a fraction of their length."""
    likelihood: Any = target.log_likelihood
    steps = likelihood.data.steps
    dtype = steps.state.dtype
    length = np.asarray(steps.dt / times, dtype)
    target = eqx.tree_at(
        lambda t: (
            t.log_likelihood.data.steps.dt,
            t.log_likelihood.data.steps.action,
            t.log_likelihood.data.steps.commands,
        ),
        target,
        (length, command.astype(dtype), None),
        is_leaf=lambda leaf: leaf is None,
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], target)


def _innovations(off: np.ndarray, data: TrackData, filtered: Filtered) -> np.ndarray:
    """By how much innovations differ if each row ends that far off.

    Args:
        off: of each row, `[time, body, 6]`.
        data: readings.
        filtered: at the same hypothesis.

    Returns:
        Whitened, `[time, 2, body, 6]`.
    """
    gains = jax.tree.map(lambda leaf: np.asarray(leaf, float), filtered.gains)
    slopes = np.asarray(filtered.slopes, float)
    begins = np.asarray(data.is_start) > 0
    count = np.ones(len(off)) if data.weight is None else np.sqrt(data.weight)
    change = np.zeros((len(off), 2, *off.shape[1:]))
    moved = np.zeros(off[0].size)
    for row, each in enumerate(off.reshape(len(off), -1)):
        moved = np.zeros_like(moved) if begins[row] else moved
        first = gains.first_whitening[row] @ moved
        moved = moved - gains.first[row] @ moved
        moved = slopes[row] @ moved + each
        last = gains.last_whitening[row] @ moved
        moved = moved - gains.last[row] @ moved
        both = -float(count[row]) * np.stack([first, last])
        change[row] = both.reshape(change.shape[1:])
    return change


def step_reason(found: StepError, names: list[str], numbers: list[str]) -> str | None:
    """Why steps of a block are too long, if they are.

    Args:
        found: in the block.
        names: of its bodies.
        numbers: names of its coordinates, as `coordinate_names` has them.

    Returns:
        A line; None: what is inferred would hardly move, or readings are of a world
        that steps so.
    """
    worst = int(np.argmax(np.abs(found.shift)))
    shift = float(np.abs(found.shift[worst]))
    if not shift > _MOST_SHIFT or found.gain < -_DECISIVE:
        return None
    error = np.max(found.error, axis=0)
    most = ", ".join(
        f"{value:.1g} {unit} of {name}"
        for name, unit, value in zip(CHANNELS, _UNITS, error, strict=True)
    )
    parts = _TIMES * found.num_parts
    return (
        f"{'+'.join(names)}: steps of {found.length:.3g} s in {found.num_parts} parts "
        f"are too long for its motion: in {parts} they end elsewhere, by {most} (root "
        f"mean square), and {numbers[worst]} would move by {shift:.1f} posterior sds; "
        f'expected shorter rows, or give "substeps": {parts} in the scene'
    )
