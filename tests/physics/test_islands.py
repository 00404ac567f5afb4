"""What nothing joins moves as if it were alone, whatever goes wrong beside it."""

import dataclasses

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


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ISLANDS if name != OFF])
def test_two_islands_are_what_each_is_alone(name, alone):
    together = run([ISLANDS[name], ISLANDS[OFF]])[:, :-1]
    expected = np.concatenate([alone[name], alone[OFF]], axis=1)
    np.testing.assert_allclose(together, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_bodies_that_meet_are_what_they_are_alone():
    expected = run([MEETING])[:, :-1]
    # They do meet.
    assert expected[-1, 1, 3] > 0.5
    together = run([MEETING, ISLANDS[OFF]])[:, : expected.shape[1]]
    np.testing.assert_allclose(together, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
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


@pytest.mark.slow
def test_many_islands_are_what_each_is_alone(alone):
    together = run(ISLANDS.values())[:, :-1]
    expected = np.concatenate(list(alone.values()), axis=1)
    np.testing.assert_allclose(together, expected, rtol=1e-3, atol=1e-3)


def states_of(content, twist, num_steps, smoothing=None):
    """States `[step, body, 6]` without wrenches but gravity's."""
    spec = scene_spec_from_dict({"schema": "planar-scene-1", **content})
    state = spec.initial_state()
    state = type(state)(state.pose, jnp.asarray(twist, state.pose.dtype))
    scene = spec.scene
    if smoothing is not None:
        scene = dataclasses.replace(scene, smoothing=jnp.asarray(smoothing))
    wrenches = jnp.zeros((num_steps, spec.num_bodies, 3), state.pose.dtype)
    return np.asarray(rollout(scene, spec.params(), state, wrenches)[0].array)


@pytest.mark.parametrize("first", ["post", "bar"])
def test_a_motor_turns_the_body_that_can_move(first):
    """About a post that is held fast, whichever of both is named first."""
    ends = {"post": [0.0, 0.0], "bar": [-0.25, 0.0]}
    second = "bar" if first == "post" else "post"
    motor = {"motor_speed": 3.0 if first == "bar" else -3.0, "motor_torque": 2.0}
    bodies = [box("post", 0.0, static=True), box("bar", 0.25)]
    joint = pin(first, second, ends[first], ends[second]) | motor
    content = {"dt": DT, "bodies": bodies, "constraints": [joint]}
    states = states_of(content, [REST, REST], 20)
    # Mass 3 kg, inertia about its middle (0.5^2 + 0.3^2) / 12 of that.
    inertia = 3.0 * ((0.5**2 + 0.3**2) / 12.0 + 0.25**2)
    speed = 2.0 * DT * np.arange(1, 21) / inertia
    np.testing.assert_allclose(states[:, 1, 5], np.minimum(speed, 3.0), rtol=2e-2)


@pytest.mark.parametrize(
    ("place", "pull", "dt"),
    [(5.0, 0.02, 0.005), (10.0, 0.008, 0.02), (40.0, 0.03, 0.02), (100.0, 0.05, 0.02)],
)
def test_a_body_that_starts_slowly_starts(place, pull, dt):
    """So slowly that rounding hides how far it has come; another one moves."""
    bodies = [box("slow", place), box("fast", place, 5.0)]
    content = {"dt": dt, "bodies": bodies, "gravity": [pull, 0.0]}
    states = states_of(content, [REST, [1.0, 0.0, 0.0]], 50)
    time = dt * np.arange(1, 51)
    np.testing.assert_allclose(states[:, 0, 3], pull * time, rtol=1e-3)


@pytest.mark.slow
def test_smoothed_contact_far_away_joins_nothing():
    contact = {"contact": DISC["contact"]}
    table = ISLANDS[OFF]
    bodies = [box("box", -9.0) | contact, table.bodies[0] | contact]
    content = {"dt": DT, "bodies": bodies, "gravity": [1.0, -2.0]}
    twist = [[0.5, 0.0, 2.0], [-2.0, 3.0, 0.0]]
    expected = states_of(content, twist, 3, smoothing=0.02)[:, 0]
    content |= {"constraints": table.constraints}
    together = states_of(content, twist, 3, smoothing=0.02)[:, 0]
    np.testing.assert_allclose(together, expected, rtol=1e-3, atol=1e-3)
