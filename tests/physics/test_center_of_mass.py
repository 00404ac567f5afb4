"""A centre of mass away from the reference point, against engines that know it."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from boomdp_jax.physics import (
    State,
    angular_momentum,
    kinetic_energy,
    linear_momentum,
    potential_energy,
    rollout,
    scene_spec_from_dict,
    step,
)
from boomdp_jax.physics.center_of_mass import (
    state_of_center,
    state_of_reference,
    wrench_at_center,
)
from tests.reference.planar_dynamics import rotation

CENTER = np.array([0.12, -0.05])
HALF_EXTENTS = (0.3, 0.2)
DENSITY = 20.0
MASS = DENSITY * 4.0 * HALF_EXTENTS[0] * HALF_EXTENTS[1]
INERTIA = MASS * (HALF_EXTENTS[0] ** 2 + HALF_EXTENTS[1] ** 2) / 3.0


def scene(constraints=(), gravity=(0.0, 0.0), dt=0.01, num_bodies=1, **body):
    shape = {"type": "box", "half_extents": HALF_EXTENTS}
    bodies = [
        {"name": f"box{i}", "shape": shape, "density": DENSITY, "pose": [i, 0, 0]}
        for i in range(num_bodies)
    ]
    bodies[0] |= body
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": list(gravity),
            "dt": dt,
            "bodies": bodies,
            "constraints": list(constraints),
        }
    )


def with_center(params, *centers):
    centers = [jnp.asarray(center, float) for center in centers]
    return dataclasses.replace(params, center_of_mass=jnp.stack(centers))


def off_center(spec):
    """Params of a scene whose first body has its mass at `CENTER`."""
    rest = [(0.0, 0.0)] * (spec.num_bodies - 1)
    return with_center(spec.params(), CENTER, *rest)


def test_a_free_body_pushed_at_its_middle_moves_as_in_mujoco():
    """MuJoCo applies the force at the point, which turns with the body."""
    step_length, push = 0.0005, (4.0, -3.0, 0.2)
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{step_length}" gravity="0 0 0" integrator="RK4"/>
  <worldbody><body>
    <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>
    <joint type="hinge" axis="0 0 1"/>
    <inertial pos="{CENTER[0]} {CENTER[1]} 0" mass="{MASS}"
      diaginertia="1 1 {INERTIA}"/>
  </body></worldbody>
</mujoco>""")
    data = mujoco.MjData(model)
    data.qvel[:] = [0.3, 0.1, 0.8]
    theirs = []
    for number in range(4000):
        # The joints' forces are force and torque at the body's frame.
        data.qfrc_applied[:] = push
        mujoco.mj_step(model, data)
        if number % 200 == 199:
            theirs.append(np.concatenate([data.qpos, data.qvel]))
    spec = scene()
    start = State(jnp.zeros((1, 3)), jnp.array([[0.3, 0.1, 0.8]]))
    wrenches = jnp.broadcast_to(jnp.asarray(push), (200, 1, 3))
    ours, _ = rollout(spec.scene, off_center(spec), start, wrenches)
    np.testing.assert_allclose(ours.array[9::10, 0], theirs, atol=2e-4)


@pytest.mark.slow
def test_a_pendulum_swings_as_one_whose_centre_of_mass_is_given():
    """By an engine frame at the one point, and by one at the other."""
    pin = {"type": "revolute", "a": "box0", "b": "world", "viscous": 0.05}
    pin |= {"anchor_a": [-0.2, 0.1], "anchor_b": [0.0, 0.0]}
    wheel = {"type": "wheel", "a": "box0", "pose": [0.1, 0.1, 0.4]}
    wheel |= {"viscous": [0.3, 2.0], "dry": [0.5, 5.0]}
    known = scene([pin, wheel], (0.0, -9.81), center_of_mass=CENTER.tolist())
    unknown = scene([pin, wheel], (0.0, -9.81))
    params = off_center(unknown)
    angle = 0.3
    pose = np.append(-rotation(angle) @ [-0.2, 0.1], angle)[None]
    start = State(jnp.asarray(pose), jnp.zeros((1, 3)))
    states, info = rollout(unknown.scene, params, start, jnp.zeros((150, 1, 3)))
    theirs, _ = rollout(
        known.scene,
        known.params(),
        state_of_center(params, start),
        jnp.zeros((150, 1, 3)),
    )
    ours = jax.vmap(lambda s: state_of_center(params, s))(states)
    np.testing.assert_allclose(ours.array, theirs.array, atol=1e-9)
    assert np.max(info.constraint_error) < 1e-4
    assert np.ptp(states.pose[:, 0, 2]) > 0.5


