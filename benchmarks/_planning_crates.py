"""A crate that is light or stuck: does a planner nudge it before it shoves?

The crate, a scene of our engine on a floor with friction, blocks a doorway. A shove
clears it if it is light and costs 3 where it does not move; going round costs 2 and is
the end of it; a nudge costs 0.1 and moves a light crate by some millimetres; waiting
costs 0.05. Light and stuck are as likely. The crate's place is read after each action,
and the belief follows by Bayes' rule, for all planners alike.

Whoever has not begun to go round in the end has to. By hand: who nudges first pays
0.1, and then 0 or 2: 1.1 on average. Going round at once costs 2, shoving at once 0 or
3 + 2: 2.5 on average. Who plans as if all were known from the next step on waits, for
that is cheaper than a nudge, for as long as it may.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _planning_task import scene_of, single_body

from boomdp_jax.physics import step
from boomdp_jax.planning import Belief, sparse_sampling

FRICTION = (0.2, 3.0)
"""Of a light crate and of one that is stuck."""
FORCES = np.array([200.0, 60.0, 0.0, 0.0])
COSTS = np.array([0.0, 0.1, 2.0, 0.05])
SHOVE, NUDGE, ROUND, WAIT = range(4)
BLOCKED_COST, CLEARED = 3.0, 0.3
READING_SD = 1e-3
"""Of the crate's place [m]."""
NUM_STEPS, DEPTH = 8, 4
MODES = ("adaptive", "root", "mean", "map")


def model():
    """Transition, reward and likelihood, and both hypotheses."""
    spec = scene_of(
        {
            "gravity": [0.0, 0.0],
            "dt": 0.05,
            "bodies": [
                {
                    "name": "crate",
                    "pose": [0.0, 0.0, 0.0],
                    "shape": {"type": "box", "half_extents": [0.25, 0.25]},
                    "density": 40.0,
                }
            ],
            "constraints": [{"type": "ground", "a": "crate", "dry": FRICTION[0]}],
        }
    )
    params = spec.params()

    def of_friction(value):
        return eqx.tree_at(
            lambda p: p.ground.dry, params, jnp.full_like(params.ground.dry, value)
        )

    hypotheses = jax.vmap(of_friction)(jnp.asarray(FRICTION, jnp.float32))

    def transition(key, hypothesis, state, action):
        wrench = jnp.zeros((1, 3)).at[0, 0].set(jnp.asarray(FORCES)[action])

        # A shove lasts ten steps, a nudge two.
        def one(number, state):
            force = jnp.where((action == NUDGE) & (number >= 2), 0.0, wrench)
            return step(spec.scene, hypothesis, state, force)[0]

        moved = jax.lax.fori_loop(0, 10, one, state)
        return moved, (moved.pose[0, 0] > CLEARED) | (action == ROUND)

    def reward(hypothesis, state, action, after):
        del hypothesis
        is_blocked = (action == SHOVE) & (after.pose[0, 0] <= CLEARED)
        return -jnp.asarray(COSTS)[action] - BLOCKED_COST * is_blocked

    def likelihood(hypothesis, state, action, after):
        expected, _ = transition(None, hypothesis, state, action)
        return -0.5 * ((after.pose[0, 0] - expected.pose[0, 0]) / READING_SD) ** 2

    return transition, reward, likelihood, hypotheses


def crates() -> list[dict]:
    """Rows of the report: first action and return of each way to plan."""
    transition, reward, likelihood, hypotheses = model()
    act, explain = (
        jax.jit(transition),
        jax.jit(jax.vmap(likelihood, (0, None, None, None))),
    )
    rows = []
    for mode in MODES:

        def plan(key, belief, state, mode=mode):
            return sparse_sampling(
                key,
                belief,
                state,
                transition_fn=transition,
                reward_fn=reward,
                leaf_fn=lambda h, s: -COSTS[ROUND],
                actions=4,
                depth=DEPTH,
                cell_size=1e-4,
                coordinates_fn=lambda s: s.pose[0, :1],
                capacity=64,
                hypotheses=mode,
                likelihood_fn=likelihood if mode == "adaptive" else None,
            )

        plan = jax.jit(plan)
        start = single_body(jnp.zeros(3), jnp.zeros(3))
        returns, first = [], None
        for truth in range(2):
            state, log_weight, paid = start, jnp.zeros(2), 0.0
            for number in range(NUM_STEPS):
                action = plan(
                    jax.random.key(number), Belief(hypotheses, log_weight), state
                ).action
                first = int(action) if first is None else first
                hypothesis = jax.tree.map(lambda leaf, i=truth: leaf[i], hypotheses)
                after, done = act(None, hypothesis, state, action)
                paid += float(reward(hypothesis, state, action, after))
                explained = explain(hypotheses, state, action, after)
                log_weight = jax.nn.log_softmax(log_weight + explained)
                state = after
                if done:
                    break
            returns.append(paid if done else paid - COSTS[ROUND])
        case = f"light or stuck, {mode} hypotheses"
        name = ("shove", "nudge", "go round", "wait")[first]
        rows.append(
            {
                "case": case,
                "metric": f"mean return; first action: {name}; spread: both returns",
                "value": float(np.mean(returns)),
                "n": 2,
                "spread": returns,
            }
        )
        if mode == "adaptive":
            is_met = first == NUDGE and abs(np.mean(returns) + 1.1) < 1e-3
            rows[-1] |= {"target": -1.1, "met": bool(is_met)}
    return rows
