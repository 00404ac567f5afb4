r"""What a sequence of actions is worth: rolled out under every hypothesis at once.

Planners that choose among whole sequences share what is here. The return of actions
$a_0 \dots a_{H-1}$ under one hypothesis is
$\sum_l c_l r_l + c_H V(s_H)$, where $c_0 = 1$ and each level multiplies $c$ by its
continuation, so that nothing counts after the end of an episode, not even a NaN.
The noise of a hypothesis at a level is the same for all sequences: they differ by what
was done, not by luck.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from boomdp_jax.core.arrays import FloatScalar, IntScalar, Key
from boomdp_jax.planning.belief import Belief, as_belief, resample
from boomdp_jax.planning.problem import Problem, check_positive


class Rollouts(eqx.Module):
    """From one state, under some hypotheses, with their noise drawn beforehand."""

    problem: Problem
    state: PyTree
    hypotheses: PyTree
    """Leading axis `hypothesis`."""
    weight: Float[Array, " hypothesis"]
    """Of a sum of one."""
    keys: Array
    """Random ones, `[hypothesis, level]`."""

    def returns(self, sequence: PyTree) -> Float[Array, " hypothesis"]:
        """Return of one sequence under each hypothesis; −∞ where it is NaN.

        Args:
            sequence: actions, leading axis `level`.
        """
        return jax.vmap(self._return, in_axes=(0, 0, None))(
            self.hypotheses, self.keys, sequence
        )

    def _return(self, hypothesis: PyTree, keys: Array, sequence: PyTree) -> FloatScalar:
        def level(carry, now):
            state, total, factor = carry
            key, action = now
            outcome = self.problem.hold(key, hypothesis, state, action)
            total = total + jnp.where(factor > 0, factor * outcome.reward, 0.0)
            return (outcome.state, total, factor * outcome.continuation), None

        one = jnp.ones_like(self.problem.discount)
        start = (self.state, jnp.zeros_like(one), one)
        (state, total, factor), _ = jax.lax.scan(level, start, (keys, sequence))
        leaf = self.problem.leaf(hypothesis, state)
        total = total + jnp.where(factor > 0, factor * leaf, 0.0)
        return jnp.where(jnp.isnan(total), -jnp.inf, total)

    def mean(
        self, returns: Float[Array, "*batch hypothesis"]
    ) -> Float[Array, "*batch"]:
        """Weighted mean over hypotheses; what has no weight does not count."""
        weight = jnp.broadcast_to(self.weight, returns.shape)
        return jnp.sum(jnp.where(weight > 0, weight * returns, 0.0), axis=-1)

    def num_calls(self, num_sequences: int) -> IntScalar:
        """Steps of the model that as many sequences take; those of a leaf not counted.

        What comes after the end of an episode is computed and does not count, so it
        is among them.
        """
        num_hypotheses, depth = self.keys.shape[:2]
        num_steps = num_hypotheses * depth * self.problem.action_repeat
        return jnp.asarray(num_sequences * num_steps)


def read_inputs(
    belief: Any, state: PyTree, *, depth: Any, num_hypotheses: Any
) -> tuple[Belief, PyTree, int, int]:
    """Check the arguments that all planners share beside the problem.

    Args:
        belief: in any of its forms.
        state: pytree of numbers.
        depth: levels of the plan.
        num_hypotheses: how many to plan under at most.

    Returns:
        The belief, the state as arrays, and both counts.

    Raises:
        TypeError: not a belief.
        ValueError: a count that is not positive, weights that do not fit.
    """
    depth = check_positive("depth", depth)
    num_hypotheses = check_positive("num_hypotheses", num_hypotheses)
    state = jax.tree.map(jnp.asarray, state)
    return as_belief(belief), state, depth, num_hypotheses


def draw_rollouts(
    key: Key,
    problem: Problem,
    belief: Belief,
    state: PyTree,
    depth: int,
    num_hypotheses: int,
) -> Rollouts:
    """Draw hypotheses and the noise of each level.

    Args:
        key: random key.
        problem: what is planned for.
        belief: what to draw from.
        state: where to plan from.
        depth: levels of the plan.
        num_hypotheses: how many to draw; of no more than that, all are taken.

    Returns:
        Ready to roll out.
    """
    belief_key, noise_key = jax.random.split(key)
    belief = resample(belief_key, belief, num_hypotheses)
    keys = jax.random.split(noise_key, (belief.num_hypotheses, depth))
    return Rollouts(problem, state, belief.hypotheses, belief.weight, keys)
