"""The robot's kinematics: against complex numbers, finite differences, and itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import ArmScene, MobileArm, arm_scene
from boomdp_jax.physics import constraint_error, scene_spec_from_dict
from tests.envs.arm_rooms import FOLDED, ROBOT, room

NUM_CASES = 128


def draws(seed: int = 0, num: int = NUM_CASES) -> np.ndarray:
    rng = np.random.default_rng(seed)
    limit = [2.0, 2.0, 4.0, *ROBOT.joint_limit]
    return rng.uniform(-1.0, 1.0, (num, 5)) * limit


def by_complex_numbers(q: np.ndarray) -> tuple[complex, complex, complex]:
    """Shoulder, elbow and gripper."""
    shoulder = complex(q[0], q[1]) + ROBOT.shoulder * np.exp(1j * q[2])
    elbow = shoulder + ROBOT.upper_arm * np.exp(1j * (q[2] + q[3]))
    return shoulder, elbow, elbow + ROBOT.forearm * np.exp(1j * q[2:].sum())


GRIPPERS = jax.jit(jax.vmap(ROBOT.gripper))
BODIES = jax.jit(jax.vmap(ROBOT.body_poses))


def test_gripper_and_links_are_where_complex_numbers_put_them():
    cases = draws()
    grippers, poses = np.asarray(GRIPPERS(cases)), np.asarray(BODIES(cases))
    for q, gripper, bodies in zip(cases, grippers, poses, strict=True):
        shoulder, elbow, tip = by_complex_numbers(q)
        assert abs(complex(*gripper[:2]) - tip) < 1e-12
        assert abs(gripper[2] - q[2:].sum()) < 1e-12
        assert abs(complex(*bodies[1, :2]) - (shoulder + elbow) / 2) < 1e-12
        assert abs(complex(*bodies[2, :2]) - (elbow + tip) / 2) < 1e-12


@pytest.mark.slow
def test_derivative_of_gripper_is_that_of_finite_differences():
    cases, step = draws(1), 1e-6
    slopes = jax.jit(jax.vmap(jax.jacfwd(ROBOT.gripper)))(cases)
    for i in range(5):
        shift = step * np.eye(5)[i]
        ahead, behind = GRIPPERS(cases + shift), GRIPPERS(cases - shift)
        error = (ahead - behind) / (2.0 * step) - slopes[:, :, i]
        assert np.max(np.abs(error)) < 1e-8


def test_arm_angles_lead_back_to_the_point_and_hold_those_it_came_from():
    cases = draws(2)
    grippers = GRIPPERS(cases)
    angles, is_reached = jax.jit(jax.vmap(ROBOT.arm_angles))(
        cases[:, :3], grippers[:, :2]
    )
    distance = np.abs(np.asarray(angles) - cases[:, None, 3:]).max(axis=-1)
    own = np.argmin(distance, axis=1)
    assert np.max(distance.min(axis=1)) < 1e-6
    assert np.all(np.asarray(is_reached)[np.arange(NUM_CASES), own])
    for side in range(2):
        back = np.concatenate([cases[:, :3], angles[:, side]], axis=1)
        assert np.max(np.abs((GRIPPERS(back) - grippers)[:, :2])) < 1e-6


def test_points_beyond_the_arm_and_beyond_its_joints_are_not_reached():
    base = jnp.zeros(3)
    stretched = ROBOT.shoulder + ROBOT.upper_arm + ROBOT.forearm
    points = jnp.array([[stretched + 1e-3, 0.0], [-0.6, 0.0], [ROBOT.shoulder, 0.0]])
    is_reached = jax.jit(jax.vmap(ROBOT.arm_angles, in_axes=(None, 0)))(base, points)[1]
    assert not is_reached.any()


def test_configuration_around_a_gripper_is_the_one_it_came_from():
    cases = draws(3)
    back = jax.jit(jax.vmap(ROBOT.around_gripper))(GRIPPERS(cases), cases[:, 3:])
    assert np.max(np.abs(back - cases)) < 1e-12


def test_no_corner_moves_further_than_the_levers_say():
    first, second = draws(4), draws(5)
    # Small changes too, where the bound is nearly met.
    second[::2] = first[::2] + 1e-3 * second[::2]
    w = ROBOT.half_width
    lengths = np.array([ROBOT.upper_arm, ROBOT.forearm]) / 2.0
    signs = np.array([[a, b] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    corners = [signs * [length, w] for length in lengths]
    rim = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 16))
    corners = [ROBOT.base_radius * np.stack([rim.real, rim.imag], 1), *corners]

    def points(cases):
        poses = np.asarray(BODIES(cases))
        found = []
        for body, own in enumerate(corners):
            spun = own @ np.array([1.0, 1j]) * np.exp(1j * poses[:, body, 2:])
            found.append(spun + (poses[:, body, :2] @ np.array([1.0, 1j]))[:, None])
        return np.concatenate(found, axis=1)

    moved = np.abs(points(second) - points(first)).max(axis=1)
    bound = np.abs(second - first) @ ROBOT.levers
    assert np.all(moved <= bound + 1e-12)


def test_robot_in_a_scene_is_joined_where_its_configuration_says():
    world = room()
    q = draws(6, 1)[0]
    state = world.state(q)
    error = jax.jit(constraint_error)(world.scene, world.params(), state)
    assert error < 1e-12
    np.testing.assert_allclose(world.configuration(state), q, atol=1e-12)
    assert not world.rates(state).any()
    mass = np.asarray(world.params().density * world.scene.area)
    np.testing.assert_allclose(mass[list(world.bodies)].sum(), ROBOT.mass)


def test_arm_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="base_radius: expected a finite number above"):
        MobileArm(base_radius=-1.0)
    with pytest.raises(ValueError, match="shoulder_limit: expected one that keeps"):
        MobileArm(shoulder_limit=2.4)


def test_scene_without_the_robot_is_refused():
    world = arm_scene(ROBOT, FOLDED, [])
    content = world.spec.to_dict()
    with pytest.raises(ValueError, match="constraints: expected the joints of"):
        ArmScene(ROBOT, scene_spec_from_dict(content | {"constraints": []}))
    content |= {"constraints": [], "bodies": content["bodies"][:2]}
    with pytest.raises(ValueError, match="body: expected one of robot base, robot up"):
        ArmScene(ROBOT, scene_spec_from_dict(content))


@pytest.mark.usefixtures("no_type_checks")
@pytest.mark.parametrize(
    ("configuration", "message"),
    [
        (FOLDED[:4], r"expected five finite numbers, got \[-1\.4, 0\.2, 0\.0, 1\.4\]$"),
        (
            [0.0, np.nan, 0.0, 0.0, 0.0],
            r"expected five finite numbers, got .* nan",
        ),
        (
            [0.0, 0.0, 0.0, 2.0, 0.0],
            r"expected an angle of the shoulder within 1\.9 rad to either side, got 2$",
        ),
        (
            [0.0, 0.0, 0.0, 0.0, -2.7],
            r"expected an angle of the elbow within 2\.6 rad .*, got -2\.7$",
        ),
    ],
)
def test_configuration_that_the_arm_cannot_have_is_refused(configuration, message):
    with pytest.raises(ValueError, match=f"^configuration: {message}"):
        arm_scene(ROBOT, configuration, [])


def test_arm_may_start_at_its_limits_in_single_precision():
    limit = ROBOT.joint_limit.astype(np.float32)
    arm_scene(ROBOT, np.array([0.0, 0.0, 9.0, *limit], np.float32), [])
