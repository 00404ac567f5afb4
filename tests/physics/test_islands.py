"""What nothing joins moves as if it were alone, whatever goes wrong beside it."""

import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import rollout
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

DT, NUM_STEPS = 0.02, 5


def box(name, x, y=0.0, angle=0.0, **more):
    shape = {"type": "box", "half_extents": [0.25, 0.15]}
    return {"name": name, "shape": shape, "pose": [x, y, angle], "density": 20.0} | more


def floor(name):
    return {"type": "ground", "a": name, "dry": 0.15}


def pin(a, b, anchor_a, anchor_b, **more):
    ends = {"a": a, "b": b, "anchor_a": anchor_a, "anchor_b": anchor_b}
    return {"type": "revolute", **ends, **more}


class Island:
    """Bodies, what joins them, twists to begin with, and a wrench on each body."""

    def __init__(self, bodies, constraints, twists, wrenches):
        self.bodies, self.constraints = bodies, constraints
        self.twists, self.wrenches = twists, wrenches


PUSH, REST = [19.0, 13.0, -2.9], [0.0, 0.0, 0.0]
ISLANDS = {
    "box on a floor": Island([box("box", 0.0)], [floor("box")], [REST], [PUSH]),
    "table off its pin": Island(
        [box("table", 3.0, 0.0, 0.5)],
        [pin("table", "world", [0.1, 0.05], [3.0, 0.2], dry=0.3), floor("table")],
        [REST],
        # Against the way back to the pin: works out as less energy than nothing.
        [[20.0, -30.0, 1.0]],
    ),
    "top that turns by a radian a step": Island(
        [box("top", 6.0)],
        [pin("top", "world", [0.2, 0.0], [6.2, 0.0])],
        [[0.0, -10.0, 50.0]],
        [REST],
    ),
    "pair that folds up": Island(
        [box("left", 9.0), box("right", 9.6, 0.0)],
        [pin("left", "right", [0.3, 0.0], [-0.3, 0.0]), floor("left")],
        [[0.0, 0.0, 15.0], [0.0, 0.0, -15.0]],
        [PUSH, REST],
    ),
    "link with a motor": Island(
        [box("link", 12.0, 0.3)],
        [
            pin("link", "world", [-0.25, 0.0], [11.75, 0.3])
            | {"motor_speed": 3.0, "motor_torque": 2.0}
        ],
        [REST],
        [REST],
    ),
}
OFF = "table off its pin"
DISC = {"shape": {"type": "circle", "radius": 0.1}} | {
    "contact": {"friction": 0.3, "restitution": 0.6}
}
MEETING = Island(
    [box("disc", 15.0) | DISC, box("other", 15.25, 0.05) | DISC],
    [floor("disc")],
    [[2.0, 0.0, 0.0], REST],
    [REST, REST],
)


def run(islands):
    """States `[step, body, 6]` of all bodies of some islands in one world."""
    # Somebody else is always there: a single body takes another path.
    idle = Island([box("idle", -9.0)], [], [REST], [REST])
    islands = [*islands, idle]
    content = {
        "schema": "planar-scene-1",
        "dt": DT,
        "bodies": [body for island in islands for body in island.bodies],
        "constraints": [c for island in islands for c in island.constraints],
    }
    spec = scene_spec_from_dict(content)
    state = spec.initial_state()
    twist = np.concatenate([island.twists for island in islands])
    state = type(state)(state.pose, jnp.asarray(twist, state.pose.dtype))
    wrench = np.concatenate([island.wrenches for island in islands])
    wrenches = jnp.asarray(np.tile(wrench, (NUM_STEPS, 1, 1)), state.pose.dtype)
    states, _ = rollout(spec.scene, spec.params(), state, wrenches)
    return np.asarray(states.array)


@pytest.fixture(scope="module")
def alone():
    return {name: run([island])[:, :-1] for name, island in ISLANDS.items()}


@pytest.mark.parametrize("name", [name for name in ISLANDS if name != OFF])
def test_two_islands_are_what_each_is_alone(name, alone):
    together = run([ISLANDS[name], ISLANDS[OFF]])[:, :-1]
    expected = np.concatenate([alone[name], alone[OFF]], axis=1)
    np.testing.assert_allclose(together, expected, rtol=1e-3, atol=1e-3)


def test_bodies_that_meet_are_what_they_are_alone():
    expected = run([MEETING])[:, :-1]
    # They do meet.
    assert expected[-1, 1, 3] > 0.5
    together = run([MEETING, ISLANDS[OFF]])[:, : expected.shape[1]]
    np.testing.assert_allclose(together, expected, rtol=1e-3, atol=1e-3)


def test_what_contact_brings_is_not_taken_away():
    """A link at rest on a pin is kicked by a disc: all in contact are one island."""
    link = box("link", 15.35, 0.2, 0.0) | {"contact": DISC["contact"]}
    struck = Island(
        [box("disc", 15.0, 0.15) | DISC, link],
        [pin("link", "world", [0.0, -0.2], [15.35, 0.0])],
        [[2.0, 0.0, 0.0], REST],
        [REST, REST],
    )
    states = run([struck])
    kinetic = 0.5 * 20.0 * 0.15 * np.sum(states[:, 1, 3:5] ** 2, axis=1)
    assert kinetic[-1] > 0.1


def test_many_islands_are_what_each_is_alone(alone):
    together = run(ISLANDS.values())[:, :-1]
    expected = np.concatenate(list(alone.values()), axis=1)
    np.testing.assert_allclose(together, expected, rtol=1e-3, atol=1e-3)
