"""Returns of sequences: against a plain loop, with ends, NaNs and noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning.belief import Belief, certain
from boomdp_jax.planning.problem import check_number, make_problem
from boomdp_jax.planning.rollouts import draw_rollouts, read_inputs
from tests.planning import small_worlds as worlds


def table_rollouts(hypotheses, log_weight, depth, num_hypotheses=8, **options):
    problem = make_problem(
        worlds.move_in_table,
        worlds.table_reward,
        worlds.NUM_ACTIONS,
        leaf_fn=worlds.table_leaf,
        **options,
    )
    belief = Belief(jnp.asarray(hypotheses), jnp.asarray(log_weight, float))
    key, state = jax.random.key(0), jnp.asarray(0)
    return draw_rollouts(key, problem, belief, state, depth, num_hypotheses)


@pytest.mark.parametrize("repeat", [1, 2, 5])
def test_returns_are_those_of_a_plain_loop(repeat):
    hypotheses = np.array([[1.0, 0.0], [-2.0, 0.5]])
    rollouts = table_rollouts(
        hypotheses, [0.0, 0.0], 3, discount=0.9, action_repeat=repeat
    )
    expected = [
        worlds.table_returns(0, 3, 0.9, scale, shift, repeat)
        for scale, shift in hypotheses
    ]
    sequences = jnp.array(list(expected[0]))
    found = jax.vmap(rollouts.returns)(sequences)
    np.testing.assert_allclose(
        found, np.array([list(each.values()) for each in expected]).T, atol=1e-12
    )


def test_mean_weighs_and_leaves_out_what_has_no_weight():
    log_weight = jnp.array([np.log(3.0), 0.0, -np.inf])
    rollouts = table_rollouts(np.ones((3, 2)), log_weight, 1)
    returns = jnp.array([[1.0, 5.0, -jnp.inf], [-jnp.inf, 0.0, 0.0]])
    np.testing.assert_array_equal(rollouts.mean(returns), [2.0, -np.inf])


def test_return_that_is_not_a_number_is_the_worst():
    rollouts = table_rollouts(np.array([[np.nan, 0.0], [1.0, 0.0]]), [0.0, 0.0], 2)
    returns = rollouts.returns(jnp.array([0, 0]))
    assert returns[0] == -np.inf
    assert returns[1] == pytest.approx(worlds.table_returns(0, 2, 1.0)[0, 0])


def test_sequences_share_the_noise_of_a_hypothesis():
    problem = make_problem(worlds.drift, worlds.reach_right, jnp.zeros((1, 1)))
    belief = Belief(jnp.ones(6), jnp.zeros(6))
    rollouts = draw_rollouts(jax.random.key(0), problem, belief, jnp.asarray(0.0), 4, 6)
    actions = jnp.array([[0.3], [-0.2], [0.5], [0.1]])
    moved = rollouts.returns(actions)
    still = rollouts.returns(jnp.zeros((4, 1)))
    # The first action counts in four positions, the last in one.
    expected = 0.3 * 4 - 0.2 * 3 + 0.5 * 2 + 0.1
    np.testing.assert_allclose(moved - still, np.full(6, expected), atol=1e-12)
    # The noise of hypotheses differs: returns have variance 0.01 · (16 + 9 + 4 + 1).
    # Of six such, a standard deviation outside these comes once in ten thousand times.
    assert 0.04 < np.std(still, ddof=1) < 1.3


def test_hypotheses_are_thinned_to_as_many_as_wanted():
    hypotheses = np.arange(40.0).reshape(20, 2)
    rollouts = table_rollouts(hypotheses, np.zeros(20), 3, num_hypotheses=5)
    assert rollouts.keys.shape == (5, 3)
    # Systematic draws of equal weights take one of every four in turn.
    np.testing.assert_array_equal(rollouts.hypotheses[:, 0] // 8, np.arange(5))
    assert rollouts.num_calls(7) == 7 * 5 * 3


@pytest.mark.parametrize("count", ["depth", "num_hypotheses"])
@pytest.mark.parametrize("value", [0, -1, True, 2.0])
def test_counts_have_to_be_positive_integers(count, value):
    counts = {"depth": 1, "num_hypotheses": 1} | {count: value}
    # The shape checks of the tests refuse a float before the function does.
    expected = Exception if isinstance(value, float) else ValueError
    with pytest.raises(expected, match=count):
        read_inputs(certain(0.0), 0.0, **counts)


def test_what_is_no_belief_is_refused():
    with pytest.raises(TypeError, match="belief: expected a Belief"):
        read_inputs([1.0], 0.0, depth=1, num_hypotheses=1)


def test_number_is_checked_where_it_is_known():
    with pytest.raises(ValueError, match=r"rate: expected a number above 0; got -1.0"):
        check_number("rate", -1.0, "above 0", lambda x: x > 0)
    check_number("rate", 1.0, "above 0", lambda x: x > 0)
    jax.jit(lambda rate: check_number("rate", rate, "above 0", lambda x: x > 0))(-1.0)


@pytest.mark.parametrize("number", [np.float32(-1.0), np.nan, np.float32("nan")])
@pytest.mark.parametrize("kind", [np.asarray, jnp.asarray, lambda number: number])
def test_number_of_any_type_is_checked(kind, number):
    with pytest.raises(ValueError, match=r"rate: expected a number above 0; got"):
        check_number("rate", kind(number), "above 0", lambda x: x > 0)


@pytest.mark.parametrize("kind", [np.int64, np.uint8, jnp.asarray])
def test_counts_are_whole_numbers_of_any_type(kind):
    """Read as an int, without which they would be traced and not static."""
    counts = read_inputs(certain(0.0), 0.0, depth=kind(2), num_hypotheses=kind(3))[2:]
    assert counts == (2, 3)
    assert [type(count) for count in counts] == [int, int]


def test_problem_reads_numbers_of_any_type():
    parts = worlds.move_in_table, worlds.table_reward
    problem = make_problem(*parts, np.int64(3), action_repeat=np.int64(2))
    np.testing.assert_array_equal(problem.actions, [0, 1, 2])
    assert type(problem.action_repeat) is int
    for bad in (np.float32(2.0), np.float32("nan"), jnp.asarray(0.0)):
        with pytest.raises(ValueError, match=r"discount: expected .* in \(0, 1\]"):
            make_problem(*parts, 3, discount=bad)
