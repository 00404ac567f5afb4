import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core import make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.physics import scene_spec_from_dict


def scene_of(**fields):
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [
                {"name": "b", "shape": {"type": "box", "half_extents": [0.2, 0.1]}}
            ],
            "unknown": {"revolute": 1, "wheel": 1, "ground": 1, "distance": 1},
            **fields,
        }
    )


def block(**fields):
    spec = scene_of(**fields)
    state = np.zeros((3, 1, 6))
    return make_block(spec, (0,), make_history(state, state[..., :3], state, 0.02))


def decode(b, z, active=True):
    coordinates = b.target.log_likelihood.coordinates
    return coordinates(jnp.asarray(z), jnp.full(len(b.layout.slots), active))


def test_the_middle_of_the_coordinates_is_the_middle_of_the_prior():
    b = block()
    params = decode(b, np.zeros(b.layout.dim))
    mass = 30.0 * 0.08
    assert params.density[0] == pytest.approx(30.0)
    assert params.wheel.viscous[0, 0, 1] == pytest.approx(60.0 * mass)
    assert params.wheel.dry[0, 0, 1] == pytest.approx(0.5 * mass * 9.81)
    assert params.ground.dry[0, 0] == pytest.approx(0.3)
    assert params.ground.viscous[0, 0] == pytest.approx(0.3 * mass * 9.81 / 0.02)
    np.testing.assert_allclose(params.revolute.anchor_a, 0.0)


@pytest.mark.slow
def test_inactive_slots_hold_zeros_and_have_no_gradient():
    b = block()
    z = np.linspace(-1.0, 1.0, b.layout.dim)
    params = decode(b, z, active=False)
    for kind in (params.revolute, params.distance, params.wheel, params.ground):
        assert not np.any(kind.active)
        there = {k: v for k, v in vars(kind).items() if v is not None}
        numbers = [v for k, v in there.items() if not k.startswith("body")]
        assert all(np.all(np.asarray(v) == 0) for v in numbers)
    likelihood, off = b.target.log_likelihood, jnp.zeros(4, bool)
    near = likelihood(jnp.asarray(z), off)
    moved = jnp.asarray(z).at[1:].add(0.3)
    assert float(likelihood(moved, off)) == float(near)


def test_coefficients_scale_with_mass_so_that_gravity_tells_no_mass():
    b = block()
    z = np.linspace(-0.5, 0.5, b.layout.dim)
    light = decode(b, z)
    z[0] += 1.0
    heavy = decode(b, z)
    ratio = float(heavy.density[0] / light.density[0])
    assert ratio == pytest.approx(np.exp(1.5))
    for a, c in (
        (heavy.wheel.viscous, light.wheel.viscous),
        (heavy.wheel.dry, light.wheel.dry),
        (heavy.revolute.viscous, light.revolute.viscous),
        (heavy.revolute.dry, light.revolute.dry),
        (heavy.ground.viscous, light.ground.viscous),
    ):
        np.testing.assert_allclose(a / c, ratio, rtol=1e-6)
    np.testing.assert_allclose(heavy.ground.dry, light.ground.dry)


def test_known_numbers_replace_coordinates_and_null_ones_are_inferred():
    pin = {
        "type": "revolute",
        "a": "b",
        "b": "world",
        "anchor_a": [0.1, None],
        "anchor_b": [1.0, 2.0],
    }
    b = block(constraints=[pin], unknown={})
    z = np.full(b.layout.dim, 0.5)
    params = decode(b, z)
    assert bool(params.revolute.active[0])
    assert float(params.revolute.anchor_a[0, 0]) == pytest.approx(0.1)
    assert float(params.revolute.anchor_a[0, 1]) != 0.0
    np.testing.assert_allclose(params.revolute.anchor_b[0], [1.0, 2.0])


def test_random_coordinates_give_finite_positive_params():
    b = block()
    z = jax.random.normal(jax.random.key(0), (64, b.layout.dim))
    coordinates = b.target.log_likelihood.coordinates
    params = jax.vmap(lambda p: coordinates(p, jnp.ones(4, bool)))(z)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(params))
    assert np.all(params.density > 0)
    assert np.all(params.wheel.viscous[..., 0] < params.wheel.viscous[..., 1])


@pytest.mark.parametrize(
    ("time_step", "names", "whole"),
    [(0.02, "b", False), (0.4, "b", False), (0.02, "bc", True), (0.4, "bc", False)],
)
def test_steps_are_cut_as_the_engine_cuts_them(time_step, names, whole):
    shape = {"type": "box", "half_extents": [0.2, 0.1]}
    spec = scene_of(bodies=[{"name": name, "shape": shape} for name in names])
    num, num_bodies = spec.scene.num_substeps, len(names)
    assert num > 1
    # By the recording's steps; the scene's own is 0.02 s in all cases.
    state = np.zeros((3, num_bodies, 6))
    history = make_history(state, state[..., :3], state, time_step)
    b = make_block(spec, tuple(range(num_bodies)), history)
    scene = b.target.log_likelihood.coordinates.scene
    assert scene.num_substeps == (1 if whole else num)
