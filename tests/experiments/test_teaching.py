"""Samples that agents are taught by obey the world; what was taught stays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.experiments import Samples, taught, unbiased_samples
from boomdp_jax.models import BodyRegression, LinearRegression
from boomdp_jax.physics import State
from tests.agents.line_world import LineWorld


@pytest.fixture(scope="module")
def line():
    task = LineWorld()
    params = task.default_params()
    samples = unbiased_samples(jax.random.key(7), task, params, num_samples=200)
    return task, params, samples


@pytest.mark.slow
def test_samples_are_steps_of_the_world(line):
    _, _, samples = line
    assert samples.state.shape == (200, 1, 6)
    place = samples.state[:, 0, 0] + samples.wrench[:, 0, 0]
    np.testing.assert_array_equal(samples.next_state[:, 0, 0], np.clip(place, 0, 4))
    # A walk that turns round at its ends is anywhere in the long run.
    assert set(samples.state[:, 0, 0]) == {0.0, 1.0, 2.0, 3.0, 4.0}


@pytest.mark.slow
def test_few_samples_are_the_first_of_many(line):
    """So that they are from the same states, however many are asked for."""
    task, params, samples = line
    few = unbiased_samples(jax.random.key(7), task, params, num_samples=30)
    for part, whole in zip(few, samples, strict=True):
        np.testing.assert_array_equal(part, whole[:30])


@pytest.mark.slow
def test_samples_are_read_with_noise():
    task = LineWorld()
    scale = jnp.array([0.0, 0.0, 0.1, 0.3])
    samples = unbiased_samples(
        jax.random.key(7), task, task.default_params(), reading_noise=scale
    )
    # Nothing has a speed in this world; four standard errors.
    for channel, expected in ((3, 0.1), (5, 0.3)):
        for part in (samples.state, samples.next_state):
            share = part[:, 0, channel].std() / expected
            assert abs(share - 1) < 4 / np.sqrt(2 * len(part))


@pytest.mark.slow
def test_what_was_taught_is_known_and_stays(line):
    """x' = x + u where the ends are far."""
    task, _, samples = line
    inner = np.abs(samples.state[:, 0, 0] - 2) < 1.5
    samples = Samples(*(part[inner] for part in samples)).first(150)
    assert np.isnan(samples.state[-1, 0, 0])
    model = BodyRegression(task.spec.scene, LinearRegression(), frame="world")
    known = taught(jax.random.key(0), model, samples)
    learnt = known.init(jax.random.key(1))
    state = State(jnp.array([[2.0, 0.0, 0.0]]), jnp.zeros((1, 3)))
    belief = known.sample(jax.random.key(2), learnt, 4)
    told = known.transition(jax.random.key(3), belief[0], state, task.actions[1])
    np.testing.assert_allclose(told.pose[0, 0], 3.0, atol=1e-3)
    after = known.update(learnt, state, task.actions[1], state)
    assert after is learnt


def test_rows_of_a_body_are_those_in_which_it_was_pushed():
    wrench = np.zeros((3, 2, 3))
    wrench[[0, 2], 1, 0] = [5.0, 6.0]
    state = np.arange(36.0).reshape(3, 2, 6)
    samples = Samples(state, wrench, state + 1, np.ones((3, 2), bool)).of_body(1)
    np.testing.assert_array_equal(samples.wrench[:, 0, 0], [5.0, 6.0])
    np.testing.assert_array_equal(samples.state[:, 0], state[[0, 2], 1])
    assert samples.is_free.shape == (2, 1)
