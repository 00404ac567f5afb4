"""An agent that plans for each piece by itself, and moves the one that gains most.

A room of pieces has as many actions as all of them together, and as many coordinates;
but one action moves one piece, and what the room costs is a sum over pieces. So a tree
is grown for each piece as if the others stayed where they are and stopped it, all trees
at once, and the piece is moved whose tree promises the most above doing nothing within
the horizon. Work is linear in the number of pieces.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.agents.agent import Agent, ExploreFn
from boomdp_jax.envs.living_room import LivingRoom, piece_cost
from boomdp_jax.models.per_body import PerBody
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.plan import Plan, plan_of
from boomdp_jax.planning.sparse_sampling import sparse_sampling

_LEAF_STEPS = 10.0


def make_piecewise_agent(
    name: str,
    task: LivingRoom,
    model: PerBody,
    goal: Float[Array, "body 3"],
    *,
    exploration: float = 0.0,
    explore: ExploreFn | None = None,
) -> Agent:
    """An agent for rooms full of pieces, by a task's own hints.

    Args:
        name: for reports.
        task: what is to be done.
        model: one for each piece.
        goal: pose that each body is to come to.
        exploration: probability that a decision is any action.
        explore: what may be done instead of the planned action.

    Returns:
        The agent.
    """
    hints = task.hints
    cells, strata = jnp.asarray(hints.cell_size), jnp.asarray(hints.stratum_size)
    idle_key = jax.random.key(0)  # For laws that are random: the same each time.
    num_pieces, num_hypotheses = task.num_pieces, model.num_hypotheses
    wrenches = task.piece_actions
    laws, law_structure = eqx.partition(model.laws, eqx.is_array)
    num_idle = hints.depth * hints.action_repeat

    def transition(key, hypothesis, state, wrench):
        law, physics, body, room, place = hypothesis
        law = eqx.combine(law, law_structure)
        if model.sees_others:
            moved = law.transition_among(key, physics, state, wrench, room)
        else:
            moved = law.transition(key, physics, state, wrench)
        del place
        # A piece that rolls through its place has not come to stay.
        return task.stopped(body, room, state, moved), jnp.zeros((), bool)

    def reward(hypothesis, state, wrench, next_state):
        return -piece_cost(next_state.pose, hypothesis[-1])[0]

    def leaf(hypothesis, state):
        return -_LEAF_STEPS * piece_cost(state.pose, hypothesis[-1])[0]

    def value_left_alone(hypothesis, state):
        # A piece on the move rolls on if another one is pushed next.
        nothing = jnp.zeros((1, 3), state.pose.dtype)

        def roll(state, _):
            moved, _ = transition(idle_key, hypothesis, state, nothing)
            return moved, reward(hypothesis, state, nothing, moved)

        last, paid = jax.lax.scan(roll, state, None, num_idle)
        return jnp.sum(paid) + leaf(hypothesis, last)

    def plan_piece(key, body, law, draws, state, wrench, sequence, was_moved):
        # The plan of a piece that was not moved is still to be begun.
        begun = jnp.concatenate([sequence[:1], sequence[:-1]])
        previous = plan_of(jnp.where(was_moved, sequence, begun))
        # What is the same for all hypotheses of this piece goes along with each.
        same = (law, draws, body, state.pose, goal.astype(state.pose.dtype)[body][None])
        num = jax.tree.leaves(draws)[0].shape[0]

        def repeated(leaf):
            return jnp.broadcast_to(leaf, (num, *leaf.shape))

        spread = tuple(
            part if part is draws else jax.tree.map(repeated, part) for part in same
        )
        lone = jax.tree.map(lambda leaf: leaf[body][None], state)
        plan = sparse_sampling(
            key,
            Belief(spread, jnp.zeros(num)),
            lone,
            transition_fn=transition,
            reward_fn=reward,
            actions=wrench[:, None],
            depth=hints.depth,
            action_repeat=hints.action_repeat,
            leaf_fn=leaf,
            num_hypotheses=num_hypotheses,
            cell_size=cells,
            stratum_size=strata,
            coordinates_fn=task.coordinates,
            capacity=hints.capacity,
            verify=True,
            previous=previous,
        )
        left_alone = jax.vmap(lambda each: value_left_alone(each, lone))(spread)
        return plan, plan.value - jnp.mean(left_alone)

    @jax.jit
    def compiled(key, belief, state, sequences, moved):
        bodies = jnp.arange(num_pieces)
        keys = jax.random.split(key, num_pieces)
        draws = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), belief.hypotheses)
        axes = (0, 0, 0, 0, None, 0, 0, 0)
        plans, gain = jax.vmap(plan_piece, in_axes=axes)(
            keys, bodies, laws, draws, state, wrenches, sequences, bodies == moved
        )
        body = jnp.argmax(gain)
        chosen = jax.tree.map(lambda leaf: leaf[body], plans)
        index = task.action_of(body, chosen.index)
        return Plan(
            index=index,
            action=task.actions[index],
            value=chosen.value,
            q_values=None,
            hypothesis_q_values=None,
            sequence=(plans.sequence, body),
            info=chosen.info,
        )

    nothing = jnp.zeros((num_pieces, hints.depth, *wrenches.shape[2:]))[:, :, None]
    none_moved = jnp.asarray(-1, jnp.arange(num_pieces).dtype)

    def plan(key, belief, state, previous):
        # A plan to do nothing stands for none, so that all decisions are one program.
        sequences = (nothing, none_moved) if previous is None else previous.sequence
        return compiled(key, belief, state, *sequences)

    return Agent(
        name=name,
        model=model,
        plan=plan,
        num_hypotheses=num_hypotheses,
        num_held=hints.action_repeat,
        exploration=float(exploration),
        explore=explore,
    )
