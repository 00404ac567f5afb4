"""An inactive slot adds exactly nothing: to the motion, and to any gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import Params, Scene, empty_params, rollout
from tests.physics.scenes import make_params, make_scene, make_state, run_chunk
from tests.reference.planar_dynamics import Ground, Pin, Rod, Wheel, World

KINDS = ["revolute", "distance", "wheel", "ground"]
START, TWIST = [[0.2, -0.1, 0.4]], [[0.8, -0.5, 1.5]]
FULL = World(
    [(0.3, 0.1)],
    [20.0],
    gravity=(0.3, -1.0),
    pins=[Pin(0, (0.1, 0.2), (0.3, 0.0), viscous=0.2, dry=1.0)],
    rods=[Rod(0, (-0.1, 0.1), (0.5, 0.3), 0.4)],
    wheels=[Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (1.0, 2.0))],
    grounds=[Ground(0, 0.2, 50.0)],
)


def one_foot(world: World) -> Scene:
    """The world's scene on a single foot, which compiles faster than four."""
    scene = make_scene(world)
    changes = {"feet": scene.feet[:, :1], "foot_load": jnp.ones((1, 1))}
    return type(scene)(**{**vars(scene), **changes})


def switched(params: Params, active: dict[str, bool]) -> Params:
    """Switch whole kinds of constraints on or off."""
    changes = {}
    for kind, is_on in active.items():
        slots = getattr(params, kind)
        mask = jnp.full_like(slots.active, is_on)
        changes[kind] = type(slots)(**{**vars(slots), "active": mask})
    return type(params)(**{**vars(params), **changes})


def emptied(params: Params, kinds) -> Params:
    """Write zeros into every number of some kinds."""
    changes = {k: jax.tree.map(jnp.zeros_like, getattr(params, k)) for k in kinds}
    return type(params)(**{**vars(params), **changes})


def push(params: Params):
    """A short rollout of the full world under other params."""
    scene, state = one_foot(FULL), make_state(START, TWIST)
    wrenches = jnp.tile(jnp.asarray([[1.0, 0.5, 0.1]], float), (50, 1, 1))
    return run_chunk(scene, params, state, wrenches, jnp.asarray(0.02, float))


@pytest.mark.parametrize("kept", [None, *KINDS])
@pytest.mark.slow
def test_what_an_inactive_slot_holds_does_not_matter_to_the_bit(kept, precision):
    off = {kind: kind == kept for kind in KINDS}
    params = switched(make_params(FULL), off)
    empty = emptied(params, [kind for kind in KINDS if kind != kept])
    assert not jax.tree.all(jax.tree.map(jnp.array_equal, params, empty))
    states, info = push(params)
    expected, expected_info = push(empty)
    np.testing.assert_array_equal(states.pose, expected.pose)
    np.testing.assert_array_equal(states.twist, expected.twist)
    np.testing.assert_array_equal(info.constraint_error, expected_info.constraint_error)


@pytest.mark.slow
def test_slots_that_are_not_used_do_not_change_the_motion():
    world = FULL.with_(pins=[], rods=[], grounds=[])
    scene, state = one_foot(world), make_state(START, TWIST)
    rest = (state, jnp.ones((50, 1, 3)), jnp.asarray(0.02))
    narrow, _ = run_chunk(scene, make_params(world), *rest)
    wide, _ = run_chunk(scene, make_params(world, (1, 1, 1, 1)), *rest)
    np.testing.assert_allclose(narrow.pose, wide.pose, atol=1e-12)
    np.testing.assert_allclose(narrow.twist, wide.twist, atol=1e-12)


@pytest.mark.slow
def test_body_without_active_slots_flies_freely():
    params = switched(make_params(FULL), dict.fromkeys(KINDS, False))
    states, info = push(params)
    time = 0.02 * np.arange(1, 51)[:, None]
    mass, inertia = FULL.mass[0], FULL.inertia[0]
    rate = np.array([1.0 / mass + 0.3, 0.5 / mass - 1.0, 0.1 / inertia])
    expected = np.array(START) + np.array(TWIST) * time + 0.5 * rate * time**2
    np.testing.assert_allclose(states.pose[:, 0], expected, atol=1e-12)
    assert np.all(np.asarray(info.constraint_error) == 0.0)


def loss(numbers, params, scene, state):
    """A function of every number of a rollout's end."""
    filled = jax.tree.map(
        lambda leaf, number: leaf if number is None else number,
        params,
        numbers,
        is_leaf=lambda leaf: leaf is None,
    )
    states, _ = rollout(scene, filled, state, jnp.ones((5, 1, 3)))
    weights = jnp.asarray([[1.0, -0.7, 0.4]])
    return jnp.sum(weights * (states.pose[-1] + 0.3 * states.twist[-1]))


def floating(params: Params) -> Params:
    """The same tree with None in place of masks and indices."""
    return jax.tree.map(
        lambda leaf: leaf if jnp.issubdtype(leaf.dtype, jnp.floating) else None, params
    )


gradient = jax.jit(jax.grad(loss))


@pytest.mark.slow
@pytest.mark.parametrize("content", ["random", "zero", "infinite dry limit"])
def test_inactive_slots_get_exactly_zero_gradient(content):
    params = switched(make_params(FULL), dict.fromkeys(KINDS, False))
    if content == "zero":
        params = emptied(params, KINDS)
    if content == "infinite dry limit":
        wheel = params.wheel
        endless = type(wheel)(
            **{**vars(wheel), "dry": jnp.full_like(wheel.dry, jnp.inf)}
        )
        params = type(params)(**{**vars(params), "wheel": endless})
    scene, state = one_foot(FULL), make_state(START, TWIST)
    slopes = gradient(floating(params), params, scene, state)
    for kind in KINDS:
        for leaf in jax.tree.leaves(getattr(slopes, kind)):
            np.testing.assert_array_equal(leaf, np.zeros_like(leaf))
    assert np.all(np.isfinite(slopes.density))
    assert np.all(slopes.density != 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_switching_one_slot_on_gives_it_a_gradient(kind):
    active = {other: other == kind for other in KINDS}
    params = switched(make_params(FULL), active)
    scene, state = one_foot(FULL), make_state(START, TWIST)
    slopes = gradient(floating(params), params, scene, state)
    for other in KINDS:
        leaves = jax.tree.leaves(getattr(slopes, other))
        assert all(np.all(np.isfinite(leaf)) for leaf in leaves)
        assert any(np.any(leaf != 0.0) for leaf in leaves) == active[other]


def test_empty_params_have_inactive_slots_of_the_asked_shape():
    params = empty_params(
        3, num_revolute=2, num_distance=1, num_wheel=4, num_ground=1, density=7.0
    )
    assert params.revolute.active.shape == (2,)
    assert params.distance.length.shape == (1,)
    assert params.wheel.viscous.shape == (3, 4, 2)
    assert params.ground.dry.shape == (3, 1)
    assert not any(np.any(getattr(params, kind).active) for kind in KINDS)
    np.testing.assert_array_equal(params.density, [7.0, 7.0, 7.0])