@pytest.mark.parametrize("num_bodies", [1, 2])
@pytest.mark.slow
def test_ground_and_ties_are_those_of_a_given_centre_of_mass(num_bodies):
    ground = {"type": "ground", "a": "box0", "dry": 0.2, "viscous": 50.0}
    tie = {"type": "revolute", "a": "box1", "b": "box0"}
    tie |= {"anchor_a": [-0.5, 0.0], "anchor_b": [0.5, 0.0]}
    ties = [tie] if num_bodies == 2 else []
    # Feet whose loads balance under the middle, and feet moved to where they balance
    # under the centre of mass.
    feet = np.array([[0.2, 0.1], [-0.2, 0.1], [-0.2, -0.1], [0.2, -0.1]])
    unknown = scene([ground, *ties], num_bodies=num_bodies, feet=feet.tolist())
    known = scene(
        [ground, *ties],
        num_bodies=num_bodies,
        center_of_mass=CENTER.tolist(),
        feet=(feet + CENTER).tolist(),
    )
    params = off_center(unknown)
    twist = np.zeros((num_bodies, 3))
    twist[0] = [0.4, 0.1, 0.5]
    start = State(unknown.initial_state().pose, jnp.asarray(twist))
    push = jnp.zeros((30, num_bodies, 3)).at[:, 0].set(jnp.array([9.0, 4.0, 1.0]))
    states, _ = rollout(unknown.scene, params, start, push)
    state = state_of_center(params, start)
    known_params = known.params()

    @jax.jit
    def advance(state, wrench):
        before = state_of_reference(params, state)
        wrench = wrench_at_center(params, before, wrench, 0.01)
        return step(known.scene, known_params, state, wrench)[0]

    for row in range(30):
        state = advance(state, push[row])
    ours = state_of_center(params, jax.tree.map(lambda leaf: leaf[-1], states))
    np.testing.assert_allclose(ours.array, state.array, atol=1e-9)


@pytest.mark.slow
def test_a_push_at_the_reference_point_is_second_order_in_the_step():
    """A torque at the angle where a step begins would lag, and be of order one."""
    spec, push = scene(), jnp.array([[4.0, -3.0, 0.5]])
    start = State(jnp.zeros((1, 3)), jnp.array([[0.0, 0.0, 2.0]]))

    def end(num):
        wrenches = jnp.broadcast_to(push, (num, 1, 3))
        states, _ = rollout(spec.scene, off_center(spec), start, wrenches, dt=1.0 / num)
        return np.asarray(states.array[-1, 0])

    exact = end(3200)
    errors = [np.abs(end(num) - exact).max() for num in (25, 50, 100)]
    ratios = np.divide(errors[:-1], errors[1:])
    assert np.all((ratios > 3.5) & (ratios < 4.6)), ratios


def test_rollout_with_lengths_of_its_own_is_step_after_step():
    spec = scene()
    params = off_center(spec)
    lengths = jnp.array([0.01, 0.02, 0.015])
    wrenches = jnp.arange(9.0).reshape(3, 1, 3)
    state = State(jnp.zeros((1, 3)), jnp.ones((1, 3)))
    states, _ = rollout(spec.scene, params, state, wrenches, dt=lengths)
    for row in range(3):
        state, _ = step(spec.scene, params, state, wrenches[row], dt=lengths[row])
    np.testing.assert_allclose(states.array[-1], state.array, rtol=1e-12)


