"""Transforms of JAX: jit, vmap and scan give what eager steps give, in one trace."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.compile_time import CompileClock
from boomdp_jax.physics import Actuator, prepare_step, rollout, step
from boomdp_jax.physics.motion import motion_of, state_of
from boomdp_jax.physics.step import next_motion
from tests.physics.scenes import make_params, make_scene, make_state
from tests.reference.planar_dynamics import Pin, Wheel, World

WORLD = World(
    [(0.3, 0.1)],
    [20.0],
    gravity=(0.3, -1.0),
    wheels=[Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (1.0, 2.0))],
)
PINNED = WORLD.with_(pins=[Pin(0, (0.1, 0.2), (0.1, 0.2), viscous=0.2, dry=1.0)])
PUSH = np.array([[1.0, 0.5, 0.1]])


def start(world: World = WORLD):
    return make_scene(world), make_params(world), make_state(np.zeros((1, 3)))


def assert_close(one, other, atol=1e-12):
    for first, second in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(first, second, atol=atol)


@pytest.mark.slow
def test_compiled_step_equals_the_eager_one(precision):
    scene, params, state = start()
    push = jnp.asarray(PUSH, float)
    tolerance = precision.choose(single=1e-5, double=1e-12)
    with jax.disable_jit():
        eager = step(scene, params, state, push)
    assert_close(jax.jit(step)(scene, params, state, push), eager, tolerance)


@pytest.mark.slow
def test_without_jit_nothing_is_compiled_twice():
    """As who tries it in a loop of Python's would have it."""
    scene, params, state = start(PINNED)
    pushes = jnp.asarray(np.tile(PUSH, (5, 1, 1)), float)

    def run():
        prepared = prepare_step(scene, params)
        jax.block_until_ready(rollout(scene, params, state, pushes))
        jax.block_until_ready(jax.vmap(step, (None, None, None, 0))(*world, pushes))
        now = step(*world, pushes[0])[0]
        return prepared(now, pushes[1])[0].array

    world = (scene, params, state)
    with CompileClock() as first:
        expected = run()
    with CompileClock() as again:
        np.testing.assert_array_equal(run(), expected)
    assert first.seconds > 0.0
    assert again.seconds == 0.0


@pytest.mark.parametrize(
    "more",
    [
        {},
        {
            "actuator": Actuator(
                gain=jnp.array([0.8]), bias=jnp.array([[0.1, 0.2, 0.3]])
            )
        },
        {"center_of_mass": jnp.array([[0.05, -0.02]])},
    ],
    ids=["plain", "actuator", "center of mass"],
)
def test_a_prepared_step_number_by_number_is_the_same(more):
    scene, params, state = start(PINNED)
    params = dataclasses.replace(params, **more)
    push = jnp.asarray(PUSH)

    @jax.jit
    def both(scene, params, state, push):
        prepared = prepare_step(scene, params)
        motion = motion_of(prepared(state, push)[0])
        return prepared(state_of(motion, 1), push)[0], next_motion(
            prepared, motion, push
        )

    expected, found = both(scene, params, state, push)
    assert_close(state_of(found, 1), expected, atol=1e-14)
    assert np.max(np.abs(expected.twist)) > 1e-3


def test_rollout_equals_a_loop_of_steps_with_the_cache_handed_on():
    scene, params, state = start()
    push = jnp.asarray(PUSH)
    one = jax.jit(step)
    states, infos = jax.jit(rollout)(scene, params, state, jnp.tile(push, (5, 1, 1)))
    cache = None
    for i in range(5):
        state, info = one(scene, params, state, push, cache=cache)
        cache = info.cache
        assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], states), state)
        np.testing.assert_allclose(infos.constraint_error[i], info.constraint_error)


