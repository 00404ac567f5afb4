"""Online physics as a model: found by pushes, blind to steps that touched a wall."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import Cart
from boomdp_jax.envs.cart import DENSITY
from boomdp_jax.inference import OnlineBelief
from boomdp_jax.models import PhysicsModel, TrueModel
from boomdp_jax.physics import State


@pytest.fixture(scope="module")
def task():
    return Cart()


def test_who_knows_is_the_world(task):
    params = task.default_params()
    model = TrueModel(params.physics, task.advance)
    learnt = model.init(jax.random.key(0))
    belief = model.sample(jax.random.key(1), learnt, 7)
    assert belief.num_hypotheses == 1
    state = task.start(jax.random.key(2), params)
    one = model.transition(jax.random.key(3), belief[0], state, task.actions[1])
    other = task.advance(params.physics, state, task.actions[1])
    np.testing.assert_array_equal(one.array, other.array)


@pytest.mark.slow
def test_a_few_pushes_tell_what_a_cart_is(task):
    params = task.default_params()
    online = OnlineBelief(task.spec, capacity=32, num_particles=256)
    model = PhysicsModel(online, task.advance, task.moved_freely)
    learnt = model.init(jax.random.key(0))
    middle = jnp.array([[1.6, 1.2, 0.4]])
    before = State(middle, jnp.zeros((1, 3)))
    pushed, num_free = 0, 0
    for action in (2, 0, 5, 3, 7):
        after = task.advance(params.physics, before, task.actions[action])
        is_free = bool(task.moved_freely(before, after)[0])
        learnt = model.update(learnt, before, task.actions[action], after)
        pushed, num_free = pushed + 1, num_free + is_free
        assert learnt.num_rows == num_free
        assert learnt.is_broken == (not is_free)
        # What was tried since the last row that told something.
        assert bool(learnt.stopped) == (not is_free)
        before = after
    assert num_free >= 3
    # One that ends at a wall is not learnt from.
    at_wall = State(jnp.array([[0.8, 1.2, 0.0]]), jnp.zeros((1, 3)))
    assert not bool(task.moved_freely(before, at_wall)[0])
    skipped = model.update(learnt, before, task.actions[0], at_wall)
    assert skipped.is_broken
    np.testing.assert_array_equal(skipped.stopped[-1], task.actions[0])
    assert skipped.num_rows == learnt.num_rows
    belief = model.sample(jax.random.key(1), learnt, 64)
    wheel = belief.hypotheses.wheel
    assert np.mean(np.asarray(wheel.active[:, 0, 0])) > 0.9
    # Rolling along the cart, heading folded: the axle is where it is.
    place = np.asarray(wheel.position[:, 0, 0, 0])[np.asarray(wheel.active[:, 0, 0])]
    truth = float(params.physics.wheel.position[0, 0, 0])
    assert abs(np.median(place) - truth) < 0.02
    density = np.asarray(belief.hypotheses.density[:, 0])
    assert abs(np.median(density) / DENSITY - 1) < 0.05
    assert np.std(density) > 0


@pytest.mark.slow
def test_fewer_than_one_sample_is_refused(task):
    online = OnlineBelief(task.spec, capacity=16, num_particles=16)
    belief = online.init(jax.random.key(0))
    with pytest.raises(ValueError, match="num_samples: expected at least 1, got 0"):
        online.sample_params(jax.random.key(0), belief, 0)


@pytest.mark.slow
def test_the_most_probable_hypothesis_is_of_the_likeliest_structure(task):
    online = OnlineBelief(task.spec, capacity=16, num_particles=256)
    model = PhysicsModel(online, task.advance, is_point=True)
    learnt = model.init(jax.random.key(0))
    belief = model.sample(jax.random.key(1), learnt, 4)
    assert belief.num_hypotheses == 1
    best = belief[0]
    draws = online.sample_params(jax.random.key(2), learnt.belief, 1000)
    kinds = np.stack([draws.revolute.active[:, 0], draws.wheel.active[:, 0, 0]], axis=1)
    found, counts = np.unique(kinds, axis=0, return_counts=True)
    likeliest = found[np.argmax(counts)]
    of_best = [bool(best.revolute.active[0]), bool(best.wheel.active[0, 0])]
    np.testing.assert_array_equal(of_best, likeliest)
    share = online.structure_share(learnt.belief)
    # Drawn systematically, each structure as often as it weighs.
    assert share == pytest.approx(counts.max() / 1000, abs=2e-3)
