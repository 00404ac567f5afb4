"""Single steps and open loops against rollouts of the engine and a closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.likelihoods.exact_starts import ExactStarts, with_open_loop
from boomdp_jax.physics import State, step
from boomdp_jax.physics.scene_spec import SceneSpec
from tests.inference.exact_predictions import (
    by_newton,
    errors_of,
    log_student,
    windows,
)
from tests.inference.recordings import (
    DT,
    MASS,
    box_scene,
    free_box,
)


@jax.jit
def engine_step(scene, params, now, wrench):
    return step(scene, params, State(now[None, :3], now[None, 3:]), wrench[None])[0]


@eqx.filter_jit
def value_of(target, z, active):
    """Log-likelihood, and the hypothesis that it is of."""
    likelihood = target.log_likelihood
    return likelihood(z, active), likelihood.coordinates(z, active)


def target_of(spec: SceneSpec, history: History, horizon: int | None):
    """The posterior's density, as samplers see it."""
    stacked = stack_blocks([make_block(spec, (0,), history)])
    starts = ExactStarts(horizon)
    return jax.tree.map(lambda leaf: leaf[0], with_open_loop(stacked, starts))


def pushed_box(is_chained: bool, has_gaps: bool) -> History:
    """Three runs of ten rows, with room for more, some of it not read."""
    rng = np.random.default_rng(3)
    history = free_box(rng, 30, is_chained=is_chained, num_episodes=3)
    state, last = np.array(history.state), np.array(history.next_state)
    if has_gaps:
        for row, channel in ((0, 4), (5, 0), (14, 2), (15, 5), (27, 3)):
            state[row, 0, channel] = np.nan
            if is_chained and row % 10:
                last[row - 1, 0, channel] = np.nan
        last[29, 0, 1] = np.nan
    action, episode = np.asarray(history.action), np.asarray(history.episode)
    return make_history(state, action, last, DT, episode=episode, capacity=37)


@pytest.mark.parametrize("has_gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize("is_chained", [True, False], ids=["one", "two"])
@pytest.mark.parametrize("horizon", [1, 2, 4, 30, None])
@pytest.mark.slow
def test_log_likelihoods_are_those_of_rollouts(horizon, is_chained, has_gaps):
    """Of the engine, at hypotheses with and without a wheel and floor friction.

    One or two readings of each instant; single steps are open loops of one step.
    """
    history = pushed_box(is_chained, has_gaps)
    target = target_of(box_scene({"wheel": 1, "ground": 1}), history, horizon)
    scene = target.log_likelihood.coordinates.world
    rng = np.random.default_rng(4)
    for active in target.structures:
        z = jnp.asarray(0.7 * rng.standard_normal(target.dim))
        found, params = value_of(target, z, active)

        def by_engine(now, wrench, params=params):
            after = engine_step(scene, params, jnp.asarray(now), jnp.asarray(wrench))
            return np.asarray(after.array)[0]

        expected = log_student(errors_of(history, by_engine, horizon))
        np.testing.assert_allclose(float(found), expected, rtol=1e-9)


def test_a_second_reading_that_nothing_starts_from_counts():
    """Twice as many errors as rows, but for the rows that predictions start in."""
    whole = windows(pushed_box(False, False), 4)
    assert [len(rows) for rows in whole] == [4, 4, 2] * 3
    errors = errors_of(pushed_box(False, False), by_newton(MASS), 4)
    assert len(errors) == 2 * 30 - 9
