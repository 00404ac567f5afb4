r"""What is planned for: a model, a reward, actions, and how time is cut.

Planners know nothing of the world but these functions:

- `transition_fn(key, hypothesis, state, action) -> (next_state, done)`,
- `reward_fn(hypothesis, state, action, next_state) -> reward`,
- `leaf_fn(hypothesis, state) -> value`, what is to be had from a state at the horizon.

An action may be held for several steps, which are then one step of the plan: with
$n$ steps of reward $r_i$ and discount $\gamma$ its reward is
$\sum_{i<n} \gamma^i r_i$, and what follows counts by $\gamma^n$, or by nothing where
the episode ended on the way.
"""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from boomdp_jax.core.arrays import FloatScalar, Key

TransitionFn = Callable[[Any, Any, Any, Any], tuple[Any, Any]]
RewardFn = Callable[[Any, Any, Any, Any], Any]
LeafFn = Callable[[Any, Any], Any]


class Outcome(NamedTuple):
    """What holding an action leads to."""

    state: PyTree
    """Where it ends."""
    reward: FloatScalar
    """Sum over the steps, discounted to the first."""
    continuation: FloatScalar
    """What the future counts by: $\\gamma^n$, 0 where the episode ended."""


class Problem(eqx.Module):
    """A model and what is wanted of it."""

    transition_fn: TransitionFn
    reward_fn: RewardFn
    leaf_fn: LeafFn
    actions: PyTree
    """Leading axis `action`."""
    discount: FloatScalar
    """Of one step of the model."""
    action_repeat: int = eqx.field(static=True)
    """Steps of the model for which an action is held."""

    @property
    def num_actions(self) -> int:
        """How many there are to choose from."""
        return jax.tree.leaves(self.actions)[0].shape[0]

    def action(self, index: Any) -> PyTree:
        """The action at an index."""
        return jax.tree.map(lambda leaf: leaf[index], self.actions)

    def hold(self, key: Key, hypothesis: PyTree, state: PyTree, action: PyTree):
        """Hold an action for `action_repeat` steps.

        Args:
            key: random key.
            hypothesis: what the world is taken to be.
            state: where it starts.
            action: one action.

        Returns:
            The `Outcome`.
        """

        def one(carry, number):
            state, reward, alive = carry
            now = key if self.action_repeat == 1 else jax.random.fold_in(key, number)
            result = self.transition_fn(now, hypothesis, state, action)
            moved, done = _checked_step(result, state)
            gain = jnp.asarray(self.reward_fn(hypothesis, state, action, moved))
            _check_scalar("reward_fn", gain)
            moved = jax.tree.map(_as_before, moved, state)
            if done is False:
                # An episode without an end needs no looking whether it is over.
                return (moved, reward + alive * gain, alive * self.discount), None
            reward = reward + jnp.where(alive > 0, alive * gain, 0.0)
            state = jax.tree.map(
                lambda new, old: jnp.where(alive > 0, new, old), moved, state
            )
            alive = jnp.where(done, 0.0, alive * self.discount)
            return (state, reward, alive), None

        dtype = self.discount.dtype
        carry = (state, jnp.zeros((), dtype), jnp.ones((), dtype))
        if self.action_repeat == 1:
            return Outcome(*one(carry, 0)[0])
        carry, _ = jax.lax.scan(one, carry, jnp.arange(self.action_repeat))
        return Outcome(*carry)

    def leaf(self, hypothesis: PyTree, state: PyTree) -> FloatScalar:
        """Value at the horizon."""
        value = jnp.asarray(self.leaf_fn(hypothesis, state), self.discount.dtype)
        _check_scalar("leaf_fn", value)
        return value


def zero_leaf(hypothesis: PyTree, state: PyTree) -> float:
    """Nothing is to be had beyond the horizon."""
    del hypothesis, state
    return 0.0


