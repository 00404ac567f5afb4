import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import (
    BodyRegression,
    LocallyWeighted,
    ObjectAmongOthers,
    ObjectOriented,
)
from boomdp_jax.models.features import BodyFeatures
from boomdp_jax.physics import State

from .worlds import cart, expected, learn


def walled_rows(num: int):
    """A box that glides as pushed, but not towards a wall on its left that is near."""
    rng = np.random.default_rng(5)
    pose = np.zeros((num, 2, 3))
    pose[:, 0, 0] = rng.uniform(-1, 1, num)
    pose[:, 0, 1] = np.where(np.arange(num) % 2, rng.uniform(1.45, 1.6, num), -1.0)
    pose[:, 1, 1] = 2.0
    twist = np.zeros((num, 2, 3))
    twist[:, 0, :2] = rng.normal(size=(num, 2))
    wrench = np.zeros((num, 2, 3))
    wrench[:, 0, :2] = rng.normal(size=(num, 2))
    after = twist + 0.1 * wrench
    is_near = pose[:, 0, 1] > 1.0
    after[is_near, 0, 1] = -0.2 * twist[is_near, 0, 1]
    moved = pose + 0.1 * after
    as_state = [
        State(jnp.asarray(p), jnp.asarray(t))
        for p, t in ((pose, twist), (moved, after))
    ]
    return as_state[0], jnp.asarray(wrench), as_state[1]


def model_of(scene, **settings):
    regressor = LocallyWeighted(capacity=200, bandwidths=(4.0,), ridges=(1e-5,))
    return ObjectOriented(scene, regressor, radius=0.2, **settings)


@pytest.mark.slow
def test_a_wall_is_learnt_by_the_side_that_touches_it():
    scene = cart(walls=True).scene
    rows = walled_rows(200)
    shown, held = (
        jax.tree.map(lambda leaf, s=s: leaf[s], rows)
        for s in (slice(0, 100), slice(100, 200))
    )
    model = model_of(scene)
    is_near = np.asarray(held[0].pose[:, 0, 1] > 1.0)
    conditions = np.asarray(jax.vmap(model.conditions)(held[0])[:, 0])
    # The left side, and with it what a ray past a corner meets.
    np.testing.assert_array_equal(conditions & 2, 2 * is_near)
    np.testing.assert_array_equal(conditions > 0, is_near)
    plain = BodyRegression(scene, model.regressor)
    errors = {}
    for name, one in (("with", model), ("without", plain)):
        told = expected(one, learn(one, shown), held)
        errors[name] = np.abs(np.asarray(told.twist - held[2].twist)).max()
    assert errors["with"] < 1e-3
    assert errors["without"] > 0.1


@pytest.mark.slow
def test_a_condition_never_seen_is_answered_by_the_one_without_contact():
    scene = cart(walls=True).scene
    rows = walled_rows(200)
    free = jax.tree.map(lambda leaf: leaf[0::2], rows)
    near = jax.tree.map(lambda leaf: leaf[1::2], rows)
    model = model_of(scene)
    learnt = learn(model, free)
    told = expected(model, learnt, near)
    away = dataclasses.replace(near[0], pose=near[0].pose.at[:, 0, 1].add(-3.0))
    other = expected(model, learnt, (away, near[1], near[2]))
    np.testing.assert_allclose(told.twist, other.twist, atol=1e-12)


def test_missing_readings_teach_nothing_and_nothing_means_coasting():
    scene = cart(walls=True).scene
    before, wrench, after = jax.tree.map(lambda leaf: leaf[:100], walled_rows(200))
    lost = State(before.pose.at[:, 0, 2].set(jnp.nan), before.twist)
    model = model_of(scene)
    learnt = learn(model, (lost, wrench, after))
    assert int(learnt.table.num_seen[0]) == 0
    told = expected(model, learnt, (before, wrench, after))
    np.testing.assert_array_equal(told.twist, before.twist)
    np.testing.assert_allclose(told.pose, before.pose + 0.1 * before.twist, atol=1e-12)


def test_bad_settings_are_refused():
    scene = cart(walls=True).scene
    with pytest.raises(ValueError, match="radius: expected a positive length, got 0"):
        ObjectOriented(scene, radius=0.0)
    with pytest.raises(ValueError, match="num_sectors: expected 1 to 8, got 9"):
        ObjectOriented(scene, radius=0.1, num_sectors=9)
    with pytest.raises(ValueError, match="num_rays: expected at least 1, got 0"):
        ObjectOriented(scene, radius=0.1, num_rays=0)


def test_a_batch_of_predictions_is_a_loop_of_them():
    model = model_of(cart(walls=True).scene)
    rows = jax.tree.map(lambda leaf: leaf[:100], walled_rows(200))
    learnt = learn(model, rows)
    batch = expected(model, learnt, rows)
    key = jax.random.key(1)
    hypothesis = model.sample(key, learnt, 1)[0]
    one_by_one = eqx.filter_jit(model.transition)
    for t in range(5):
        state, wrench, _ = jax.tree.map(lambda leaf, t=t: leaf[t], rows)
        one = one_by_one(key, hypothesis, state, wrench)
        np.testing.assert_allclose(one.array, batch.array[t], atol=1e-9)


@pytest.mark.slow
def test_walls_that_states_do_not_have_are_felt_all_the_same():
    scene, rows = cart(walls=True).scene, walled_rows(60)
    wall = rows[0].pose[0, 1:]
    whole, part = model_of(scene), model_of(scene, surroundings=wall)
    own = jax.tree.map(lambda leaf: leaf[:, :1], rows)
    same = jax.vmap(whole.conditions)(rows[0])
    np.testing.assert_array_equal(jax.vmap(part.conditions)(own[0]), same)
    assert len(np.unique(same)) > 1
    told = expected(whole, learn(whole, rows), rows)
    also = expected(part, learn(part, own), own)
    np.testing.assert_allclose(also.pose, told.pose[:, :1], atol=1e-12)


@pytest.mark.slow
def test_one_body_among_others_learns_what_all_at_once_do():
    scene, rows = cart(walls=True).scene, walled_rows(60)
    whole = model_of(scene)
    one = ObjectAmongOthers(
        scene=scene,
        body=jnp.asarray(0),
        features=BodyFeatures(cart().scene),
        regressor=whole.regressor,
        radius=whole.radius,
    )
    told = expected(whole, learn(whole, rows), rows)
    also = expected(one, learn(one, rows), rows)
    np.testing.assert_allclose(also.array, told.array, atol=1e-12)
