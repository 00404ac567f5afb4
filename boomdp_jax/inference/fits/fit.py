r"""Find the modes of every structure: many starts, Gauss-Newton with damping.

With the noise integrated out the gradient of the log-likelihood is $-J^T W u$ with
innovations u and weights W that depend on the innovations themselves; $J^T W J$ plus
the prior's identity serves as the Hessian (the part left out is of rank one per noise
group). Levenberg (1944) and Marquardt (1963), with three dampings tried at a time.

Everything but the physics runs on the host: points are evaluated in large batches by
`evaluate_points`, the Jacobian is by differences (one plain evaluation per coordinate
in use), and small linear systems are solved by NumPy.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.fits.fit_groups import FitGroups
from boomdp_jax.inference.hypotheses.periods import wrapped
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points
from boomdp_jax.inference.likelihoods.one_step import NOISE_SHAPE
from boomdp_jax.inference.likelihoods.target import StructureTarget

_GROUP = np.array([0, 0, 1, 2, 2, 3])
_DAMPING_FACTORS = np.array([0.1, 1.0, 10.0])
# A fit whose log-density gains less than this in an iteration has arrived.
_ARRIVED = 1e-3
# After so many iterations a fit this far below the best of its structure is given up.
_PATIENCE, _HOPELESS = 3, 25.0
# A structure is given up, in terms of what it may lack, in a first climb from anywhere.
_LENIENCE = 2.0
# Steps of the differences in posterior standard deviations, and their limits in prior
# ones by float size: above the rounding of the prediction, below its curvature.
_DIFFERENCE = 0.2
_DIFFERENCE_LIMITS = {4: (1e-3, 3e-2), 8: (1e-5, 1e-2)}


class FitSettings(NamedTuple):
    """How hard to look for modes; numbers are per structure."""

    num_draws: int = 64
    """Starts whose density is looked at."""
    num_starts: int = 4
    """Best of them that are fitted."""
    num_iterations: int = 8
    """Most iterations of a climb with single steps, then again with filters."""
    num_repeats: int = 5
    """Most iterations of a later climb, from fits with other gains."""
    num_modes: int = 3
    """Distinct modes that are kept."""
    num_searches: int = 3
    """Most rounds of further climbs with single steps, where few climbs agree."""


class Modes(NamedTuple):
    """Modes of all structures."""

    structure: Int[Array, "*object mode"]
    z: Float[Array, "*object mode dim"]
    precision: Float[Array, "*object mode dim dim"]
    log_density: Float[Array, "*object mode"]
    """Minus infinity where a structure has no further mode."""


class Fits(NamedTuple):
    """A flat list of points on their way to optima, on the host."""

    index: np.ndarray
    """Object of each."""
    structure: np.ndarray
    z: np.ndarray
    value: np.ndarray
    """Log-density."""
    precision: np.ndarray
    """Gauss-Newton matrix at the last point where it was formed, `[fit, dim, dim]`."""

    def take(self, rows: np.ndarray) -> "Fits":
        """Some of them."""
        return Fits(*(part[rows] for part in self))


def join_fits(*parts: Fits) -> Fits:
    """Several lists as one."""
    return Fits(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class Host(NamedTuple):
    """What a fit needs of the targets, on the host."""

    in_use: np.ndarray
    """`[structure, dim]`."""
    is_normal: np.ndarray
    """Coordinates with a normal prior, `[dim]`."""
    period: np.ndarray
    rate: np.ndarray
    """Rate of the noise factor's prior, `[object, body, 4]`."""

    @classmethod
    def of(cls, targets: StructureTarget) -> "Host":
        """Read it off stacked targets."""
        structures, slot = (
            np.asarray(targets.structures)[0],
            np.asarray(targets.slot)[0],
        )
        active = np.concatenate(
            [structures, np.ones((len(structures), 1), bool)], axis=1
        )
        period = np.asarray(targets.period, float)[0]
        likelihood: Any = targets.log_likelihood
        scale = np.asarray(likelihood.coordinates.scales.noise, float)
        reference = np.asarray(likelihood.reference, float)
        return cls(
            in_use=active[:, slot],
            is_normal=period == 0,
            period=period,
            rate=(scale[:, None, None] / reference) ** 2,
        )

    def wrap(self, z: np.ndarray) -> np.ndarray:
        """Bring angles into half a period about zero."""
        return wrapped(z, self.period)


def make_fits(
    targets: StructureTarget, index: np.ndarray, structure: np.ndarray, z: np.ndarray
) -> Fits:
    """Points with their log-densities, no matrix formed yet."""
    value = evaluate_points(targets, index, structure, z).log_density
    precision = np.broadcast_to(np.eye(z.shape[1]), (len(z), z.shape[1], z.shape[1]))
    return Fits(index, structure, z, value, precision.copy())


