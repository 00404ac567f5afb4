"""Gradients: both modes against finite differences, and finite at every kink."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from boomdp_jax.physics import rollout
from tests.physics.scenes import make_params, make_scene, make_state
from tests.reference.planar_dynamics import Ground, Pin, Rod, Wheel, World

NUM_STEPS = 10
KINDS = ["revolute", "distance", "wheel", "ground"]
BRICK = World([(0.3, 0.1)], [20.0], gravity=(0.3, -2.0))
PUSH = [[1.0, 0.5, 0.1]]
LEVEL, MOVING = [[0.0, 0.0, 0.0]], [[0.8, -0.5, 1.5]]
PINNED = [[1.5 * 0.2, -1.5 * 0.1, 1.5]]
WHEEL = Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (100.0, 100.0))
LIMITED = Wheel(0, (-0.2, 0.05), 0.3, (0.4, 8.0), (1.0, 2.0))
PIN = Pin(0, (0.1, 0.2), (0.1, 0.2), viscous=0.2, dry=100.0)
TIRED = Pin(0, (0.1, 0.2), (0.1, 0.2), viscous=0.2, dry=0.1)
ROD = Rod(0, (0.1, 0.0), (0.1, 0.5), 0.5)
SLIPPERY, STICKY = Ground(0, 0.2, 400.0), Ground(0, 0.5, 400.0)

CASES = {
    "free": (BRICK, MOVING, PUSH),
    "wheel": (BRICK.with_(wheels=[WHEEL]), MOVING, PUSH),
    "wheel at zero velocity": (BRICK.with_(wheels=[WHEEL]), LEVEL, PUSH),
    "slipping wheel": (BRICK.with_(wheels=[LIMITED]), MOVING, PUSH),
    "pin": (BRICK.with_(pins=[PIN]), PINNED, PUSH),
    "pin with slipping friction": (BRICK.with_(pins=[TIRED]), PINNED, PUSH),
    "pin at zero velocity": (BRICK.with_(pins=[PIN]), LEVEL, PUSH),
    "pin and wheel": (BRICK.with_(pins=[PIN], wheels=[WHEEL]), PINNED, PUSH),
    "rod": (BRICK.with_(rods=[ROD]), [[0.8, 0.0, 0.0]], PUSH),
    "sliding on the ground": (BRICK.with_(grounds=[SLIPPERY]), MOVING, PUSH),
    "sticking to the ground": (BRICK.with_(grounds=[STICKY]), LEVEL, PUSH),
}


def numbers_of(world: World, twist, push):
    """Every number that a gradient may be taken of, by name, and the params."""
    params = make_params(world)
    numbers = {
        "density": params.density,
        "start": make_state(LEVEL, twist),
        "wrench": jnp.asarray(push, float),
        "gravity": jnp.asarray(world.gravity, float),
    }
    for kind in KINDS:
        for name, leaf in vars(getattr(params, kind)).items():
            if leaf is not None and jnp.issubdtype(leaf.dtype, jnp.floating):
                numbers[f"{kind}.{name}"] = leaf
    return numbers, params


def end(numbers, scene, params):
    """One number of a rollout's end, as a function of all that it depends on."""
    changes = {"density": numbers["density"]}
    for kind in KINDS:
        slots = getattr(params, kind)
        new = {k.split(".")[1]: v for k, v in numbers.items() if k.startswith(kind)}
        changes[kind] = type(slots)(**{**vars(slots), **new})
    changed = type(params)(**{**vars(params), **changes})
    tilted = type(scene)(**{**vars(scene), "gravity": numbers["gravity"]})
    wrenches = jnp.tile(numbers["wrench"], (NUM_STEPS, 1, 1))
    states, _ = rollout(tilted, changed, numbers["start"], wrenches)
    weights = jnp.asarray([[1.0, -0.7, 0.4]], numbers["density"].dtype)
    return jnp.sum(weights * (states.pose[-1] + 0.3 * states.twist[-1]))


# Compiled once for each set of slots, whatever they hold.
values = jax.jit(jax.vmap(end, in_axes=(0, None, None)))
backward = jax.jit(jax.value_and_grad(end))


