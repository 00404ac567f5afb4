"""Feet with a size: a disc that spins and slides, both paths, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from boomdp_jax.physics import Params, State, empty_params, rollout, step
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.physics.retraced import OnGeneralPath

FRICTION, RADIUS, GRAVITY = 0.3, 0.2, 9.81
NUM_CASES = 256


def world(shape, **ground):
    """One body on a floor, of which the file gives no feet."""
    body = {"name": "body", "shape": shape, "pose": [0.0, 0.0, 0.0], "density": 20.0}
    floor = {"type": "ground", "a": "body", "dry": FRICTION, "viscous": 1e5} | ground
    content = {"schema": "planar-scene-1", "dt": 0.005, "bodies": [body]}
    content |= {"constraints": [floor], "normal_gravity": GRAVITY}
    return scene_spec_from_dict(content)


DISC = world({"type": "circle", "radius": RADIUS})
BOX = world({"type": "box", "half_extents": [0.3, 0.1]})


def motion(twist, num_steps):
    state = DISC.initial_state()
    state = State(state.pose, jnp.asarray([twist], state.pose.dtype))
    wrench = jnp.zeros((num_steps, 1, 3), state.pose.dtype)
    return rollout(DISC.scene, DISC.params(), state, wrench)[0]


def test_a_spinning_disc_slows_by_four_thirds_of_friction_over_its_radius():
    """Torque 2/3 mu m g R of an even pressure on an inertia m R² / 2."""
    slowing = 4.0 * FRICTION * GRAVITY / (3.0 * RADIUS)
    spin = motion([0.0, 0.0, 8.0], 60).twist[:, 0, 2]
    time = 0.005 * np.arange(1, 61)
    np.testing.assert_allclose(spin, 8.0 - slowing * time, atol=2e-3 * 8.0)


def even_pressure(time, twist):
    """Deceleration of a disc, integrated over its area."""
    share = (np.arange(60) + 0.5) / 60
    radius, angle = np.meshgrid(RADIUS * np.sqrt(share), 2 * np.pi * share)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    u, v = twist[0] - twist[2] * y, twist[1] + twist[2] * x
    speed = np.sqrt(u**2 + v**2 + 1e-12)
    force = FRICTION * GRAVITY
    torque = np.mean((x * v - y * u) / speed)
    gyration = RADIUS**2 / 2
    return [
        -force * np.mean(u / speed),
        -force * np.mean(v / speed),
        -force * torque / gyration,
    ]


@pytest.mark.parametrize("spin", [3.0, 12.0])
def test_a_disc_that_slides_and_spins_stops_both_at_once(spin):
    """Each slows the other (Farkas et al., PRL 90, 248302, 2003)."""
    start = [0.8, 0.0, spin]
    times = 0.005 * np.arange(1, 61)
    expected = solve_ivp(even_pressure, (0, 0.3), start, t_eval=times, rtol=1e-8).y
    found = np.asarray(motion(start, 60).twist[:, 0]).T
    # Two and a half parts in a hundred of the speed at the start.
    np.testing.assert_allclose(found[0], expected[0], atol=0.02)
    np.testing.assert_allclose(RADIUS * found[2], RADIUS * expected[2], atol=0.02)


def hypothesis(key) -> Params:
    """Ground and a wheel, each active or not, with the floor's nuisances."""
    keys = iter(jax.random.split(key, 12))

    def around(middle, *shape):
        return middle * jnp.exp(jax.random.normal(next(keys), shape))

    params = empty_params(1, num_wheel=1, num_ground=1)
    ground = type(params.ground)(
        active=jax.random.bernoulli(next(keys), 0.8, (1, 1)),
        dry=around(0.3, 1, 1),
        viscous=around(100.0, 1, 1),
        torque_share=jax.random.uniform(next(keys), (1, 1)),
        load_shift=0.05 * jax.random.normal(next(keys), (1, 1, 2)),
    )
    wheel = type(params.wheel)(
        active=jax.random.bernoulli(next(keys), 0.5, (1, 1)),
        position=0.2 * jax.random.normal(next(keys), (1, 1, 2)),
        heading=3.0 * jax.random.normal(next(keys), (1, 1)),
        viscous=around(30.0, 1, 1, 2),
        dry=around(3.0, 1, 1, 2),
    )
    whole = vars(params) | {"density": around(20.0, 1)}
    return type(params)(**whole | {"ground": ground, "wheel": wheel})


def case(key):
    keys = jax.random.split(key, 4)
    pose, twist, wrench = (jax.random.normal(k, (1, 3)) for k in keys[:3])
    return (
        hypothesis(keys[3]),
        State(pose, twist),
        wrench * jnp.array([[8.0, 8.0, 1.0]]),
    )


def several(params, state, wrench):
    wrenches = jnp.broadcast_to(wrench, (5, *wrench.shape))
    return rollout(BOX.scene, params, state, wrenches, dt=0.002)[0].array


@pytest.mark.slow
def test_both_paths_rub_alike():
    cases = jax.vmap(case)(jax.random.split(jax.random.key(0), NUM_CASES))
    assert np.all(np.asarray(BOX.scene.foot_size) > 0.01)
    many = jax.vmap(several)
    gap = np.abs(np.asarray(jax.jit(many)(*cases)) - OnGeneralPath(many)(*cases))
    worst = np.max(gap, axis=(1, 2, 3))
    assert np.quantile(worst, 0.95) < 1e-6
    assert np.max(worst) < 1e-3


@pytest.mark.slow
def test_derivatives_are_those_of_differences():
    params, state, wrench = case(jax.random.key(3))
    ground = type(params.ground)(
        **vars(params.ground) | {"active": jnp.ones((1, 1), bool)}
    )

    def end(numbers):
        own = type(ground)(
            **vars(ground) | {"dry": numbers[:1], "viscous": numbers[1:]}
        )
        whole = type(params)(**vars(params) | {"ground": own})
        return jnp.sum(jnp.sin(step(BOX.scene, whole, state, wrench)[0].array))

    numbers = jnp.concatenate([ground.dry, ground.viscous])
    slopes = jax.grad(end)(numbers)
    for i in range(2):
        small = 1e-5 * float(numbers[i, 0])
        ahead, behind = (
            float(end(numbers.at[i].add(sign * small))) for sign in (1.0, -1.0)
        )
        expected = (ahead - behind) / (2 * small)
        assert float(slopes[i, 0]) == pytest.approx(expected, rel=1e-4)
