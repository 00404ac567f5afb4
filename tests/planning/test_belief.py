"""Beliefs of which one hypothesis is taken: the most probable one, and means."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import Belief, sparse_sampling
from boomdp_jax.planning.belief import mean_hypothesis, most_probable, resample

KEY = jax.random.key(0)


class _Draws(NamedTuple):
    """What a sampler leaves: draws that weigh the same, and which is the likeliest."""

    params: dict[str, jax.Array]
    log_weight: jax.Array

    def ranking(self):
        return jnp.array([-jnp.inf, 2.0, 1.0, -jnp.inf])


DRAWS = _Draws(
    {"slope": jnp.array([9.0, -1.0, 3.0, 9.0]), "kind": jnp.array([0, 1, 1, 0])},
    jnp.zeros(4),
)


@pytest.mark.parametrize(("hypotheses", "slope"), [("map", -1.0), ("mean", 1.0)])
def test_map_and_mean_of_equal_draws_are_of_the_likeliest_kind(hypotheses, slope):
    def transition(key, hypothesis, state, action):
        del key
        return state + hypothesis["slope"] * action, jnp.array(False)

    plan = sparse_sampling(
        KEY,
        DRAWS,
        jnp.asarray(0.0),
        depth=1,
        hypotheses=hypotheses,
        transition_fn=transition,
        reward_fn=lambda hypothesis, state, action, after: after,
        actions=jnp.array([-1.0, 0.0, 1.0]),
    )
    np.testing.assert_allclose(plan.q_values, [-slope, 0.0, slope])


def test_what_has_no_weight_is_not_the_likeliest():
    density = jnp.array([3.0, 1.0, 2.0])
    belief = Belief(jnp.arange(3.0), jnp.array([-jnp.inf, 0.0, 0.0]), density)
    assert int(belief.likeliest) == 2
    np.testing.assert_array_equal(most_probable(belief).hypotheses, [2.0])
    few = resample(KEY, belief, 2)
    np.testing.assert_array_equal(few.log_density, density[few.hypotheses.astype(int)])


def test_means_leave_out_limits_of_what_does_not_count():
    limits = jnp.array([jnp.inf, 1.0, 3.0])
    kinds = jnp.array([False, True, True])
    weights = jnp.log(jnp.array([0.2, 0.6, 0.2]))
    found = mean_hypothesis(Belief({"kind": kinds, "limit": limits}, weights))
    np.testing.assert_array_equal(found.hypotheses["kind"], [True])
    np.testing.assert_allclose(found.hypotheses["limit"], [1.5])