def best_of_each(
    fits: Fits, num_structures: int, num: int, *, min_distance: float = 0.0
) -> Fits:
    """The highest few of every object and structure, highest first.

    Args:
        fits: to choose from.
        num_structures: of every object.
        num: how many of each to keep at most.
        min_distance: of two closer than this, in standard deviations of the higher,
            only the higher is kept.

    Returns:
        The chosen ones, sorted by object and structure.
    """
    group = fits.index * num_structures + fits.structure
    chosen: list[int] = []
    for name in np.unique(group):
        members = np.flatnonzero(group == name)
        members = members[np.argsort(-fits.value[members], kind="stable")]
        kept: list[int] = []
        for row in map(int, members):
            if len(kept) == num:
                break
            if min_distance == 0.0 or all(
                _distance(fits, other, row) >= min_distance for other in kept
            ):
                kept.append(row)
        chosen += kept
    return fits.take(np.array(chosen, int))


def _distance(fits: Fits, first: int, second: int) -> float:
    offset = fits.z[second] - fits.z[first]
    return float(np.sqrt(max(offset @ fits.precision[first] @ offset, 0.0)))


def climb(
    targets: StructureTarget,
    fits: Fits,
    num_iterations: int,
    lack: np.ndarray | None = None,
    *,
    from_anywhere: bool = False,
    is_patient: bool = False,
) -> Fits:
    """Take points to their optima.

    Args:
        targets: with a `FilteredLikelihood`, stacked along a leading object axis.
        fits: where to start.
        num_iterations: most iterations.
        lack: how much below an object's best fit the best of a structure may be, in
            nats; those further below stay where they are. None: however much.
        from_anywhere: whether nothing has been climbed yet; structures then have a few
            iterations, and twice as much, before they are given up.
        is_patient: whether fits go on however far they are below the best.

    Returns:
        The same list, uphill.
    """
    host = Host.of(targets)
    z, value = fits.z.astype(float).copy(), fits.value.copy()
    precision = fits.precision.copy()
    damping = np.full(len(value), 0.1)
    is_moving = np.isfinite(value)
    groups = FitGroups(fits.index, fits.structure, *targets.structures.shape[:2])
    if lack is not None and not from_anywhere:
        is_moving &= groups.is_worth(value, lack)
    for iteration in range(num_iterations):
        if iteration >= _PATIENCE:
            if not is_patient:
                is_moving &= value > groups.best(value) - _HOPELESS
            is_moving &= ~groups.is_repeated(value, z, precision, host.wrap)
            if lack is not None:
                lenience = _LENIENCE if from_anywhere else 1.0
                is_moving &= groups.is_worth(value, lenience * lack)
        rows = np.flatnonzero(is_moving)
        if rows.size == 0:
            break
        current = Fits(
            fits.index[rows],
            fits.structure[rows],
            z[rows],
            value[rows],
            precision[rows],
        )
        gradient, matrix = normal_equations(targets, host, current)
        precision[rows] = matrix
        points = _attempts(host, current.z, gradient, matrix, damping[rows])
        num = len(_DAMPING_FACTORS)
        tried = evaluate_points(
            targets,
            np.repeat(current.index, num),
            np.repeat(current.structure, num),
            points.reshape(-1, points.shape[-1]),
        ).log_density.reshape(-1, num)
        best = np.argmax(np.where(np.isnan(tried), -np.inf, tried), axis=1)
        each = np.arange(len(rows))
        found = tried[each, best]
        is_better = found > value[rows]
        gain = np.where(is_better, found - value[rows], 0.0)
        z[rows] = np.where(is_better[:, None], points[each, best], z[rows])
        value[rows] = np.where(is_better, found, value[rows])
        factor = np.where(is_better, 0.5 * _DAMPING_FACTORS[best], 20.0)
        damping[rows] = np.clip(damping[rows] * factor, 1e-6, 1e4)
        has_arrived = is_better & (gain < _ARRIVED) | (damping[rows] > 1e3)
        is_moving[rows] = ~has_arrived
    return Fits(fits.index, fits.structure, z, value, precision)


