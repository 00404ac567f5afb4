"""Symmetries of the laws: frames, labels, and parameters that mean the same motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import State, rollout
from tests.physics.scenes import make_params, make_scene, make_state, run, run_chunk
from tests.reference.planar_dynamics import Ground, Pin, Wheel, World, rotation

BRICK = World([(0.3, 0.1)], [20.0])
START = np.array([[0.2, -0.1, 0.4]])
TWIST = np.array([[0.8, -0.5, 1.5]])
PUSH = np.array([[1.0, 0.5, 0.1]])


def with_wheels(*wheels: Wheel) -> World:
    return BRICK.with_(wheels=list(wheels))


def push(world: World):
    """Where a push takes a moving brick."""
    return run(world, START, TWIST, num_steps=50, wrench=PUSH).pose


@pytest.mark.slow
def test_turning_and_moving_the_world_turns_and_moves_the_motion():
    num_cases, num_steps = 64, 20
    generator = np.random.default_rng(3)
    turns = generator.uniform(-np.pi, np.pi, num_cases)
    shifts = generator.uniform(-5.0, 5.0, (num_cases, 2))
    anchors = generator.uniform(-0.3, 0.3, (num_cases, 2))
    wheels = generator.uniform(-0.3, 0.3, (num_cases, 3))
    twists = generator.normal(size=(num_cases, 1, 3))
    forces = generator.normal(size=(num_cases, num_steps, 1, 3))
    is_pinned = generator.random(num_cases) < 0.5
    world = BRICK.with_(
        gravity=(0.4, -1.0),
        pins=[Pin(0, (0.0, 0.0), (0.0, 0.0), viscous=0.1, dry=0.3)],
        wheels=[Wheel(0, (0.0, 0.0), 0.0, (1.0, 20.0), (2.0, 5.0))],
    )
    params, scene = make_params(world), make_scene(world)

    def case(params, scene, turn, shift, anchor, wheel, twist, force, is_pinned):
        cos, sin = jnp.cos(turn), jnp.sin(turn)
        matrix = jnp.array([[cos, -sin], [sin, cos]])

        def turned(rows):
            return jnp.concatenate([rows[..., :2] @ matrix.T, rows[..., 2:]], axis=-1)

        offset = jnp.concatenate([shift, turn[None]])
        pose = turned(jnp.zeros((1, 3))) + offset[None]
        joint = type(params.revolute)(
            **{
                **vars(params.revolute),
                "active": is_pinned[None],
                "anchor_a": anchor[None],
                "anchor_b": (matrix @ anchor + shift)[None],
            }
        )
        rolling = type(params.wheel)(
            **{
                **vars(params.wheel),
                "position": wheel[None, None, :2],
                "heading": wheel[None, None, 2],
            }
        )
        spin = twist[0, 2] * is_pinned
        about_pin = jnp.array([[spin * anchor[1], -spin * anchor[0], spin]])
        twist = jnp.where(is_pinned, about_pin, twist)
        moved = type(params)(
            **{**vars(params), "revolute": joint, "wheel": rolling},
        )
        tilted = type(scene)(**{**vars(scene), "gravity": matrix @ scene.gravity})
        states, _ = rollout(tilted, moved, State(pose, turned(twist)), turned(force))
        back = states.pose - offset[None, None]
        return jnp.concatenate([back[..., :2] @ matrix, back[..., 2:]], axis=-1)

    batched = jax.jit(jax.vmap(case, in_axes=(None, None, *[0] * 7)))
    rest = (anchors, wheels, twists, forces, is_pinned)
    moved = batched(params, scene, turns, shifts, *rest)
    plain = batched(params, scene, 0 * turns, 0 * shifts, *rest)
    assert np.max(np.abs(plain[:, -1])) > 0.1
    assert np.max(np.abs(moved - plain)) < 1e-8


@pytest.mark.slow
def test_relabelling_bodies_relabels_the_motion(precision):
    pins = [
        Pin(0, (0.28, 0.0), (-0.18, 0.05), b=1, viscous=0.1),
        Pin(0, (-0.3, 0.0), (0.0, 0.0)),
    ]
    world = World([(0.3, 0.1), (0.2, 0.15)], [20.0, 30.0], (0.2, -9.81), pins=pins)
    swapped = World(
        world.half_extents[::-1],
        world.density[::-1],
        world.gravity,
        pins=[
            Pin(1, (-0.3, 0.0), (0.0, 0.0)),
            Pin(0, (-0.18, 0.05), (0.28, 0.0), b=1, viscous=0.1),
        ],
    )
    pose = np.array([[0.3, 0.0, 0.0], [0.3 + 0.46, -0.05, 0.0]])
    push = np.array([[1.0, 2.0, 0.1], [0.5, -1.0, 0.2]])
    one = run(world, pose, num_steps=50, wrench=push)
    other = run(swapped, pose[::-1], num_steps=50, wrench=push[::-1])
    tolerance = precision.choose(single=2e-3, double=1e-8)
    np.testing.assert_allclose(one.pose, other.pose[:, ::-1], atol=tolerance)


def test_wheel_heading_turned_by_half_a_turn_changes_nothing(precision):
    wheel = Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (1.0, 2.0))
    reverse = Wheel(0, (-0.2, 0.05), 0.3 + np.pi, (0.4, 8.0), (1.0, 2.0))
    tolerance = precision.choose(single=1e-5, double=1e-11)
    np.testing.assert_allclose(
        push(with_wheels(wheel)), push(with_wheels(reverse)), atol=tolerance
    )


def test_wheel_turned_by_a_quarter_swaps_its_coefficients(precision):
    wheel = Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (1.0, 2.0))
    quarter = Wheel(0, (-0.2, 0.05), 0.3 + 0.5 * np.pi, (8.0, 0.4), (2.0, 1.0))
    tolerance = precision.choose(single=1e-5, double=1e-11)
    np.testing.assert_allclose(
        push(with_wheels(wheel)), push(with_wheels(quarter)), atol=tolerance
    )


def on_axle(along: float, lateral: float) -> Wheel:
    """A wheel that only resists sideways, moved along its own axle."""
    x, y = np.array([-0.2, 0.05]) + along * rotation(0.3)[:, 1]
    return Wheel(0, (float(x), float(y)), 0.3, (0.0, lateral))


@pytest.mark.slow
def test_two_coaxial_wheels_act_as_one_with_the_sum(precision):
    tolerance = precision.choose(single=1e-5, double=1e-11)
    pair = with_wheels(on_axle(0.1, 3.0), on_axle(-0.15, 5.0))
    np.testing.assert_allclose(
        push(pair), push(with_wheels(on_axle(0.0, 8.0))), atol=tolerance
    )


def test_wheel_without_rolling_friction_may_slide_along_its_axle(precision):
    tolerance = precision.choose(single=1e-5, double=1e-11)
    np.testing.assert_allclose(
        push(with_wheels(on_axle(0.4, 8.0))),
        push(with_wheels(on_axle(0.0, 8.0))),
        atol=tolerance,
    )


@pytest.mark.slow
def test_half_track_of_zero_is_a_single_contact():
    wheel = Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (1.0, 2.0))
    world = with_wheels(wheel)
    params = make_params(world)
    double = type(params.wheel)(
        **{**vars(params.wheel), "half_track": jnp.zeros((1, 1))}
    )
    wide = type(params)(**{**vars(params), "wheel": double})
    arguments = (make_state(START, TWIST), jnp.zeros((50, 1, 3)), jnp.asarray(0.02))
    one, _ = run_chunk(make_scene(world), params, *arguments)
    two, _ = run_chunk(make_scene(world), wide, *arguments)
    np.testing.assert_allclose(one.pose, two.pose, atol=1e-11)


def test_mirrored_world_moves_mirrored():
    wheel = Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (1.0, 2.0))
    mirror = np.array([1.0, -1.0, -1.0])
    other = Wheel(0, (-0.2, -0.05), -0.3, (0.4, 8.0), (1.0, 2.0))
    one = push(with_wheels(wheel))
    two = run(
        with_wheels(other),
        START * mirror,
        TWIST * mirror,
        num_steps=50,
        wrench=PUSH * mirror,
    ).pose
    np.testing.assert_allclose(one, two * mirror, atol=1e-11)


def test_scaling_masses_and_forces_together_changes_nothing():
    ground = Ground(0, 0.1, 200.0)
    world = BRICK.with_(grounds=[ground], gravity=(0.5, -1.0))
    heavy = world.with_(density=[60.0], grounds=[Ground(0, 0.1, 600.0)])
    one = run(world, START, TWIST, num_steps=50, wrench=PUSH)
    two = run(heavy, START, TWIST, num_steps=50, wrench=3.0 * PUSH)
    np.testing.assert_allclose(one.pose, two.pose, atol=1e-10)


def test_two_runs_agree_bit_for_bit(precision):
    world = with_wheels(Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (1.0, 2.0)))
    one = run(world, START, TWIST, num_steps=100, wrench=PUSH)
    two = run(world, START, TWIST, num_steps=100, wrench=PUSH)
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first, second)
