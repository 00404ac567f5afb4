import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import CmaEs, GaussNewton, PointFit
from boomdp_jax.models.point_fit import AbstractSearch
from boomdp_jax.physics import State, rollout, scene_spec_from_dict

from .worlds import cart, error_share, expected, learn, only, part, ride


class Stay(AbstractSearch):
    """Finds nothing."""

    def improve(self, key, residual_fn, best, is_due):
        return best


SMALL = GaussNewton(num_starts=3, num_steps=8)


@pytest.mark.slow
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
            "constraints": [
                {
                    "type": "revolute",
                    "a": "door",
                    "b": "world",
                    "anchor_a": [0.45, 0.0],
                    "anchor_b": [1 + 0.45 * np.cos(0.3), 2 + 0.45 * np.sin(0.3)],
                }
            ],
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


@pytest.mark.slow
def test_nothing_is_missed_at_the_truth():
    model = PointFit(cart().scene, SMALL, capacity=12)
    truth = cart().params()
    numbers = model.numbers
    # Rates are per mass of 5.6 kg; the floor's are six spreads below the middle.
    mass = 10.0 * 1.0 * 0.56
    spread = np.array([1.5, 2.5, 2.5])
    value, middle = [10.0, 30.0 / mass, 600.0 / mass], [30.0, 0.3, 5.0]
    logs = np.log(np.array(value) / middle) / spread
    share = np.arcsin(-0.4 / np.hypot(0.5, 0.28))
    z = jnp.array([[*logs, 6.0, 6.0, -6.0, -6.0, share, 0.0, 0.0]])
    params = jax.jit(lambda z: numbers.params(z, jnp.zeros((1, 4))))(z)
    np.testing.assert_allclose(params.density, truth.density)
    np.testing.assert_allclose(params.wheel.viscous[0], truth.wheel.viscous[0])
    np.testing.assert_allclose(
        params.wheel.position[0], truth.wheel.position[0], atol=1e-12
    )
    held = part(ride(120), 0, 12)
    told = jax.jit(
        jax.vmap(lambda s, w: model.transition(jax.random.key(0), params, s, w))
    )(*held[:2])
    np.testing.assert_allclose(told.array, held[2].array, atol=1e-5)


def test_the_middle_of_what_is_likely_has_every_friction():
    model = PointFit(cart(walls=True).scene, SMALL, capacity=4)
    params = jax.jit(lambda key: model.params(model.init(key)))(jax.random.key(0))
    np.testing.assert_array_equal(params.wheel.active[:, 0], [True, False])
    np.testing.assert_array_equal(params.ground.active[:, 0], [True, False])
    np.testing.assert_allclose(params.density[0], 30.0)


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="capacity: expected at least 1, got 0"):
        PointFit(cart().scene, capacity=0)
    with pytest.raises(ValueError, match="num_starts: expected at least 1, got 0"):
        GaussNewton(num_starts=0)
    with pytest.raises(ValueError, match="num_steps: expected at least 1, got 0"):
        GaussNewton(num_steps=0)


def test_steps_that_touched_something_do_not_count():
    rows = part(ride(120), 0, 12)
    wall = float(np.median(rows[2].pose[:, 0, 0]))
    model = PointFit(
        cart().scene,
        Stay(),
        capacity=12,
        moved_freely=lambda state, after: after.pose[:, 0] > wall,
    )
    assert int(learn(model, rows).num_seen) == 6


def test_a_world_with_walls_is_planned_in():
    def stopped(params, state, wrench):
        return State(state.pose, 0.0 * state.twist)

    model = PointFit(cart().scene, Stay(), advance=stopped)
    rows = part(ride(120), 0, 3)
    told = expected(model, model.init(jax.random.key(0)), rows)
    np.testing.assert_array_equal(told.pose, rows[0].pose)
