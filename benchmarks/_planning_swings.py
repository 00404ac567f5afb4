"""Two tasks in which something heavy is swung up: a pendulum and an acrobot."""

import jax
import jax.numpy as jnp
import numpy as np
from _planning_task import (
    NUM_LEAF_STEPS,
    Task,
    scene_of,
    single_body,
    within_circle,
    wrapped,
)

from boomdp_jax.physics import State, step

# --- Pendulum -------------------------------------------------------------------------

LENGTH, BOB_FORCE = 0.6, 0.35
"""Of the arm [m]; the force, as a part of the bob's weight."""


def pendulum() -> Task:
    spec = scene_of(
        {
            "gravity": [0.0, -9.81],
            "dt": 0.04,
            "bodies": [
                {
                    "name": "bob",
                    "pose": [0.0, -LENGTH, 0.0],
                    "shape": {"type": "circle", "radius": 0.05},
                    "density": 100.0,
                }
            ],
            "constraints": [
                {
                    "type": "revolute",
                    "a": "bob",
                    "b": "world",
                    "anchor_a": [0.0, LENGTH],
                    "anchor_b": [0.0, 0.0],
                }
            ],
        }
    )
    mass = 100.0 * np.pi * 0.05**2
    angles = np.arange(16) * np.pi / 8
    limit = float(BOB_FORCE * mass * 9.81)
    forces = limit * np.stack([np.cos(angles), np.sin(angles)], 1)
    actions = np.concatenate([forces, np.zeros((1, 2))])

    def transition(key, hypothesis, state, action):
        force = within_circle(action, limit)
        wrench = jnp.zeros((1, 3)).at[0, :2].set(force)
        state, _ = step(spec.scene, hypothesis, state, wrench)
        return state, False

    def from_upright(state):
        return jnp.pi - jnp.abs(wrapped(state.pose[0, 2]))

    def start(key):
        angle_key, spin_key = jax.random.split(key)
        angle = jax.random.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi)
        spin = jax.random.uniform(spin_key, minval=-1.0, maxval=1.0)
        place = LENGTH * jnp.stack([jnp.sin(angle), -jnp.cos(angle)])
        moves = LENGTH * spin * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return single_body(
            jnp.append(place, angle),
            jnp.append(moves, spin),
        )

    return Task(
        name="pendulum",
        transition_fn=transition,
        reward_fn=lambda h, s, a, n: -from_upright(n),
        actions=jnp.asarray(actions, jnp.float32),
        hypothesis=spec.params(),
        leaves={
            "zero": lambda h, s: 0.0,
            "straight": lambda h, s: -NUM_LEAF_STEPS * from_upright(s),
        },
        coordinates_fn=lambda s: jnp.stack([wrapped(s.pose[0, 2]), s.twist[0, 2]]),
        cell_size=np.array([0.05, 0.15]),
        stratum_size=np.array([0.4, 1.2]),
        starts=start,
        num_steps=300,
        cost_bound=np.pi,
        is_reached=lambda s: from_upright(s) < 0.2,
        action_repeat=2,
        depth=16,
        action_repeats=(2, 3, 4),
    )


# --- Acrobot --------------------------------------------------------------------------

LINK, TORQUE = 0.5, 1.5
"""Length of each link [m]; torque between them [N m]."""


def acrobot() -> Task:
    def link(name, middle):
        return {
            "name": name,
            "pose": [0.0, middle, 0.0],
            "shape": {"type": "box", "half_extents": [0.03, LINK / 2]},
            "density": 30.0,
        }

    spec = scene_of(
        {
            "gravity": [0.0, -9.81],
            "dt": 0.05,
            "bodies": [link("upper", -LINK / 2), link("lower", -1.5 * LINK)],
            "constraints": [
                {
                    "type": "revolute",
                    "a": "upper",
                    "b": "world",
                    "anchor_a": [0.0, LINK / 2],
                    "anchor_b": [0.0, 0.0],
                },
                {
                    "type": "revolute",
                    "a": "upper",
                    "b": "lower",
                    "anchor_a": [0.0, -LINK / 2],
                    "anchor_b": [0.0, LINK / 2],
                },
            ],
        }
    )

    def transition(key, hypothesis, state, action):
        wrench = jnp.zeros((2, 3)).at[:, 2].set(jnp.concatenate([-action, action]))
        state, _ = step(spec.scene, hypothesis, state, wrench)
        return state, False

    def below_top(state):
        angles = state.pose[:, 2]
        return 2.0 * LINK + LINK * jnp.sum(jnp.cos(angles))

    def start(key):
        angles = jax.random.uniform(key, (2,), minval=-0.4, maxval=0.4)
        s, c = LINK * jnp.sin(angles), -LINK * jnp.cos(angles)
        places = jnp.stack(
            [
                jnp.stack([s[0] / 2, c[0] / 2, angles[0]]),
                jnp.stack([s[0] + s[1] / 2, c[0] + c[1] / 2, angles[1]]),
            ]
        )
        return State(places, jnp.zeros((2, 3)))

    return Task(
        name="acrobot",
        transition_fn=transition,
        reward_fn=lambda h, s, a, n: -below_top(n),
        actions=TORQUE * jnp.array([[-1.0], [0.0], [1.0]]),
        hypothesis=spec.params(),
        leaves={
            "zero": lambda h, s: 0.0,
            "straight": lambda h, s: -NUM_LEAF_STEPS * below_top(s),
        },
        coordinates_fn=lambda s: jnp.concatenate(
            [wrapped(s.pose[:, 2]), s.twist[:, 2]]
        ),
        cell_size=np.array([0.2, 0.2, 0.8, 0.8]),
        stratum_size=np.array([0.8, 0.8, 3.2, 3.2]),
        starts=start,
        num_steps=300,
        cost_bound=4.0 * LINK,
        is_reached=lambda s: below_top(s) < 0.2 * LINK,
        action_repeat=4,
        depth=10,
        action_repeats=(2, 4, 6),
    )
