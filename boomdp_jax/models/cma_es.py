r"""Covariance matrix adaptation: search without derivatives, as ask and tell.

A normal distribution $N(m, s^2 C)$ moves to the better half of what it drew, its
covariance learns from the steps that helped, and its scale from how straight its path
is: all constants are those of Hansen (2016), The CMA evolution strategy: a tutorial,
table 1, without negative weights. To be preferred where derivatives are missing or
mislead, at a hundred or more evaluations per number.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar, IntScalar, Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.models.table import check_at_least

# Scales beyond which a search has run away, or stands still.
_SCALE_LIMITS = (1e-12, 1e6)


class CmaState(eqx.Module):
    """Where the distribution is, and the best point so far."""

    mean: Float[Array, " dim"]
    scale: FloatScalar
    """s."""
    covariance: Float[Array, "dim dim"]
    scale_path: Float[Array, " dim"]
    shape_path: Float[Array, " dim"]
    num_told: IntScalar
    """Generations so far."""
    best: Float[Array, " dim"]
    best_value: FloatScalar


class _Constants(NamedTuple):
    """Of Hansen's table 1, for some dimension and population."""

    weight: np.ndarray
    mass: float
    scale_rate: float
    damping: float
    shape_rate: float
    rank_one: float
    rank_many: float
    length: float


def cma_init(mean: Float[Array, " dim"], scale: FloatScalar | float) -> CmaState:
    """A search that begins about a point.

    Args:
        mean: the point.
        scale: how far about it, the same for all numbers.

    Returns:
        The state; nothing was evaluated yet.
    """
    dim = mean.shape[0]
    return CmaState(
        mean=mean,
        scale=jnp.asarray(scale, mean.dtype),
        covariance=jnp.eye(dim, dtype=mean.dtype),
        scale_path=jnp.zeros_like(mean),
        shape_path=jnp.zeros_like(mean),
        num_told=jnp.zeros((), jnp.int32),
        best=mean,
        best_value=jnp.asarray(jnp.inf, mean.dtype),
    )


@full_precision
def cma_ask(
    key: Key, state: CmaState, population: int
) -> Float[Array, "population dim"]:
    """Points that should be evaluated.

    Args:
        key: random key.
        state: of the search.
        population: how many.

    Returns:
        Draws of the distribution.
    """
    root, _ = _roots(state.covariance)
    white = jax.random.normal(key, (population, len(state.mean)), state.mean.dtype)
    return state.mean[None] + state.scale * white @ root.T


@full_precision
def cma_tell(
    state: CmaState,
    points: Float[Array, "population dim"],
    values: Float[Array, " population"],
) -> CmaState:
    """Learn from a generation.

    Args:
        state: when the points were asked for.
        points: of `cma_ask`.
        values: of each, to be made small; what is not a number counts as infinite.

    Returns:
        The state after it.
    """
    dim = points.shape[1]
    c = _constants(dim, points.shape[0])
    values = jnp.where(jnp.isnan(values), jnp.inf, values)
    order = jnp.argsort(values)
    chosen = order[: len(c.weight)]
    weight = jnp.asarray(c.weight, points.dtype)
    steps = (points[chosen] - state.mean[None]) / state.scale
    step = weight @ steps
    _, inverse_root = _roots(state.covariance)
    keep = 1.0 - c.scale_rate
    scale_path = keep * state.scale_path + math.sqrt(
        c.scale_rate * (2.0 - c.scale_rate) * c.mass
    ) * (inverse_root @ step)
    length = jnp.sqrt(jnp.sum(scale_path**2))
    num_told = state.num_told + 1
    settled = 1.0 - keep ** (2.0 * num_told)
    # A long path says that the scale grows; the shape then waits.
    waits = length / jnp.sqrt(settled) >= (1.4 + 2.0 / (dim + 1)) * c.length
    rate, one = c.shape_rate, c.rank_one
    moves = jnp.where(waits, 0.0, math.sqrt(rate * (2.0 - rate) * c.mass))
    shape_path = (1.0 - rate) * state.shape_path + moves * step
    kept = 1.0 - one - c.rank_many + jnp.where(waits, one * rate * (2.0 - rate), 0.0)
    covariance = (
        kept * state.covariance
        + one * shape_path[:, None] * shape_path[None]
        + c.rank_many * (steps.T * weight[None]) @ steps
    )
    growth = jnp.exp(c.scale_rate / c.damping * (length / c.length - 1.0))
    is_better = values[order[0]] < state.best_value
    return CmaState(
        mean=state.mean + state.scale * step,
        scale=jnp.clip(state.scale * growth, *_SCALE_LIMITS),
        covariance=0.5 * (covariance + covariance.T),
        scale_path=scale_path,
        shape_path=shape_path,
        num_told=num_told,
        best=jnp.where(is_better, points[order[0]], state.best),
        best_value=jnp.where(is_better, values[order[0]], state.best_value),
    )


