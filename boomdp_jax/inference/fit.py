r"""Find the modes of every structure: many starts, Gauss-Newton with damping.

With the noise integrated out the gradient of the log-likelihood is $-J^T W r$ with
weights W that depend on the residuals r themselves; $J^T W J$ plus the prior's
identity serves as the Hessian (the part left out is of rank one per noise group).
Levenberg (1944) and Marquardt (1963), with three dampings tried at a time.

The loop over iterations runs on the host, so that the physics is compiled once for
values and once for Jacobians, whatever the number of stages.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import Key
from boomdp_jax.inference.one_step import (
    NoiseStatistics,
    group_sums,
    noise_precision,
)
from boomdp_jax.inference.seeds import random_starts
from boomdp_jax.inference.target import StructureTarget

# Step of the differences, in prior standard deviations: small beside any posterior
# width that data allow, large beside the rounding of single precision.
_DIFFERENCE = 1e-3


class FitSettings(NamedTuple):
    """How hard to look for modes; numbers are per structure."""

    num_draws: int = 64
    """Starts whose density is looked at."""
    num_starts: int = 4
    """Best of them that are fitted."""
    num_iterations: int = 12
    """Of each of the two rounds: from anywhere, and from smaller structures' modes."""
    num_modes: int = 3
    """Distinct modes that are kept."""


class Modes(NamedTuple):
    """Modes of all structures."""

    structure: Int[Array, "*object mode"]
    z: Float[Array, "*object mode dim"]
    precision: Float[Array, "*object mode dim dim"]
    log_density: Float[Array, "*object mode"]
    """Minus infinity where a structure has no further mode."""


def fit_modes(
    key: Key, targets: StructureTarget, settings: FitSettings | None = None
) -> Modes:
    """Fit every structure of many objects from many starts; keep distinct optima.

    Args:
        key: source of starts.
        targets: with a `OneStepLikelihood`, stacked along a leading object axis.
        settings: how hard to look.

    Returns:
        Up to `num_modes` modes per structure and object.
    """
    settings = FitSettings() if settings is None else settings
    num_objects, num_structures = targets.structures.shape[:2]
    keys = jax.random.split(key, (2, num_objects))
    draws = _first_draws(keys[0], targets, settings.num_draws)
    z, value = _fit(targets, draws, settings)
    best = jnp.take_along_axis(z, jnp.argmax(value, axis=2)[..., None, None], axis=2)
    grown = _grown_draws(keys[1], targets, best[:, :, 0], settings.num_draws)
    more, more_value = _fit(targets, grown, settings)
    z = jnp.concatenate([z, more], axis=2)
    value = jnp.concatenate([value, more_value], axis=2)
    found = []
    for _ in range(settings.num_modes):
        index = jnp.argmax(value, axis=2)
        top = jnp.take_along_axis(z, index[..., None, None], axis=2)
        height = jnp.take_along_axis(value, index[..., None], axis=2)
        _, precision = _normal_equations(targets, _padded(top, settings))
        precision = precision[:, :, :1]
        found.append((top[:, :, 0], precision[:, :, 0], height[:, :, 0]))
        value = _strike_out(targets, z, value, top[:, :, 0], precision[:, :, 0])
    num = num_structures * settings.num_modes
    z, precision, value = (jnp.stack(part, axis=2) for part in zip(*found, strict=True))
    structure = jnp.repeat(jnp.arange(num_structures), settings.num_modes)
    return Modes(
        structure=jnp.broadcast_to(structure, (num_objects, num)),
        z=z.reshape(num_objects, num, -1),
        precision=precision.reshape(num_objects, num, z.shape[-1], z.shape[-1]),
        log_density=value.reshape(num_objects, num),
    )


def _padded(points, settings: FitSettings):
    """As many copies as there are starts, to reuse the compiled program."""
    return jnp.repeat(points, settings.num_starts, axis=2)