@jax.jit
def forward(numbers, direction, scene, params):
    """Derivative along a direction, in forward mode."""
    return jax.jvp(lambda n: end(n, scene, params), (numbers,), (direction,))[1]


def _cases(names, quick):
    """Each compiles for ten seconds and more; some are enough for a quick look."""
    slow = pytest.mark.slow
    return [n if n in quick else pytest.param(n, marks=slow) for n in names]


@pytest.mark.parametrize("name", _cases(CASES, ("free", "wheel")))
@pytest.mark.slow
def test_both_modes_agree_with_finite_differences(name):
    world, twist, push = CASES[name]
    numbers, params = numbers_of(world, twist, push)
    scene = make_scene(world)
    vector, unravel = ravel_pytree(numbers)
    step = 1e-6
    nudges = step * np.eye(vector.size)
    up, down = (
        values(
            jax.vmap(unravel)(jnp.asarray(np.asarray(vector)[None] + sign * nudges)),
            scene,
            params,
        )
        for sign in (1.0, -1.0)
    )
    expected = np.asarray((up - down) / (2 * step))
    slopes, _ = ravel_pytree(backward(numbers, scene, params)[1])
    np.testing.assert_allclose(slopes, expected, rtol=1e-5, atol=1e-7)
    direction = np.random.default_rng(4).normal(size=vector.size)
    along = forward(numbers, unravel(jnp.asarray(direction)), scene, params)
    np.testing.assert_allclose(along, slopes @ direction, rtol=1e-9, atol=1e-12)
    assert np.max(np.abs(expected)) > 1e-3


AWKWARD = {
    "at rest on stiff dry ground": (
        BRICK.with_(grounds=[Ground(0, 0.4, 1e6)], gravity=(0.0, 0.0)),
        LEVEL,
        [[0.0, 0.0, 0.0]],
    ),
    "just slipping": (BRICK.with_(grounds=[Ground(0, 0.4, 1e6)]), MOVING, PUSH),
    "rigid wheel at rest": (
        BRICK.with_(wheels=[Wheel(0, (0.0, 0.0), 0.0, (0.0, 1e6), (1.0, 1.0))]),
        LEVEL,
        [[0.0, 0.0, 0.0]],
    ),
    "rod of no length": (
        BRICK.with_(rods=[Rod(0, (0.1, 0.1), (0.1, 0.1), 0.0)]),
        LEVEL,
        PUSH,
    ),
    "rod whose ends meet": (
        BRICK.with_(rods=[Rod(0, (0.1, 0.1), (0.1, 0.1), 0.3)]),
        LEVEL,
        PUSH,
    ),
    "pin at the centre of mass": (
        BRICK.with_(pins=[Pin(0, (0.0, 0.0), (0.0, 0.0), viscous=0.2, dry=0.1)]),
        LEVEL,
        [[0.0, 0.0, 0.0]],
    ),
}


@pytest.mark.parametrize("name", AWKWARD)
@pytest.mark.slow
def test_gradients_are_finite_at_kinks(name, precision):
    world, twist, push = AWKWARD[name]
    numbers, params = numbers_of(world, twist, push)
    value, slopes = backward(numbers, make_scene(world), params)
    assert np.isfinite(value)
    for key, leaf in slopes.items():
        assert all(np.all(np.isfinite(part)) for part in jax.tree.leaves(leaf)), key


@pytest.mark.parametrize("name", ["slipping wheel", "pin", "rod"])
@pytest.mark.slow
def test_single_precision_gradients_are_close_to_double_ones(name):
    world, twist, push = CASES[name]

    def gradient():
        numbers, params = numbers_of(world, twist, push)
        return ravel_pytree(backward(numbers, make_scene(world), params)[1])[0]

    double = np.asarray(gradient())
    with jax.enable_x64(False):
        single = np.asarray(gradient())
    assert single.dtype == np.float32
    scale = np.max(np.abs(double))
    np.testing.assert_allclose(single, double, rtol=5e-3, atol=5e-4 * scale)