def cma_minimise(
    key: Key,
    fn: Callable[[Float[Array, " dim"]], FloatScalar],
    start: Float[Array, " dim"],
    *,
    scale: float = 0.5,
    num_generations: int = 100,
    population: int = 16,
) -> CmaState:
    """Search for the least value of a function, in one compiled loop.

    Args:
        key: random key.
        fn: to be made small.
        start: about where.
        scale: how far about it at first.
        num_generations: how often the distribution moves.
        population: evaluations each time.

    Returns:
        The last state; `best` is the best point, the start included.

    Raises:
        ValueError: a population below four, no generation, a scale not positive.
    """
    check_at_least("population", population, 4)
    check_at_least("num_generations", num_generations, 1)
    if not scale > 0:
        raise ValueError(f"scale: expected a positive number, got {scale}")

    def generation(state: CmaState, key: Key) -> tuple[CmaState, None]:
        points = cma_ask(key, state, population)
        return cma_tell(state, points, jax.vmap(fn)(points)), None

    first = cma_init(start, scale)
    value = fn(start)
    value = jnp.where(jnp.isnan(value), jnp.inf, value)
    first = eqx.tree_at(lambda state: state.best_value, first, value)
    keys = jax.random.split(key, num_generations)
    return jax.lax.scan(generation, first, keys)[0]


def _constants(dim: int, population: int) -> _Constants:
    half = population // 2
    raw = math.log((population + 1) / 2) - np.log(np.arange(1, half + 1))
    weight = raw / raw.sum()
    mass = float(1.0 / np.sum(weight**2))
    scale_rate = (mass + 2.0) / (dim + mass + 5.0)
    rank_one = 2.0 / ((dim + 1.3) ** 2 + mass)
    rank_many = 2.0 * (mass - 2.0 + 1.0 / mass) / ((dim + 2.0) ** 2 + mass)
    return _Constants(
        weight=weight,
        mass=mass,
        scale_rate=scale_rate,
        damping=1.0
        + 2.0 * max(0.0, math.sqrt((mass - 1.0) / (dim + 1.0)) - 1.0)
        + scale_rate,
        shape_rate=(4.0 + mass / dim) / (dim + 4.0 + 2.0 * mass / dim),
        rank_one=rank_one,
        rank_many=max(min(1.0 - rank_one, rank_many), 0.0),
        length=math.sqrt(dim) * (1.0 - 1.0 / (4.0 * dim) + 1.0 / (21.0 * dim**2)),
    )


@full_precision
def _roots(
    covariance: Float[Array, "dim dim"],
) -> tuple[Float[Array, "dim dim"], Float[Array, "dim dim"]]:
    """A root of a covariance, and the inverse of its symmetric root."""
    square, axes = jnp.linalg.eigh(covariance)
    least = jnp.finfo(square.dtype).eps * jnp.max(square)
    root = jnp.sqrt(jnp.maximum(square, least))
    return axes * root[None], (axes / root[None]) @ axes.T