def _fit(targets: StructureTarget, draws, settings: FitSettings):
    """Take the best draws of every structure to their optima.

    Returns:
        Optima `[object structure start dim]` and log-densities.
    """
    value = _log_densities(targets, draws)
    value, index = jax.lax.top_k(value, settings.num_starts)
    z = jnp.take_along_axis(draws, index[..., None], axis=2)
    damping = jnp.full(value.shape, 0.1, value.dtype)
    num_draws = draws.shape[2]
    for _ in range(settings.num_iterations):
        gradient, matrix = _normal_equations(targets, z)
        points = _attempts(z, gradient, matrix, damping)
        flat = points.reshape(*points.shape[:2], -1, points.shape[-1])
        # Filled up to the number of draws: one compiled program serves both.
        missing = num_draws - flat.shape[2]
        if missing > 0:
            filler = jnp.repeat(flat[:, :, :1], missing, axis=2)
            flat = jnp.concatenate([flat, filler], axis=2)
        values = _log_densities(targets, flat)[:, :, : num_draws - max(missing, 0)]
        values = values.reshape(points.shape[:-1])
        z, value, damping = _choose(targets, z, value, damping, points, values)
    return z, value


@eqx.filter_jit
def evaluate_points(
    targets: StructureTarget,
    structure: Int[Array, "object point"],
    z: Float[Array, "object point dim"],
) -> tuple[Float[Array, "object point"], NoiseStatistics]:
    """Log-density and noise statistics at many points of many objects.

    Args:
        targets: with a `OneStepLikelihood`, stacked along a leading object axis.
        structure: of each point.
        z: coordinates of each point.

    Returns:
        Log-densities, and counts and sums of squares `[object, point, body, 4]`.
    """

    def one(target, k, z):
        likelihood: Any = target.log_likelihood
        statistics = likelihood.statistics(z, target.structures[k])
        value = likelihood.log_marginal(statistics)
        return target.log_prior_density(k, z) + value, statistics

    return jax.vmap(jax.vmap(one, (None, 0, 0)))(targets, structure, z)


def _log_densities(targets: StructureTarget, z: Float[Array, "o k n dim"]):
    num_objects, num_structures, num, dim = z.shape
    structure = jnp.repeat(jnp.arange(num_structures), num)
    structure = jnp.broadcast_to(structure, (num_objects, num_structures * num))
    flat = z.reshape(num_objects, -1, dim)
    return evaluate_points(targets, structure, flat)[0].reshape(z.shape[:3])


@eqx.filter_jit
def _normal_equations(targets: StructureTarget, points: Float[Array, "o k n dim"]):
    def one_object(target, points):
        structures = jnp.arange(target.num_structures)
        each = jax.vmap(lambda k, z: gauss_newton(target, k, z), (None, 0))
        return jax.vmap(each)(structures, points)

    return jax.vmap(one_object)(targets, points)


def gauss_newton(
    target: StructureTarget, structure: Int[Array, ""], z: Float[Array, " dim"]
) -> tuple[Float[Array, " dim"], Float[Array, "dim dim"]]:
    """Gradient of minus the log-density, and its Gauss-Newton matrix.

    The Jacobian is by differences: one plain prediction per coordinate, all in one
    batch, at the full speed of the engine.

    Args:
        target: with a `OneStepLikelihood`.
        structure: which one.
        z: coordinates.

    Returns:
        Gradient and matrix; rows of coordinates not in use are those of the identity.
    """
    likelihood: Any = target.log_likelihood
    active = target.structures[structure]
    offsets = _DIFFERENCE * jnp.eye(target.dim, dtype=z.dtype)
    points = z[None] + jnp.concatenate([jnp.zeros_like(z)[None], offsets])
    every = jax.vmap(lambda p: likelihood.residuals(p, active))(points)
    r, shape = every[0], (target.dim, -1)
    jacobian = (every[1:] - every[:1]).reshape(shape).T / _DIFFERENCE
    statistics = NoiseStatistics(group_sums(likelihood.data.mask), group_sums(r**2))
    scale = likelihood.coordinates.scales.noise
    weight = noise_precision(statistics, scale)[None]
    weight = jnp.broadcast_to(weight, r.shape).reshape(-1)
    jacobian = jnp.where(jnp.isfinite(jacobian), jacobian, 0.0)
    in_use = target.in_use(structure)
    is_normal = in_use & (target.period == 0)
    weighted = jacobian * weight[:, None]
    gradient = weighted.T @ r.reshape(-1) + jnp.where(is_normal, z, 0.0)
    matrix = weighted.T @ jacobian + jnp.diag(is_normal.astype(z.dtype))
    both = in_use[:, None] & in_use[None, :]
    return (
        jnp.where(in_use, gradient, 0.0),
        jnp.where(both, matrix, jnp.eye(target.dim, dtype=z.dtype)),
    )