def test_step_lengths_may_differ_within_a_rollout():
    scene, params, state = start()
    lengths = jnp.asarray([0.02, 0.005, 0.03])
    push = jnp.asarray(PUSH)
    states, _ = jax.jit(rollout)(
        scene, params, state, jnp.tile(push, (3, 1, 1)), dt=lengths
    )
    one = jax.jit(step)
    for i in range(3):
        state, _ = one(scene, params, state, push, dt=lengths[i])
        assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], states), state)


def test_default_step_length_is_the_scenes():
    scene, params, state = start()
    push = jnp.asarray(PUSH)
    one = jax.jit(step)
    assert_close(
        one(scene, params, state, push), one(scene, params, state, push, dt=scene.dt)
    )


def test_vmap_over_hypotheses_equals_a_loop(precision):
    scene, params, state = start()
    densities = jnp.asarray([[5.0], [20.0], [40.0]], float)
    pushes = jnp.tile(jnp.asarray(PUSH, float), (5, 1, 1))

    def end(density):
        changed = type(params)(**{**vars(params), "density": density})
        return rollout(scene, changed, state, pushes)[0].array[-1]

    one = jax.jit(end)
    expected = np.stack([one(density) for density in densities])
    assert np.ptp(expected, axis=0).max() > 1e-4
    tolerance = precision.choose(single=1e-5, double=1e-12)
    np.testing.assert_allclose(jax.vmap(end)(densities), expected, atol=tolerance)


def test_scenes_of_different_rooms_stack():
    rooms = [
        WORLD.with_(half_extents=[extents], gravity=gravity)
        for extents, gravity in [((0.3, 0.1), (0.0, 0.0)), ((0.2, 0.2), (0.3, -1.0))]
    ]
    scenes = [make_scene(room) for room in rooms]
    _, params, state = start()
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    push = jnp.asarray(PUSH)
    together, _ = jax.jit(jax.vmap(step, in_axes=(0, None, None, None)))(
        stacked, params, state, push
    )
    one = jax.jit(step)
    for i, scene in enumerate(scenes):
        alone, _ = one(scene, params, state, push)
        assert_close(jax.tree.map(lambda leaf, i=i: leaf[i], together), alone)


def test_structures_step_lengths_and_numbers_share_one_trace():
    scene, params, state = start(PINNED)
    num_traces = 0

    @jax.jit
    def counted(scene, params, state, push, dt):
        nonlocal num_traces
        num_traces += 1
        return step(scene, params, state, push, dt=dt)[0].pose

    ends = []
    for is_pinned in (True, False):
        for has_wheel in (True, False):
            for dt in (0.01, 0.02):
                revolute = type(params.revolute)(
                    **{**vars(params.revolute), "active": jnp.asarray([is_pinned])}
                )
                wheel = type(params.wheel)(
                    **{**vars(params.wheel), "active": jnp.asarray([[has_wheel]])}
                )
                changes = {"revolute": revolute, "wheel": wheel}
                changed = type(params)(**{**vars(params), **changes})
                ends.append(counted(scene, changed, state, jnp.asarray(PUSH), dt))
    assert num_traces == 1
    assert len({tuple(np.ravel(end)) for end in ends}) == len(ends)


def test_float_type_of_the_input_is_kept(precision):
    scene, params, state = start()
    next_state, info = step(scene, params, state, jnp.asarray(PUSH, float))
    expected = np.dtype(f"float{precision.bits}")
    assert next_state.pose.dtype == expected
    assert next_state.twist.dtype == expected
    assert info.constraint_error.dtype == expected


@pytest.mark.slow
def test_single_precision_stays_single_while_double_is_enabled():
    scene, params, state = start()

    def single(tree):
        return jax.tree.map(
            lambda leaf: (
                leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf
            ),
            tree,
        )

    arguments = single((scene, params, state, jnp.asarray(PUSH)))
    next_state, _ = jax.jit(step)(*arguments)
    assert next_state.pose.dtype == np.float32
    expected, _ = jax.jit(step)(scene, params, state, jnp.asarray(PUSH))
    np.testing.assert_allclose(next_state.pose, expected.pose, atol=1e-5)
