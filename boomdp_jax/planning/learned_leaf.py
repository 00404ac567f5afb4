r"""A leaf value learnt from what states turned out to be worth.

For where neither a formula nor a fair policy is at hand: values that long plans found,
or returns that episodes had, are smoothed into a function on which short plans end.
With coordinates $x$ in units of their spread over the states and `num_features` of
$\varphi_i(x) = \sqrt{2/n} \cos(\omega_i \cdot x + b_i)$, where $\omega_i$ is normal
and $b_i$ uniform, $V = \bar V + w \cdot \varphi(x)$ by ridge regression: a Gaussian
kernel, in time that is linear in the number of states (Rahimi and Recht 2007, Random
features for large-scale kernel machines).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.planning.grid import CoordinatesFn, all_numbers
from boomdp_jax.planning.problem import check_number, check_positive


class LearnedLeaf(eqx.Module):
    """A leaf function: the same for all hypotheses."""

    coordinates_fn: CoordinatesFn
    centre: Float[Array, " channel"]
    scale: Float[Array, " channel"]
    """Of the states that it was learnt from, in units of the coordinates."""
    frequency: Float[Array, "feature channel"]
    phase: Float[Array, " feature"]
    weight: Float[Array, " feature"]
    mean: FloatScalar
    bounds: Float[Array, "2"]
    """Least and largest value that it was learnt from; it says nothing beyond."""

    @full_precision
    def __call__(self, hypothesis: PyTree, state: PyTree) -> FloatScalar:
        """Value of a state.

        Args:
            hypothesis: what the world is taken to be; it makes no difference.
            state: where a plan ends.

        Returns:
            The value; where nothing near was learnt from, about the mean of all.
        """
        del hypothesis
        value = self.mean + self._features(state) @ self.weight
        return jnp.clip(value, self.bounds[0], self.bounds[1])

    @full_precision
    def _features(self, state: PyTree) -> Float[Array, " feature"]:
        x = jnp.asarray(self.coordinates_fn(state), self.scale.dtype)
        angle = self.frequency @ ((x - self.centre) / self.scale) + self.phase
        return jnp.sqrt(2.0 / self.phase.shape[0]) * jnp.cos(angle)


def learned_leaf(
    key: Key,
    states: PyTree,
    values: Float[Array, " state"],
    *,
    coordinates_fn: CoordinatesFn | None = None,
    length_scale: float = 1.0,
    num_features: int = 256,
    ridge: float = 1e-6,
) -> LearnedLeaf:
    """Learn a leaf function from states and their values.

    Args:
        key: random key of the features; the same one, so that a leaf that learns goes
            on smoothly.
        states: leading axis `state`.
        values: of each state: `Plan.value` of a long plan, or the return of an episode
            from there on.
        coordinates_fn: coordinates of a state, as one vector; default: its numbers.
        length_scale: over which values are alike, in standard deviations of the
            coordinates.
        num_features: cosines that the function is made of; the cost is quadratic.
        ridge: variance of a value's error, over that of the values.

    Returns:
        `leaf_fn` of any planner; one learnt anew shares the compiled program.

    Raises:
        ValueError: no state, another number of values than of states, or a number that
            is not positive.
    """
    num_features = check_positive("num_features", num_features)
    for name, value in (("length_scale", length_scale), ("ridge", ridge)):
        check_number(name, value, "above 0", lambda number: number > 0)
    values = jnp.asarray(values, float)
    num_states = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(states)}
    if values.ndim != 1 or not values.size or num_states != {values.shape}:
        raise ValueError(
            "values: expected one number for each state, at least one; got shape "
            f"{values.shape} and states of leading axes {sorted(num_states)}"
        )
    coordinates_fn = coordinates_fn or all_numbers
    return _fit(key, states, values, coordinates_fn, length_scale, num_features, ridge)


@eqx.filter_jit
@full_precision
def _fit(
    key: Key,
    states: PyTree,
    values: Float[Array, " state"],
    coordinates_fn: CoordinatesFn,
    length_scale: Any,
    num_features: int,
    ridge: Any,
) -> LearnedLeaf:
    """What `learned_leaf` compiles."""
    x = jax.vmap(lambda s: jnp.asarray(coordinates_fn(s), values.dtype))(states)
    spread = jnp.std(x, axis=0)
    frequency_key, phase_key = jax.random.split(key)
    shape = (num_features, x.shape[1])
    mean = jnp.mean(values)
    leaf = LearnedLeaf(
        coordinates_fn,
        centre=jnp.mean(x, axis=0),
        # A coordinate in which the states do not differ tells nothing.
        scale=jnp.where(spread > 0, spread, 1.0) * length_scale,
        frequency=jax.random.normal(frequency_key, shape, values.dtype),
        phase=jax.random.uniform(
            phase_key, (num_features,), values.dtype, maxval=2 * jnp.pi
        ),
        weight=jnp.zeros(num_features, values.dtype),
        mean=mean,
        bounds=jnp.stack([jnp.min(values), jnp.max(values)]),
    )
    features = jax.vmap(leaf._features)(states)
    # Least squares of stacked rows: the normal equations would square the condition.
    rows = jnp.concatenate([features, jnp.sqrt(ridge) * jnp.eye(num_features)])
    target = jnp.concatenate([values - mean, jnp.zeros(num_features, values.dtype)])
    q, r = jnp.linalg.qr(rows)
    weight = jax.scipy.linalg.solve_triangular(r, q.T @ target)
    return eqx.tree_at(lambda leaf: leaf.weight, leaf, weight)