@jax.jit
def _attempts(z, gradient, matrix, damping):
    """Damped steps for three dampings, `[... start 3 dim]`."""
    diagonal = jnp.diagonal(matrix, axis1=-2, axis2=-1)
    length = jnp.sqrt(jnp.maximum(diagonal, 1e-6))
    unit = matrix / (length[..., :, None] * length[..., None, :])
    factors = jnp.asarray([0.1, 1.0, 10.0], z.dtype)
    strength = jnp.stack([damping * factor for factor in factors], axis=-1)
    eye = jnp.broadcast_to(jnp.eye(z.shape[-1], dtype=z.dtype), unit.shape)
    eye = eye[..., None, :, :]
    damped = unit[..., None, :, :] + strength[..., None, None] * eye
    right = jnp.broadcast_to(
        (gradient / length)[..., None, :], (*strength.shape, z.shape[-1])
    )
    step = jnp.linalg.solve(damped, right[..., None])[..., 0] / length[..., None, :]
    points = z[..., None, :] - step
    return jnp.where(jnp.isfinite(points), points, z[..., None, :])


@eqx.filter_jit
def _choose(targets: StructureTarget, z, value, damping, points, values):
    """The best attempt where it is better, and the next damping."""
    values = jnp.where(jnp.isnan(values), -jnp.inf, values)
    index = jnp.argmax(values, axis=-1)
    best = jnp.take_along_axis(values, index[..., None], axis=-1)[..., 0]
    point = jnp.take_along_axis(points, index[..., None, None], axis=-2)[..., 0, :]
    is_better = best > value
    factor = jnp.asarray([0.1, 1.0, 10.0], z.dtype)[index]
    damping = jnp.where(is_better, damping * factor * 0.5, damping * 20.0)
    z = jnp.where(is_better[..., None], point, z)
    wrap = jax.vmap(lambda t, p: jax.vmap(jax.vmap(t.wrap))(p))
    return (
        wrap(targets, z),
        jnp.where(is_better, best, value),
        jnp.clip(damping, 1e-6, 1e4),
    )


@eqx.filter_jit
def _strike_out(targets: StructureTarget, z, value, taken, precision):
    """Drop candidates within three standard deviations of an optimum already taken."""

    def one(target, z, value, taken, precision):
        offset = jax.vmap(target.wrap)(z - taken[None])
        distance = jnp.einsum("pi,ij,pj->p", offset, precision, offset)
        return jnp.where(distance < 9.0, -jnp.inf, value)

    over = jax.vmap(jax.vmap(one, (None, 0, 0, 0, 0)))
    return over(targets, z, value, taken, precision)


@eqx.filter_jit
def _first_draws(keys, targets: StructureTarget, num: int):
    """Starts for every structure, coordinates not in use at zero."""

    def one(key, target):
        likelihood = target.log_likelihood
        draws = random_starts(key, likelihood.coordinates, likelihood.data, num)
        in_use = jax.vmap(target.in_use)(jnp.arange(target.num_structures))
        return jnp.where(in_use[:, None], draws[None], 0.0)

    return jax.vmap(one)(keys, targets)


@eqx.filter_jit
def _grown_draws(keys, targets: StructureTarget, best, num: int):
    """Modes of structures with one slot less, the slot's coordinates from the prior.

    A structure that no smaller one leads to gets its own mode. The first draw of every
    structure is its own mode, so that the second round also polishes the first.
    """

    def one(key, target, best):
        likelihood = target.log_likelihood
        block = random_starts(key, likelihood.coordinates, likelihood.data, num)
        num_slots = max(target.structures.shape[1], 1)

        def starts(structure):
            active = target.structures[structure]
            slot = jnp.arange(num) % num_slots
            smaller = active[None] & (
                jnp.arange(active.shape[0])[None] != slot[:, None]
            )
            is_same = jnp.all(smaller[:, None] == target.structures[None], axis=-1)
            parent = jnp.where(
                jnp.any(is_same, axis=1), jnp.argmax(is_same, axis=1), structure
            )
            is_new = target.in_use(structure)[None] & ~jax.vmap(target.in_use)(parent)
            z = jnp.where(is_new, block, best[parent])
            return z.at[0].set(best[structure])

        return jax.vmap(starts)(jnp.arange(target.num_structures))

    return jax.vmap(one)(keys, targets, best)
