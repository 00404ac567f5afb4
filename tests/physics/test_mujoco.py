"""The same scenes in MuJoCo, with a fine Runge-Kutta step, move the same way."""

import mujoco
import numpy as np
import pytest

from tests.physics.scenes import run
from tests.reference.planar_dynamics import Pin, Wheel, World, rotation

TIME_STEP = 0.0005

HEADER = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{step}" gravity="0 {gravity} 0" integrator="RK4">
    <flag contact="disable"/>
  </option>
  <worldbody>{bodies}</worldbody>
</mujoco>
"""

BRICK = """
<body name="brick{index}" pos="{x} {y} 0">
  {joints}
  <inertial pos="{com_x} {com_y} 0" mass="{mass}" diaginertia="1 1 {inertia}"/>
  {children}
</body>
"""


def brick(world: World, index: int, *, at, joints: str, com, children: str = "") -> str:
    """One brick as MuJoCo's text; its frame is at its pivot."""
    return BRICK.format(
        index=index,
        x=at[0],
        y=at[1],
        joints=joints,
        com_x=com[0],
        com_y=com[1],
        mass=world.mass[index],
        inertia=world.inertia[index],
        children=children,
    )


def hinge(name: str, damping: float = 0.0) -> str:
    return f'<joint name="{name}" type="hinge" axis="0 0 1" damping="{damping}"/>'


def simulate(world: World, bodies: str, *, start, wrench, times) -> np.ndarray:
    """Centre of mass and heading of every brick at the given times."""
    text = HEADER.format(step=TIME_STEP, gravity=world.gravity[1], bodies=bodies)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start
    data.xfrc_applied[1:, [0, 1, 5]] = wrench
    poses = []
    for time in times:
        while data.time < time - 0.5 * TIME_STEP:
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        matrix = data.xmat[1:].reshape(-1, 3, 3)
        heading = np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0])
        poses.append(np.column_stack([data.xipos[1:, :2], heading]))
    return np.array(poses)


def assert_same_path(ours: np.ndarray, theirs: np.ndarray, *, atol: float) -> None:
    """Compare positions, and headings up to whole turns."""
    difference = ours - theirs
    turns = np.round(difference[..., 2] / (2 * np.pi))
    difference[..., 2] -= 2 * np.pi * turns
    assert np.max(np.abs(difference)) < atol, np.abs(difference).max(axis=(0, 1))


ARM = 0.25


@pytest.mark.parametrize(
    ("viscous", "gravity", "wrench"),
    [
        (0.0, -9.81, (0.0, 0.0, 0.0)),
        (0.25, -9.81, (0.0, 0.0, 0.0)),
        (0.1, 0.0, (1.5, -2.0, 0.3)),
    ],
    ids=["pendulum", "damped pendulum", "pinned box with forces"],
)
def test_pinned_box_moves_as_in_mujoco(viscous, gravity, wrench):
    world = World(
        [(0.3, 0.1)],
        [20.0],
        gravity=(0.0, gravity),
        pins=[Pin(0, (-ARM, 0.0), (0.1, 0.2), viscous=viscous)],
    )
    angle, spin = -0.4, 1.0
    arm = rotation(angle) @ [ARM, 0.0]
    pose = np.array([[0.1 + arm[0], 0.2 + arm[1], angle]])
    twist = np.array([[-spin * arm[1], spin * arm[0], spin]])
    times = 0.005 * np.arange(20, 401, 20)
    bodies = brick(
        world, 0, at=(0.1, 0.2), joints=hinge("pin", viscous), com=(ARM, 0.0)
    )
    theirs = simulate(
        world, bodies, start=([angle], [spin]), wrench=[wrench], times=times
    )
    ours = run(world, pose, twist, num_steps=400, dt=0.005, wrench=[wrench])
    assert_same_path(ours.pose[19::20], theirs, atol=2e-3)


@pytest.mark.slow
def test_double_pendulum_moves_as_in_mujoco():
    world = World(
        [(0.2, 0.05), (0.25, 0.05)],
        [30.0, 20.0],
        gravity=(0.0, -9.81),
        pins=[
            Pin(0, (-0.2, 0.0), (0.0, 0.0)),
            Pin(0, (0.2, 0.0), (-0.25, 0.0), b=1, viscous=0.02),
        ],
    )
    child = brick(world, 1, at=(0.4, 0.0), joints=hinge("elbow", 0.02), com=(0.25, 0.0))
    bodies = brick(
        world, 0, at=(0, 0), joints=hinge("shoulder"), com=(0.2, 0), children=child
    )
    times = 0.005 * np.arange(10, 201, 10)
    theirs = simulate(
        world, bodies, start=([0.0, 0.0], [0.0, 0.0]), wrench=[[0] * 3] * 2, times=times
    )
    start = np.array([[0.2, 0.0, 0.0], [0.65, 0.0, 0.0]])
    ours = run(world, start, num_steps=200, dt=0.005)
    assert_same_path(ours.pose[9::10], theirs, atol=5e-3)


def test_box_on_damped_slides_moves_as_on_a_wheel():
    rolling, lateral, heading = 0.8, 5.0, 0.6
    world = World(
        [(0.3, 0.1)], [20.0], wheels=[Wheel(0, (0.0, 0.0), heading, (rolling, lateral))]
    )
    axes = rotation(heading).T
    joints = "".join(
        f'<joint type="slide" axis="{axis[0]} {axis[1]} 0" damping="{damping}"/>'
        for axis, damping in zip(axes, (rolling, lateral), strict=True)
    )
    bodies = brick(world, 0, at=(0, 0), joints=joints, com=(0.0, 0.0))
    velocity, wrench = np.array([1.0, -0.5]), [1.0, 2.0, 0.0]
    times = 0.02 * np.arange(5, 101, 5)
    theirs = simulate(
        world,
        bodies,
        start=([0.0, 0.0], axes @ velocity),
        wrench=[wrench],
        times=times,
    )
    ours = run(
        world, np.zeros((1, 3)), [[*velocity, 0.0]], num_steps=100, wrench=[wrench]
    )
    assert_same_path(ours.pose[4::5], theirs, atol=5e-4)
