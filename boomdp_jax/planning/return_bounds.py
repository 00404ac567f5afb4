r"""Between which bounds a return lies, told before anything is searched.

With rewards of a step in $[l, u]$, leaf values in $[l_0, u_0]$, a discount $γ$, $n$
steps left and an episode that may end after any of them, the return lies in
$[l_n, u_n]$:
$$l_n = l + γ \min(l_{n-1}, 0), \qquad u_n = u + γ \max(u_{n-1}, 0).$$
Functions of the state may say more.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import FloatScalar, IntScalar
from boomdp_jax.planning.problem import Problem, zero_leaf

BoundFn = Callable[[Any, Any, Any], Any]


class ReturnBounds(eqx.Module):
    """A lower and an upper bound of what is to be had from a state."""

    lower: BoundFn | Float[Array, " left"]
    """Function of hypothesis, state and number of decisions left; or the same for all
    states, by the number of decisions left."""
    upper: BoundFn | Float[Array, " left"]

    def __call__(
        self, hypothesis: PyTree, state: PyTree, num_left: IntScalar
    ) -> tuple[FloatScalar, FloatScalar]:
        """Bound the return of the best plan from a state.

        Args:
            hypothesis: what the world is taken to be.
            state: where the plan begins.
            num_left: decisions before the horizon.

        Returns:
            Lower and upper bound.
        """

        def evaluate(bound):
            if callable(bound):
                return jnp.asarray(bound(hypothesis, state, num_left), float)
            return bound[num_left]

        return evaluate(self.lower), evaluate(self.upper)


def make_bounds(
    problem: Problem,
    depth: int,
    *,
    value_bounds: tuple[Any, Any] | None = None,
    leaf_bounds: tuple[Any, Any] | None = None,
    lower_fn: BoundFn | None = None,
    upper_fn: BoundFn | None = None,
) -> ReturnBounds:
    """Put together what is known of returns.

    Args:
        problem: what is planned for.
        depth: decisions up to the horizon.
        value_bounds: least and largest reward of one step of the model.
        leaf_bounds: least and largest leaf value; not needed without `leaf_fn`.
        lower_fn: function of hypothesis, state and number of decisions left, in the
            place of a bound by rewards.
        upper_fn: the same for the upper bound.

    Returns:
        The bounds.

    Raises:
        TypeError: a function is not one.
        ValueError: a side without a bound, bounds in the wrong order.
    """
    if value_bounds is None and (lower_fn is None or upper_fn is None):
        raise ValueError(
            "value_bounds: needed unless both lower_fn and upper_fn are given; "
            "expected the least and the largest reward of one step"
        )
    for name, function in (("lower_fn", lower_fn), ("upper_fn", upper_fn)):
        if function is not None and not callable(function):
            raise TypeError(f"{name}: expected a function; got {function!r}")
    for name, pair in (("value_bounds", value_bounds), ("leaf_bounds", leaf_bounds)):
        if pair is None or any(isinstance(bound, jax.core.Tracer) for bound in pair):
            continue
        if not pair[0] <= pair[1]:
            raise ValueError(f"{name}: expected (lower, upper), in order; got {pair}")
    if leaf_bounds is None:
        if problem.leaf_fn is not zero_leaf and (lower_fn is None or upper_fn is None):
            raise ValueError(
                "leaf_bounds: leaf_fn is given, so rewards alone do not bound the "
                "return; expected the least and the largest leaf value"
            )
        leaf_bounds = (0.0, 0.0)
    reward_bounds = (0.0, 0.0) if value_bounds is None else value_bounds

    def table(side: int, worst: Callable) -> Float[Array, " left"]:
        return _bounds_of_rewards(
            jnp.asarray(reward_bounds[side], float),
            jnp.asarray(leaf_bounds[side], float),
            problem.discount,
            worst,
            depth,
            problem.action_repeat,
        )

    return ReturnBounds(
        table(0, jnp.minimum) if lower_fn is None else lower_fn,
        table(1, jnp.maximum) if upper_fn is None else upper_fn,
    )


@eqx.filter_jit
def _bounds_of_rewards(
    reward: FloatScalar,
    leaf: FloatScalar,
    discount: FloatScalar,
    worst: Callable,
    depth: int,
    action_repeat: int,
) -> Float[Array, " left"]:
    """The recursion of one side, read where a decision is due."""

    def one(bound, _):
        bound = reward + discount * worst(bound, 0.0)
        return bound, bound

    _, bounds = jax.lax.scan(one, leaf, length=depth * action_repeat)
    return jnp.concatenate([leaf[None], bounds[action_repeat - 1 :: action_repeat]])
