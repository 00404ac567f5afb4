"""From sequences of actions to a plan, and from one plan to the start of the next."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from boomdp_jax.core.arrays import FloatScalar
from boomdp_jax.planning.action_box import nearest
from boomdp_jax.planning.plan import Plan, SearchInfo
from boomdp_jax.planning.problem import Problem
from boomdp_jax.planning.rollouts import Rollouts


def plan_of_indices(
    rollouts: Rollouts,
    indices: Int[Array, "candidate level"],
    returns: Float[Array, "candidate hypothesis"],
) -> Plan:
    """The best of some sequences of listed actions.

    The value of an action is that of the best sequence beginning with it, −∞ where none
    does.

    Args:
        rollouts: under which they were rolled out.
        indices: of the actions.
        returns: of each sequence.

    Returns:
        The plan.
    """
    num_candidates, num_actions = indices.shape[0], rollouts.problem.num_actions
    mean = rollouts.mean(returns)
    best = jnp.argmax(mean)
    is_first = indices[:, 0][:, None] == jnp.arange(num_actions)[None]
    # A return of −∞ still comes before none.
    finite = jnp.maximum(mean, jnp.finfo(mean.dtype).min)
    best_of = jnp.argmax(jnp.where(is_first, finite[:, None], -jnp.inf), axis=0)
    is_tried = jnp.any(is_first, axis=0)
    sequence = rollouts.problem.action(indices[best])
    return Plan(
        index=indices[best, 0],
        action=jax.tree.map(lambda leaf: leaf[0], sequence),
        value=mean[best],
        q_values=jnp.where(is_tried, mean[best_of], -jnp.inf),
        hypothesis_q_values=jnp.where(is_tried[:, None], returns[best_of], -jnp.inf).T,
        sequence=sequence,
        info=SearchInfo(rollouts.num_calls(num_candidates)),
    )


def plan_of_vectors(
    rollouts: Rollouts,
    sequence: Float[Array, "level dim"],
    value: FloatScalar,
    num_sequences: int,
) -> Plan:
    """A sequence of continuous actions as a plan.

    Args:
        rollouts: under which it was rolled out.
        sequence: what was found.
        value: its mean return.
        num_sequences: how many were rolled out for it.

    Returns:
        The plan, without values of the listed actions.
    """
    return Plan(
        index=nearest(rollouts.problem, sequence[0]),
        action=sequence[0],
        value=value,
        q_values=None,
        hypothesis_q_values=None,
        sequence=sequence,
        info=SearchInfo(rollouts.num_calls(num_sequences)),
    )


def shifted(previous: Plan | None, problem: Problem, depth: int) -> PyTree | None:
    """Where to start from: the last plan without its first action, the last one twice.

    Args:
        previous: the plan of the decision before, of the same depth; or none.
        problem: what is planned for.
        depth: levels of the plan.

    Returns:
        Actions, leading axis `level`; none without a plan.

    Raises:
        ValueError: another depth, or other actions.
    """
    if previous is None:
        return None

    def shapes(tree, num_left_out):
        structure = jax.tree.structure(tree)
        return structure, [leaf.shape[num_left_out:] for leaf in jax.tree.leaves(tree)]

    lengths = {leaf.shape[0] for leaf in jax.tree.leaves(previous.sequence)}
    if lengths != {depth} or shapes(previous.sequence, 1) != shapes(problem.actions, 1):
        raise ValueError(
            f"previous: expected a plan of {depth} levels of these actions; got a "
            f"sequence {eqx.tree_pformat(previous.sequence)}"
        )
    return jax.tree.map(
        lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), previous.sequence
    )
