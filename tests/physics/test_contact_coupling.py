"""Contact together with floor friction, wheels and joints, in one substep."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import Params, Scene, rollout
from tests.physics.contact_scenes import body, fixed, run, spec_of

# A world with every kind of friction and joint takes half a minute to compile.
pytestmark = pytest.mark.slow

G = 9.81
SEEN_FROM_ABOVE = {"gravity": (0.0, 0.0), "normal_gravity": G, "dt": 0.02}
CONSTRAINTS = (
    {"type": "ground", "a": "table", "dry": 0.3},
    {"type": "ground", "a": "robot", "viscous": 0.01},
    {
        "type": "revolute",
        "a": "door",
        "b": "world",
        "anchor_a": [-0.4, 0.0],
        "anchor_b": [-0.4, 5.0],
    },
)


def _room(
    robot_x=-1.0, table_x=0.0, door=(0.0, 5.0, 0.0), speed=0.0, density=20.0, others=()
):
    return spec_of(
        body("robot", 0.2, (robot_x, 0.0, 0.0), (speed, 0.0, 0.0), density=density),
        body("table", (0.3, 0.2), (table_x, 0.0, 0.0)),
        body("door", (0.4, 0.05), door),
        fixed("wall", (0.2, 2.0), (3.0, 0.0, 0.0)),
        *others,
        constraints=CONSTRAINTS,
        **SEEN_FROM_ABOVE,
    )


def _push(force):
    wrench = np.zeros((4, 3))
    wrench[0] = [force, 0.0, 0.0]
    return wrench


def test_robot_pushes_a_table_with_what_friction_leaves():
    # 20 N of push, 14.4 N of Coulomb friction: both accelerate together.
    spec = _room(robot_x=-0.5)
    _, info, last = run(spec, 60, _push(20.0))
    mass = np.asarray(spec.params().density * spec.scene.area)
    friction = 0.3 * mass[1] * G
    expected = (20.0 - friction) / (mass[0] + mass[1])
    assert last.twist[1, 0] == pytest.approx(1.2 * expected, rel=0.03)
    assert last.twist[0, 0] == pytest.approx(last.twist[1, 0], abs=2e-3)
    assert np.max(info.overlap) < 1e-3


def test_too_weak_a_push_does_not_move_the_table():
    _, _, last = run(_room(robot_x=-0.5), 60, _push(8.0))
    # Friction is viscous below 2 cm/s: the table creeps, and no more.
    assert abs(last.twist[1, 0]) < 0.02
    assert last.pose[1, 0] < 0.02


def test_heavy_robot_squeezes_a_table_against_a_wall_and_stops():
    spec = _room(robot_x=1.8, table_x=2.45, speed=1.0, density=200.0)
    _, info, last = run(spec, 120, _push(300.0))
    assert np.all(info.is_finite)
    assert last.pose[1, 0] < 2.51
    assert last.pose[0, 0] < 2.02
    assert np.max(np.abs(last.twist[:2])) < 0.05
    assert np.max(info.overlap) < 0.02


def test_pushed_door_turns_about_its_hinge():
    spec = _room()
    state = spec.initial_state()
    pose = state.pose.at[0, :2].set(jnp.array([0.3, 4.7]))
    start = type(state)(pose, state.twist)
    wrenches = jnp.zeros((60, 4, 3)).at[:, 0, 1].set(5.0)
    states, info = jax.jit(rollout)(spec.scene, spec.params(), start, wrenches)
    assert float(states.pose[-1, 2, 2]) > 0.3
    assert np.max(np.asarray(info.constraint_error)) < 1e-4
    assert np.max(np.asarray(info.overlap)) < 2e-3
    # The centre stays on its circle about the hinge.
    arm = np.asarray(states.pose[:, 2, :2]) - [-0.4, 5.0]
    assert np.allclose(np.hypot(*arm.T), 0.4, atol=1e-4)


def test_without_touching_it_is_the_step_without_contact(precision):
    spec = _room(robot_x=-2.0, speed=0.5)
    wrench = _push(3.0)
    wrench[2] = [0.0, 1.0, 0.2]
    states, _, _ = run(spec, 30, wrench)
    fields = {**vars(spec.scene), "collides": None}
    plain = Scene(**fields)
    params = Params(**{**vars(spec.params()), "surface": None})
    wrenches = jnp.broadcast_to(jnp.asarray(wrench), (30, 4, 3))
    expected, _ = jax.jit(rollout)(plain, params, spec.initial_state(), wrenches)
    tolerance = precision.choose(single=2e-5, double=1e-8)
    assert np.allclose(states.pose, expected.pose, atol=tolerance)
    assert np.allclose(states.twist, expected.twist, atol=10 * tolerance)


def test_bodies_that_a_joint_connects_do_not_touch():
    links = [
        body("upper", (0.3, 0.05), (0.25, 0.0, 0.0)),
        body("lower", (0.3, 0.05), (0.75, 0.0, 0.0)),
    ]
    pins = [
        {
            "type": "revolute",
            "a": "upper",
            "b": "world",
            "anchor_a": [-0.25, 0.0],
            "anchor_b": [0.0, 0.0],
        },
        {
            "type": "revolute",
            "a": "upper",
            "b": "lower",
            "anchor_a": [0.25, 0.0],
            "anchor_b": [-0.25, 0.0],
        },
    ]
    spec = spec_of(*links, constraints=pins, dt=0.01)
    states, info, _ = run(spec, 60)
    assert np.max(info.constraint_error) < 1e-4
    assert np.all(info.overlap == 0.0)
    plain = Scene(**{**vars(spec.scene), "collides": None})
    params = Params(**{**vars(spec.params()), "surface": None})
    expected, _ = jax.jit(rollout)(
        plain, params, spec.initial_state(), jnp.zeros((60, 2, 3))
    )
    assert np.allclose(states.pose, expected.pose, atol=1e-6)


def test_bystanders_change_nothing():
    # Few bodies are written out, many are gone over in loops: the same world.
    def path(spec, force):
        state, params = spec.initial_state(), spec.params()
        wrenches = jnp.zeros((40, *state.pose.shape)).at[:, 0, 0].set(force)
        after, _ = rollout(spec.scene, params, state, wrenches)
        return after.pose[-1, 1, 0], after.array[-1, :3]

    away = [
        body(f"bystander_{i}", (0.3, 0.2), (10.0 + 2.0 * i, 10.0, 0.3))
        for i in range(3)
    ]
    few, many = _room(robot_x=-0.5), _room(robot_x=-0.5, others=away)
    alone = jax.jit(lambda force: path(few, force))
    (_, after), (low, _), (high, _) = (
        alone(jnp.asarray(force)) for force in (20.0, 19.5, 20.5)
    )
    assert after[1, 0] > 0.2
    # Forward mode has less to compile; that both modes agree is tested where contacts'
    # gradients are.
    among = jax.jit(lambda f: jax.jvp(lambda g: path(many, g), (f,), (jnp.ones(()),)))
    (_, other), (slope, _) = among(jnp.asarray(20.0))
    np.testing.assert_allclose(other, after, rtol=1e-4, atol=1e-5)
    assert slope == pytest.approx(float(high - low), rel=0.02)
