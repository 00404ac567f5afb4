"""What a thing that is pushed leans on: boxes and discs at known distances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.agents.namo_touch import is_pressed, pressed_steps
from boomdp_jax.physics import State
from tests.physics.contact_scenes import body, fixed, spec_of

ROBOT = 2
# A box, another one 5 mm to its right, the robot 5 mm to its left, a wall far below.
SPEC = spec_of(
    body("pushed", (0.3, 0.2), (0.0, 0.0, 0.0)),
    body("other", (0.3, 0.2), (0.605, 0.0, 0.0)),
    body("robot", 0.2, (-0.505, 0.0, 0.0)),
    fixed("wall", (3.0, 0.1), (0.0, -2.0, 0.0)),
    gravity=(0.0, 0.0),
)


def pressed(push, moved=(0.0, 0.0), turned=0.0):
    """With the pushed box somewhere else."""
    pose = SPEC.initial_state().pose
    pose = pose.at[0].add(jnp.array([*moved, turned]))
    state = State(pose, jnp.zeros_like(pose))
    found = jax.jit(is_pressed)(SPEC.scene, state, 0, ROBOT, jnp.array(push))
    return bool(found)


@pytest.mark.parametrize(
    ("push", "moved", "expected"),
    [
        ((100.0, 0.0), (0.0, 0.0), True),
        ((0.01, 0.0), (0.0, 0.0), True),
        # Away from it, along it, and towards the robot.
        ((-100.0, 0.0), (0.0, 0.0), False),
        ((0.0, 100.0), (0.0, 0.0), False),
        ((0.0, 0.0), (0.0, 0.0), False),
        # Two centimetres are far.
        ((100.0, 0.0), (-0.02, 0.0), False),
        # Overlapping by what readings are off: into it, and out of it.
        ((100.0, 0.0), (0.01, 0.0), True),
        ((-100.0, 0.0), (0.01, 0.0), False),
        # Down on the wall, whose surface is at -1.9 m.
        ((0.0, -100.0), (-1.0, -1.69), True),
        ((0.0, -100.0), (-1.0, -1.6), False),
    ],
)
def test_pressed_is_what_would_overlap_more_farther_on(push, moved, expected):
    assert pressed(push, moved) == expected


def test_turned_corner_presses():
    # Turned by 45 degrees a corner reaches (0.3 + 0.2) / sqrt(2) to the right.
    reach = 0.5 / np.sqrt(2.0)
    gap = 0.305 - reach
    assert pressed((100.0, 0.0), (gap - 0.005, 0.0), np.pi / 4)
    assert not pressed((100.0, 0.0), (gap - 0.03, 0.0), np.pi / 4)


def test_a_step_counts_by_its_beginning_and_its_end():
    pose = SPEC.initial_state().pose
    away = pose.at[0, 0].add(-0.1)
    zero = jnp.zeros_like(pose)
    before = State(jnp.stack([away, away, pose]), jnp.stack([zero] * 3))
    after = State(jnp.stack([away, pose, away]), jnp.stack([zero] * 3))
    push = jnp.broadcast_to(jnp.array([100.0, 0.0]), (3, 2))
    found = pressed_steps(
        SPEC.scene, before, after, jnp.asarray(0), jnp.asarray(ROBOT), push
    )
    assert found.tolist() == [False, True, True]
