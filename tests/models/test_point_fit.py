import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import CmaEs, GaussNewton, PointFit
from boomdp_jax.physics import State, rollout, scene_spec_from_dict

from .worlds import cart, error_share, expected, learn, only, part, ride

SMALL = GaussNewton(num_starts=3, num_steps=8)


def test_a_cart_is_found_by_derivatives_from_a_few_rows():
    model = PointFit(cart().scene, SMALL, capacity=24)
    rows = ride(120)
    shown, held = part(rows, 0, 24), part(rows, 96, 120)
    learnt = learn(model, shown)
    assert np.all(error_share(model, learnt, held) < 0.02)
    params = model.params(learnt)
    np.testing.assert_allclose(params.density, [10.0], rtol=0.05)
    np.testing.assert_allclose(params.wheel.position[0, 0], [-0.4, 0.0], atol=0.02)
    # Nothing is nulled but by value.
    assert np.all(params.wheel.active)
    assert np.all(params.ground.active)
    before = learn(model, only(shown, 0))
    assert int(before.num_seen) == 0
    for num_rows in (0, 1):
        told = expected(model, learn(model, only(shown, num_rows)), held)
        assert np.all(np.isfinite(told.array))


@pytest.mark.slow
def test_a_cart_is_found_without_derivatives():
    model = PointFit(cart().scene, CmaEs(), capacity=40)
    rows = ride(120)
    learnt = learn(model, part(rows, 0, 40))
    assert np.all(error_share(model, learnt, part(rows, 80, 120)) < 0.05)


@pytest.mark.slow
def test_a_pin_is_found_if_it_may_be_there():
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.1,
            "gravity": [0.0, 0.0],
            "bodies": [
                {
                    "name": "door",
                    "pose": [1.0, 2.0, 0.3],
                    "shape": {"type": "box", "half_extents": [0.5, 0.1]},
                    "density": 20.0,
                }
            ],
            "constraints": [{"type": "revolute", "a": "door", "anchor_a": [0.45, 0.0]}],
        }
    )
    wrench = jnp.asarray(np.random.default_rng(0).normal(size=(40, 1, 3)))
    start = spec.initial_state()
    after, _ = jax.jit(rollout)(spec.scene, spec.params(), start, 5.0 * wrench)
    before = jax.tree.map(
        lambda first, rest: jnp.concatenate([first[None], rest[:-1]]), start, after
    )
    rows = (before, 5.0 * wrench, after)
    model = PointFit(spec.scene, GaussNewton(), capacity=40, has_pin=True)
    params = model.params(learn(model, rows))
    assert bool(params.revolute.active[0])
    np.testing.assert_allclose(params.revolute.anchor_a[0], [0.45, 0.0], atol=0.02)


def test_the_middle_of_what_is_likely_has_every_friction():
    model = PointFit(cart(walls=True).scene, SMALL, capacity=4)
    params = model.params(model.init(jax.random.key(0)))
    np.testing.assert_array_equal(params.wheel.active[:, 0], [True, False])
    np.testing.assert_array_equal(params.ground.active[:, 0], [True, False])
    np.testing.assert_allclose(params.density[0], 30.0)
    state = State(jnp.zeros((2, 3)), jnp.ones((2, 3)))
    told = model.transition(jax.random.key(0), params, state, jnp.zeros((2, 3)))
    assert np.all(np.isfinite(told.array))


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="capacity: expected at least 1, got 0"):
        PointFit(cart().scene, capacity=0)
    with pytest.raises(ValueError, match="num_starts: expected at least 1, got 0"):
        GaussNewton(num_starts=0)
    with pytest.raises(ValueError, match="num_steps: expected at least 1, got 0"):
        GaussNewton(num_steps=0)
