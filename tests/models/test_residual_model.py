"""Physics and its rest: no harm where the law is right, much good where it is not."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import LocallyWeighted, ResidualPhysics, TrueModel
from boomdp_jax.models.residual_model import FEWEST_ROWS
from boomdp_jax.physics import State, step

from .worlds import cart, part, ride

KEY = jax.random.key(0)
NUM_LEARNT, NUM_ROWS = 80, 160
DRAG, DRIFT, NOTHING = (12.0, 0.0), (0.0, 8.0), (0.0, 0.0)
"""Dry friction along the cart, and a push from behind that never ends [N]."""
WALL, FASTEST = 1e3, 1e4


@pytest.fixture(scope="module")
def model():
    """One who believes in the viscous wheel of the scene and in nothing else.

    Far away is a wall, and nothing goes faster than 10,000, in any direction.
    """
    spec = cart()
    return ResidualPhysics(
        TrueModel(spec.params(), lambda p, s, w: step(spec.scene, p, s, w)[0]),
        spec.scene,
        capacity=NUM_LEARNT,
        moved_freely=lambda before, after: after.pose[:, 0] < WALL,
        halted=lambda before, after: State(
            after.pose, jnp.clip(after.twist, -FASTEST, FASTEST)
        ),
    )


@eqx.filter_jit
def _driven(strength):
    spec, (_, wrench, _) = cart(), ride(NUM_ROWS)

    def one(state, told):
        c, s = jnp.cos(state.pose[0, 2]), jnp.sin(state.pose[0, 2])
        along = c * state.twist[0, 0] + s * state.twist[0, 1]
        force = strength[1] - strength[0] * jnp.tanh(along / 0.05)
        more = force * jnp.stack([c, s, 0.0 * c])
        after = step(spec.scene, spec.params(), state, told + more[None])[0]
        return after, (state, told, after)

    return jax.lax.scan(one, spec.initial_state(), wrench)[1]


@functools.cache
def driven(strength):
    """Rows of a ride in which a further force acts that they do not tell of."""
    return jax.tree.map(np.asarray, _driven(jnp.array(strength)))


def learnt_from(model, rows, num=NUM_LEARNT):
    learnt = model.init(KEY)
    for index in range(num):
        learnt = model.update(learnt, *row_of(rows, index))
    return learnt


def row_of(rows, index):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), rows)


@eqx.filter_jit
def foretold(model, hypothesis, before, wrench):
    """The next states of rows."""
    return jax.vmap(lambda s, w: model.transition(KEY, hypothesis, s, w))(
        before, wrench
    )


def both(model, hypothesis, before, wrench):
    """What the model says of rows, and what its physics alone says."""
    told = foretold(model, hypothesis, before, jnp.asarray(wrench))
    alone = foretold(model.physics, hypothesis.physics, before, jnp.asarray(wrench))
    return told, alone


def unseen(rows):
    """Those that are not learnt from."""
    return jax.tree.map(jnp.asarray, part(rows, NUM_LEARNT, NUM_ROWS))


def both_errors(model, rows):
    """On rows that were not learnt from, root mean square of six numbers; and λ."""
    hypothesis = model.sample(KEY, learnt_from(model, rows), 3)[0]
    before, wrench, after = unseen(rows)
    ours, alone = (
        np.sqrt(np.mean((np.asarray(told.array) - after.array) ** 2, axis=(0, 1)))
        for told in both(model, hypothesis, before, wrench)
    )
    return ours, alone, np.asarray(hypothesis.residual.share[0])


def noisy(rows, scale):
    """Rows as read with noise; the wrench is known."""
    rng = np.random.default_rng(5)

    def read(leaf):
        return leaf + scale * rng.normal(size=leaf.shape)

    before, wrench, after = rows
    return jax.tree.map(read, before), wrench, jax.tree.map(read, after)


@pytest.mark.slow
def test_before_enough_rows_physics_is_left_alone(model):
    rows = driven(DRAG)
    hypothesis = model.sample(KEY, learnt_from(model, rows, FEWEST_ROWS - 1), 1)[0]
    np.testing.assert_array_equal(hypothesis.residual.share, 0.0)
    told, alone = both(model, hypothesis, *unseen(rows)[:2])
    np.testing.assert_allclose(told.array, alone.array, atol=1e-12)


@pytest.mark.slow
def test_right_physics_is_not_spoilt_by_noise(model):
    """What is left of a right law is noise: errors grow by a twentieth at most."""
    for scale in (0.01, 0.1):
        ours, alone, share = both_errors(model, noisy(driven(NOTHING), scale))
        assert np.all(ours <= 1.05 * alone), (scale, ours / alone, share)


@pytest.mark.slow
@pytest.mark.parametrize(("strength", "most"), [(DRAG, 0.75), (DRIFT, 0.3)])
def test_what_a_wrong_law_misses_is_learnt(model, strength, most):
    """A constant drift almost wholly; a step at rest as far as 80 rows show it."""
    ours, alone, share = both_errors(model, driven(strength))
    assert alone[3] > 0.02
    # Of x and y, and their rates: that is where a force along the body tells.
    wrong = [0, 1, 3, 4]
    assert np.all(ours[wrong] < most * alone[wrong]), ours / alone
    assert np.all((share >= 0) & (share <= 1))


@pytest.mark.slow
def test_far_from_rows_physics_is_left_alone(model):
    rows = driven(DRAG)
    hypothesis = model.sample(KEY, learnt_from(model, rows), 1)[0]
    assert np.any(np.asarray(hypothesis.residual.share) > 0.5)
    before, wrench, _ = unseen(rows)
    fast = State(before.pose, before.twist + 100.0)
    told, alone = both(model, hypothesis, fast, wrench)
    np.testing.assert_allclose(told.array, alone.array, rtol=1e-9)


@pytest.mark.slow
def test_the_rest_is_the_same_wherever_and_whichever_way(model):
    """A motion turned and moved is foretold turned and moved."""
    rows = driven(DRAG)
    hypothesis = model.sample(KEY, learnt_from(model, rows), 1)[0]
    before, wrench, _ = unseen(rows)
    angle, away = 2.1, np.array([[[3.0, -1.0, 2.1]]])
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    there = State(before.pose @ matrix.T + away, before.twist @ matrix.T)
    told, _ = both(model, hypothesis, before, wrench)
    again, _ = both(model, hypothesis, there, wrench @ matrix.T)
    moved = np.asarray(told.pose) @ matrix.T + away
    np.testing.assert_allclose(again.pose, moved, atol=1e-9)
    turned = np.asarray(told.twist) @ matrix.T
    np.testing.assert_allclose(again.twist, turned, atol=1e-9)


@pytest.mark.slow
def test_what_touched_something_is_not_learnt_from_and_not_corrected(model):
    rows = driven(DRAG)
    learnt = learnt_from(model, rows, 40)
    before, wrench, after = row_of(rows, 40)
    away = State(after.pose + 2 * WALL, after.twist)
    assert int(model.update(learnt, before, wrench, away).rows.num_seen) == 40
    unread = State(after.pose.at[0, 1].set(jnp.nan), after.twist)
    assert int(model.update(learnt, before, wrench, unread).rows.num_seen) == 40
    assert int(model.update(learnt, before, wrench, after).rows.num_seen) == 41
    hypothesis = model.sample(KEY, learnt, 1)[0]
    assert np.any(np.asarray(hypothesis.residual.share) > 0.0)
    before, wrench, _ = unseen(rows)
    at_wall = State(before.pose + 2 * WALL, before.twist)
    told, alone = both(model, hypothesis, at_wall, wrench)
    np.testing.assert_allclose(told.array, alone.array, atol=1e-9)
    fast = State(before.pose, before.twist + 3 * FASTEST)
    told, alone = both(model, hypothesis, fast, wrench)
    assert float(jnp.max(told.twist)) == FASTEST
    assert float(jnp.max(alone.twist)) > FASTEST


def test_too_few_rows_are_refused(model):
    with pytest.raises(ValueError, match="capacity: expected at least 10, got 9"):
        ResidualPhysics(model.physics, cart().scene, LocallyWeighted(), capacity=9)