def test_what_is_kept_is_that_of_the_centre_of_mass():
    """Closed forms, for a body at an angle."""
    spec = scene(gravity=(0.0, -9.81))
    params = off_center(spec)
    pose, twist = np.array([0.4, 0.7, 0.6]), np.array([0.2, -0.3, 1.5])
    state = State(jnp.asarray(pose[None]), jnp.asarray(twist[None]))
    arm = rotation(0.6) @ CENTER
    place = pose[:2] + arm
    speed = twist[:2] + 1.5 * np.array([-arm[1], arm[0]])
    expected = {
        kinetic_energy: 0.5 * MASS * speed @ speed + 0.5 * INERTIA * 1.5**2,
        potential_energy: MASS * 9.81 * place[1],
        linear_momentum: MASS * speed,
        angular_momentum: INERTIA * 1.5
        + MASS * (place[0] * speed[1] - place[1] * speed[0]),
    }
    for quantity, value in expected.items():
        np.testing.assert_allclose(quantity(spec.scene, params, state), value)


def test_a_state_comes_back_from_the_centre_of_mass():
    params = off_center(scene())
    array = np.random.default_rng(0).normal(size=(1, 6))
    state = State(jnp.asarray(array[:, :3]), jnp.asarray(array[:, 3:]))
    there = state_of_center(params, state)
    assert np.abs(there.array - state.array).max() > 0.05
    back = state_of_reference(params, there)
    np.testing.assert_allclose(back.array, array, atol=1e-12)


@pytest.mark.slow
def test_derivatives_by_the_centre_of_mass_are_those_of_differences():
    spec = scene()
    start = State(jnp.zeros((1, 3)), jnp.array([[0.1, 0.2, 0.8]]))
    wrenches = jnp.broadcast_to(jnp.array([4.0, -3.0, 0.1]), (20, 1, 3))

    def end(center):
        params = with_center(spec.params(), center)
        return rollout(spec.scene, params, start, wrenches)[0].array[-1, 0]

    ours = jax.jacrev(end)(jnp.asarray(CENTER))
    for axis in range(2):
        shift = 1e-5 * np.eye(2)[axis]
        change = end(jnp.asarray(CENTER + shift)) - end(jnp.asarray(CENTER - shift))
        np.testing.assert_allclose(ours[:, axis], change / 2e-5, atol=1e-6)


@pytest.mark.slow
def test_contact_meets_the_outline_where_it_is():
    """A box falls on the floor and tips to its heavy side."""
    contact = {"friction": 0.8, "restitution": 0.0}
    floor = {"name": "floor", "static": True, "pose": [0, -0.5, 0]}
    floor |= {"shape": {"type": "box", "half_extents": [3, 0.5]}, "contact": contact}
    # Feet away from the middle play no part; the mass hangs over the corner.
    box = {"name": "box", "density": 20.0, "pose": [0, 0.21, 0], "contact": contact}
    box |= {"shape": {"type": "box", "half_extents": [0.05, 0.2]}}
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0, -9.81],
            "dt": 1 / 60,
            "bodies": [floor, box],
        }
    )
    stays = with_center(spec.params(), (0.0, 0.0), (0.03, 0.0))
    tips = with_center(spec.params(), (0.0, 0.0), (0.07, 0.0))
    push = jnp.zeros((60, 2, 3))
    ends = [
        rollout(spec.scene, params, spec.initial_state(), push)[0].pose[-1]
        for params in (stays, tips)
    ]
    assert abs(ends[0][1, 2]) < 0.02
    assert ends[0][1, 1] == pytest.approx(0.2, abs=5e-3)
    assert ends[1][1, 2] < -1.0
    np.testing.assert_allclose(ends[1][0], [0, -0.5, 0], atol=1e-12)
