"""Prismatic joints, welds, limits and motors, against closed forms."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core import make_history
from boomdp_jax.inference import infer
from boomdp_jax.physics import State, load_scene, rollout
from boomdp_jax.physics.constraint_spec import KNEE_SPEED
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

GRAVITY, DENSITY, HALF = 9.81, 10.0, (0.2, 0.1)
MASS = DENSITY * 4 * HALF[0] * HALF[1]
INERTIA = MASS * (HALF[0] ** 2 + HALF[1] ** 2) / 3
SLOPE = 0.6
"""Heading of the inclined guide [rad]."""


def box(name="box", pose=(0.0, 0.0, 0.0)):
    return {
        "name": name,
        "pose": list(pose),
        "shape": {"type": "box", "half_extents": list(HALF)},
        "density": DENSITY,
    }


def make_spec(bodies, constraints, *, gravity=(0.0, -GRAVITY), dt=0.02):
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": list(gravity),
            "dt": dt,
            "bodies": bodies,
            "constraints": constraints,
        }
    )


def tie(kind, a="box", b="world", anchor_a=(0.0, 0.0), anchor_b=(0.0, 0.0), **more):
    return {
        "type": kind,
        "a": a,
        "b": b,
        "anchor_a": list(anchor_a),
        "anchor_b": list(anchor_b),
        **more,
    }


def drawer(**more):
    """A box on an inclined guide through the origin."""
    guide = tie("prismatic", axis=SLOPE, angle=SLOPE, **more)
    return make_spec([box(pose=(0.0, 0.0, SLOPE))], [guide])


def run(spec, num_steps, *, twist=None, wrench=None, params=None):
    """Trajectory of a scene, compiled."""
    num = len(spec.bodies)
    state = spec.initial_state()
    if twist is not None:
        state = State(state.pose, jnp.asarray(twist, float))
    push = np.zeros((num, 3)) if wrench is None else np.asarray(wrench, float)
    wrenches = jnp.broadcast_to(jnp.asarray(push), (num_steps, num, 3))
    params = spec.params() if params is None else params
    move = jax.jit(lambda state: rollout(spec.scene, params, state, wrenches))
    return move(state)


def slide(states):
    """Place along the inclined guide."""
    x, y = np.asarray(states.pose[:, 0, 0]), np.asarray(states.pose[:, 0, 1])
    return np.cos(SLOPE) * x + np.sin(SLOPE) * y


def test_a_drawer_slides_down_its_guide_without_turning():
    states, info = run(drawer(), 50)
    time = 0.02 * np.arange(1, 51)
    expected = -0.5 * GRAVITY * np.sin(SLOPE) * time**2
    np.testing.assert_allclose(slide(states), expected, atol=1e-9)
    np.testing.assert_allclose(states.pose[:, 0, 2], SLOPE, atol=1e-12)
    assert np.max(np.asarray(info.constraint_error)) < 1e-9


@pytest.mark.slow
def test_dry_friction_of_a_guide_holds_or_slows_down():
    weight = MASS * GRAVITY * np.sin(SLOPE)
    states, _ = run(drawer(dry=0.25 * weight), 50)
    # Up to the knee friction is viscous, which is passed within three milliseconds.
    expected = -0.5 * 0.75 * GRAVITY * np.sin(SLOPE)
    assert abs(slide(states)[-1] - expected) < 0.01
    states, _ = run(drawer(dry=1.5 * weight), 50)
    # It creeps with the share of the knee speed that carries the weight.
    assert slide(states)[-1] == pytest.approx(-KNEE_SPEED / 1.5, rel=0.05)


@pytest.mark.slow
def test_a_drawer_stops_at_the_end_of_its_range():
    states, info = run(drawer(lower=-0.5, upper=0.3), 60)
    assert np.min(slide(states)) > -0.5 - 1e-6
    assert slide(states)[-1] == pytest.approx(-0.5, abs=1e-6)
    np.testing.assert_allclose(states.twist[-1], 0.0, atol=1e-9)
    assert np.max(np.asarray(info.constraint_error)) < 1e-9


@pytest.mark.slow
def test_a_motor_lifts_a_load_at_its_speed_or_not_at_all():
    def lift(force):
        guide = tie("prismatic", axis=0.5 * np.pi, motor_speed=0.3, motor_force=force)
        states, _ = run(make_spec([box()], [guide]), 100)
        return np.asarray(states.twist[-1, 0, 1])

    weight = MASS * GRAVITY
    # What carries the load is lacking in speed, as a share of the knee.
    assert lift(4.0 * weight) == pytest.approx(0.3 - KNEE_SPEED / 4, abs=1e-6)
    # Too weak, it falls with what is left of its weight.
    assert lift(0.5 * weight) == pytest.approx(-0.5 * GRAVITY * 2.0, rel=1e-3)


@pytest.mark.slow
def test_a_motor_turns_a_hinge_up_with_its_torque():
    hinge = tie("revolute", anchor_a=(-0.2, 0.0), motor_speed=3.0, motor_torque=0.05)
    spec = make_spec([box(pose=(0.2, 0.0, 0.0))], [hinge], gravity=(0.0, 0.0))
    states, info = run(spec, 200)
    about_pin = INERTIA + MASS * 0.2**2
    spin = np.asarray(states.twist[:, 0, 2])
    assert spin[49] == pytest.approx(0.05 / about_pin * 1.0, rel=1e-3)
    assert spin[-1] == pytest.approx(3.0, abs=1e-3)
    assert np.max(np.asarray(info.constraint_error)) < 1e-6


@pytest.mark.slow
def test_a_hinge_stops_at_its_limits():
    hinge = tie("revolute", anchor_a=(-0.2, 0.0), lower=-1.0, upper=0.5)
    states, _ = run(make_spec([box(pose=(0.2, 0.0, 0.0))], [hinge]), 100)
    assert np.min(np.asarray(states.pose[:, 0, 2])) > -1.0 - 1e-6
    assert float(states.pose[-1, 0, 2]) == pytest.approx(-1.0, abs=1e-6)
    up = np.array([[0.0, 0.0, 0.0]])
    states, _ = run(
        make_spec([box(pose=(0.2, 0.0, 0.0))], [hinge], gravity=(0.0, GRAVITY)),
        100,
        twist=up,
    )
    assert float(states.pose[-1, 0, 2]) == pytest.approx(0.5, abs=1e-6)


@pytest.mark.slow
def test_welded_boxes_move_as_one_body():
    bodies = [box("a", (-0.2, 0.0, 0.0)), box("b", (0.2, 0.0, 0.0))]
    weld = tie("weld", "a", "b", (0.2, 0.0), (-0.2, 0.0))
    spec = make_spec(bodies, [weld], gravity=(0.0, 0.0))
    # Equal forces on both halves act at the middle.
    states, info = run(spec, 100, wrench=[(0.35, -0.2, 0.1), (0.35, -0.2, 0.05)])
    whole = box()
    whole["shape"]["half_extents"] = [2 * HALF[0], HALF[1]]
    alone = make_spec([whole], [], gravity=(0.0, 0.0))
    expected, _ = run(alone, 100, wrench=[(0.7, -0.4, 0.15)])
    middle = 0.5 * (np.asarray(states.pose[:, 0]) + np.asarray(states.pose[:, 1]))
    # The impulses between them are of second order in the length of a substep.
    np.testing.assert_allclose(middle, expected.pose[:, 0], atol=2e-4)
    assert np.max(np.asarray(info.constraint_error)) < 1e-7


@pytest.mark.slow
def test_a_guide_between_two_bodies_keeps_both_momenta():
    bodies = [box("a"), box("b", (0.1, 0.3, 0.0))]
    guide = tie("prismatic", "b", "a", anchor_b=(0.1, 0.3), axis=0.3, viscous=0.5)
    spec = make_spec(bodies, [guide], gravity=(0.0, 0.0))
    states, info = run(spec, 200, twist=[[0.0, 0.0, 2.0], [1.0, 0.0, 2.0]])
    pose, twist = np.asarray(states.pose), np.asarray(states.twist)
    linear = MASS * twist[..., :2].sum(axis=1)
    np.testing.assert_allclose(
        linear, np.broadcast_to([MASS, 0.0], (200, 2)), atol=1e-9
    )
    moment = pose[..., 0] * twist[..., 1] - pose[..., 1] * twist[..., 0]
    angular = (MASS * moment + INERTIA * twist[..., 2]).sum(axis=1)
    np.testing.assert_allclose(angular, angular[0], atol=1e-5)
    np.testing.assert_allclose(pose[:, 0, 2], pose[:, 1, 2], atol=1e-9)
    assert np.max(np.asarray(info.constraint_error)) < 1e-7


@pytest.mark.slow
def test_inactive_slots_change_nothing():
    free = make_spec([box("a"), box("b", (1.0, 0.0, 0.0))], [])
    ties = [
        tie("prismatic", "a", "b", axis=0.3, lower=-0.1, upper=0.1, dry=3.0),
        tie("weld", "a", "b", (0.5, 0.0), (-0.5, 0.0)),
        tie("revolute", "a", lower=0.1, upper=0.2, motor_speed=1.0, motor_torque=2.0),
    ]
    spec = make_spec([box("a"), box("b", (1.0, 0.0, 0.0))], ties)

    def off(joint):
        active = jnp.zeros_like(joint.active)
        return type(joint)(**{**vars(joint), "active": active})

    params = spec.params()
    params = type(params)(
        **{
            **vars(params),
            **{k: off(getattr(params, k)) for k in ("prismatic", "weld", "revolute")},
        }
    )
    twist = [[0.5, 0.1, 1.0], [0.0, 0.3, -2.0]]
    with_slots, info = run(spec, 20, twist=twist, params=params)
    without, _ = run(free, 20, twist=twist)
    np.testing.assert_allclose(with_slots.array, without.array, atol=1e-12)
    assert float(jnp.max(info.constraint_error)) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_a_drawer(mode):
    spec = drawer(viscous=0.8)
    state, wrenches = spec.initial_state(), jnp.zeros((50, 1, 3))

    def end(number):
        params = spec.params()
        guide = params.prismatic
        guide = type(guide)(**{**vars(guide), "viscous": number[None]})
        params = type(params)(**{**vars(params), "prismatic": guide})
        states, _ = rollout(spec.scene, params, state, wrenches)
        x, y = states.pose[-1, 0, 0], states.pose[-1, 0, 1]
        return jnp.cos(SLOPE) * x + jnp.sin(SLOPE) * y

    def closed(c):
        rate = c / MASS
        return -GRAVITY * np.sin(SLOPE) / rate * (1 - (1 - np.exp(-rate)) / rate)

    number, nudge = jnp.asarray(0.8), 1e-5
    expected = (closed(0.8 + nudge) - closed(0.8 - nudge)) / (2 * nudge)
    assert float(jax.jit(mode(end))(number)) == pytest.approx(expected, rel=0.01)


def test_a_scene_file_keeps_them(tmp_path):
    ties = [
        tie("prismatic", axis=0.3, angle=0.1, lower=-0.2, dry=2.0, motor_speed=0.1,
            motor_force=3.0),
        tie("weld", "b", "a", (0.1, 0.0), (0.2, 0.0), angle=-0.4),
        tie("revolute", "b", lower=-1.0, upper=2.0),
    ]  # fmt: skip
    spec = make_spec([box("box"), box("a"), box("b")], ties)
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(spec.to_dict()))
    again = load_scene(path)
    for old, new in zip(
        jax.tree.leaves(spec.params()), jax.tree.leaves(again.params()), strict=True
    ):
        np.testing.assert_array_equal(old, new)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lower": 1.0, "upper": 0.0}, "upper: expected a number of at least 1"),
        ({"motor_speed": 1.0}, "motor_force"),
        ({"motor_speed": 1.0, "motor_force": -1.0}, "motor_force: expected"),
        ({"axis": "up"}, "axis: expected"),
        ({"angle": "flat"}, "angle: expected"),
        ({"anchor_a": "hinge"}, "anchor_a: expected"),
    ],
)
def test_what_is_wrong_is_named(change, message):
    guide = tie("prismatic", axis=SLOPE) | change
    with pytest.raises(ValueError, match=message):
        make_spec([box()], [guide])


def test_inference_refuses_what_it_does_not_know():
    spec = drawer(lower=-1.0, upper=1.0)
    states = np.zeros((3, 1, 6))
    history = make_history(states, np.zeros((3, 1, 3)), states, dt=0.02)
    with pytest.raises(ValueError, match="got prismatic with a limit"):
        infer(jax.random.key(0), spec, history)