def make_problem(
    transition_fn: TransitionFn,
    reward_fn: RewardFn,
    actions: PyTree | int,
    *,
    leaf_fn: LeafFn | None = None,
    discount: Any = 1.0,
    action_repeat: Any = 1,
) -> Problem:
    """Check the parts that all planners share.

    Args:
        transition_fn: the model.
        reward_fn: what a step pays.
        actions: pytree with a leading axis `action`, or how many there are.
        leaf_fn: value at the horizon; none: 0.
        discount: of one step of the model, in (0, 1].
        action_repeat: steps of the model for which an action is held.

    Returns:
        Them together.

    Raises:
        TypeError: a function is not one.
        ValueError: no action, leaves of different numbers of actions, a count that is
            not positive, a discount outside (0, 1].
    """
    for name, function in (
        ("transition_fn", transition_fn),
        ("reward_fn", reward_fn),
        ("leaf_fn", leaf_fn or zero_leaf),
    ):
        if not callable(function):
            raise TypeError(f"{name}: expected a function; got {function!r}")
    if isinstance(actions, bool | np.bool_):
        raise ValueError(
            "actions: expected arrays with a leading axis `action`, or how many there "
            f"are; got {actions}"
        )
    if isinstance(actions, int | np.integer):
        actions = jnp.arange(actions)
    actions = jax.tree.map(jnp.asarray, actions)
    shapes = [leaf.shape for leaf in jax.tree.leaves(actions)]
    counts = {shape[0] if shape else None for shape in shapes}
    if len(counts) != 1 or not counts.isdisjoint({None, 0}):
        raise ValueError(
            "actions: every leaf has a leading axis `action` of the same length, at "
            f"least 1; got shapes {shapes}"
        )
    action_repeat = check_positive("action_repeat", action_repeat)
    check_number("discount", discount, "in (0, 1]", lambda x: 0.0 < x <= 1.0)
    return Problem(
        transition_fn,
        reward_fn,
        leaf_fn or zero_leaf,
        actions,
        jnp.asarray(discount, float),
        action_repeat,
    )


def check_positive(name: str, count: Any) -> int:
    """Read a static count; raise unless it is a positive integer, of whatever type."""
    try:
        number = 0 if isinstance(count, bool) else operator.index(count)
    except TypeError:
        number = 0
    if number < 1:
        raise ValueError(f"{name}: expected a positive integer; got {count!r}")
    return number


def check_number(
    name: str, value: Any, expected: str, is_valid: Callable[[Any], bool]
) -> None:
    """Raise unless a number, where it is known before the program runs, is valid.

    That of an array is known too, unless it is traced.
    """
    if isinstance(value, jax.core.Tracer):
        return
    if not all(is_valid(number) for number in np.ravel(value)):
        raise ValueError(f"{name}: expected a number {expected}; got {value}")


def check_state(state: PyTree) -> None:
    """Raise unless all numbers of a state are finite, where they are known yet.

    Args:
        state: where to plan from.

    Raises:
        ValueError: one is not; nothing that follows from it could be compared.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if isinstance(leaf, jax.core.Tracer) or not _is_inexact(leaf):
            continue
        if not np.all(np.isfinite(leaf)):
            name = jax.tree_util.keystr(path)
            raise ValueError(
                f"state{name}: expected finite numbers to plan from; got "
                f"{np.array2string(np.asarray(leaf), threshold=12)}"
            )


def _checked_step(result: Any, state: PyTree) -> tuple[PyTree, Any]:
    """The next state and whether that is the end, as a model has returned them.

    An array of two numbers could be unpacked just as well.
    """
    if not isinstance(result, tuple) or len(result) != 2:
        raise TypeError(
            "transition_fn: expected a pair (next_state, done); got "
            f"{_described(result)}"
        )
    moved, done = result
    if jax.tree.structure(moved) != jax.tree.structure(state):
        raise TypeError(
            "transition_fn: expected a pair (next_state, done) with a next_state of "
            f"the structure of the state, {_described(state)}; got {_described(moved)}"
        )
    leaves = jax.tree_util.tree_leaves_with_path(moved)
    for (path, new), old in zip(leaves, jax.tree.leaves(state), strict=True):
        if jnp.shape(new) != jnp.shape(old):
            name = f"next_state{jax.tree_util.keystr(path)}"
            raise ValueError(
                f"transition_fn: {name}: expected shape {jnp.shape(old)}, as in the "
                f"state; got {jnp.shape(new)}"
            )
    if not jax.tree_util.all_leaves([done]):
        raise TypeError(
            f"transition_fn: done: expected one truth value; got {_described(done)}"
        )
    _check_scalar("transition_fn: done", jnp.asarray(done))
    return moved, done


def _described(value: Any) -> str:
    """What kind of thing it is, for a message; a tracer is an array."""
    if hasattr(value, "shape"):
        return f"an array of shape {value.shape}"
    return str(jax.tree.structure(value))


def _is_inexact(leaf: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(leaf), jnp.inexact)


def _as_before(new: Any, old: Array) -> Array:
    """A part of the next state with the type that it has in the state before."""
    new = jnp.asarray(new)
    if _is_inexact(new) and not _is_inexact(old):
        # Cut to whole numbers, the world would stand still.
        raise TypeError(
            f"state: transition_fn returns {new.dtype} for a part that is {old.dtype} "
            "in the state to plan from; give it as floats"
        )
    return new.astype(old.dtype)


def _check_scalar(name: str, value: Array) -> None:
    if value.ndim:
        raise ValueError(
            f"{name}: expected one number for one state and action; got shape "
            f"{value.shape}"
        )