def normal_equations(
    targets: StructureTarget, host: Host, fits: Fits
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of minus the log-density, and its Gauss-Newton matrix, of each point.

    A uniform prior counts there by its variance, as much as leaves the matrix regular.

    Rows of coordinates that are not in use are those of the identity.
    """
    dim = fits.z.shape[1]
    in_use = host.in_use[fits.structure]
    size = np.dtype(targets.log_prior.dtype).itemsize
    low, high = _DIFFERENCE_LIMITS[size]
    length = np.diagonal(fits.precision, axis1=1, axis2=2)
    delta = np.clip(_DIFFERENCE / np.sqrt(np.maximum(length, 1.0)), low, high)
    fit, coordinate = np.nonzero(in_use)
    moved = fits.z[fit].copy()
    moved[np.arange(len(fit)), coordinate] += delta[fit, coordinate]
    found = evaluate_points(
        targets,
        np.concatenate([fits.index, fits.index[fit]]),
        np.concatenate([fits.structure, fits.structure[fit]]),
        np.concatenate([fits.z, moved]),
        with_innovations=True,
    )
    assert found.innovation is not None
    innovation = found.innovation.astype(float)
    u, changed = innovation[: len(fits.z)], innovation[len(fits.z) :]
    jacobian = np.zeros((len(fits.z), dim, u.shape[1]))
    jacobian[fit, coordinate] = (changed - u[fit]) / delta[fit, coordinate][:, None]
    jacobian = np.where(np.isfinite(jacobian), jacobian, 0.0)
    num, square = found.num[: len(fits.z)], found.square[: len(fits.z)]
    weight = (NOISE_SHAPE + 0.5 * num) / (
        host.rate[fits.index, fits.structure] + 0.5 * square
    )
    weight = np.where(np.isfinite(weight), weight, 0.0)[..., _GROUP]
    weight = np.tile(weight.reshape(len(fits.z), -1), (1, u.shape[1] // weight[0].size))
    weighted = jacobian * weight[:, None]
    gradient = np.einsum("fdr,fr->fd", weighted, np.nan_to_num(u))
    matrix = weighted @ np.swapaxes(jacobian, 1, 2)
    return with_prior(host, fits.structure, fits.z, gradient, matrix)


def with_prior(
    host: Host,
    structure: np.ndarray,
    z: np.ndarray,
    gradient: np.ndarray,
    matrix: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient and Gauss-Newton matrix of points with what the prior adds to them.

    Args:
        host: of the targets.
        structure: of each point.
        z: coordinates of each point, `[point, dim]`.
        gradient: of minus the log-likelihood.
        matrix: of it, `[point, dim, dim]`.

    Returns:
        Both, and rows of coordinates that are not in use are those of the identity.
    """
    in_use = host.in_use[structure]
    prior = in_use & host.is_normal[None]
    gradient = gradient + np.where(prior, z, 0.0)
    each = np.arange(z.shape[1])
    # A direction that nothing tells of is as wide as all there are.
    width = np.where(host.period > 0, host.period, np.inf)
    matrix = matrix.copy()
    matrix[:, each, each] += prior + in_use * 12.0 / width**2
    both = in_use[:, :, None] & in_use[:, None, :]
    matrix = np.where(both, matrix, np.eye(z.shape[1])[None])
    return np.where(in_use, gradient, 0.0), matrix


def _attempts(host: Host, z, gradient, matrix, damping) -> np.ndarray:
    """Damped steps for three dampings, `[fit, 3, dim]`."""
    length = np.sqrt(np.maximum(np.diagonal(matrix, axis1=1, axis2=2), 1e-6))
    unit = matrix / (length[:, :, None] * length[:, None, :])
    strength = damping[:, None] * _DAMPING_FACTORS[None]
    eye = np.eye(z.shape[1])
    damped = unit[:, None] + strength[..., None, None] * eye
    right = np.repeat((gradient / length)[:, None, :], strength.shape[1], axis=1)
    step = np.linalg.solve(damped, right[..., None])[..., 0] / length[:, None, :]
    points = z[:, None, :] - step
    return host.wrap(np.where(np.isfinite(points), points, z[:, None, :]))


def collect_modes(
    targets: StructureTarget,
    fits: Fits,
    num_modes: int,
    lack: np.ndarray | None = None,
) -> Modes:
    """Distinct optima of every structure, padded to equal numbers.

    Args:
        targets: stacked along a leading object axis.
        fits: of all structures.
        num_modes: most of each structure.
        lack: as for `climb`; structures that lack more have their best fit, as it is.
    """
    num_objects, num_structures = targets.structures.shape[:2]
    host = Host.of(targets)
    few = best_of_each(fits, num_structures, 2 * num_modes)
    left = few.take(np.zeros(0, int))
    if lack is not None:
        groups = FitGroups(few.index, few.structure, num_objects, num_structures)
        is_worth = groups.is_worth(few.value, lack)
        left = best_of_each(few.take(~is_worth), num_structures, 1)
        few = few.take(is_worth)
    _, matrix = normal_equations(targets, host, few)
    few = best_of_each(
        few._replace(precision=matrix), num_structures, num_modes, min_distance=3.0
    )
    few = join_fits(few, left)
    dim, total = few.z.shape[1], num_structures * num_modes
    z = np.zeros((num_objects, total, dim))
    precision = np.tile(np.eye(dim), (num_objects, total, 1, 1))
    value = np.full((num_objects, total), -np.inf)
    rank = np.zeros(len(few.value), int)
    for row in range(1, len(rank)):
        same = (
            few.index[row] == few.index[row - 1]
            and few.structure[row] == few.structure[row - 1]
        )
        rank[row] = rank[row - 1] + 1 if same else 0
    place = few.structure * num_modes + rank
    z[few.index, place] = few.z
    precision[few.index, place] = few.precision
    value[few.index, place] = few.value
    structure = np.repeat(np.arange(num_structures), num_modes)
    dtype = targets.log_prior.dtype
    return Modes(
        structure=on_device(
            np.broadcast_to(structure, (num_objects, total)), np.dtype(np.int32)
        ),
        z=on_device(z, dtype),
        precision=on_device(precision, dtype),
        log_density=on_device(value, dtype),
    )
