"""Forward search: the whole tree's decision from a part of it, on random tables."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import Belief, certain, forward_search_sparse_sampling
from boomdp_jax.planning.problem import make_problem
from tests.reference.recursive_sparse_sampling import recursive_values

NUM_STATES, NUM_ACTIONS, DEPTH, NUM_SAMPLES = 7, 3, 3, 2
NUM_NODES = sum((NUM_ACTIONS * NUM_SAMPLES) ** level for level in range(DEPTH))
KEY = jax.random.key(5)


def table(seed):
    """A world of few states in which some end the episode; rewards in [-1, 1]."""
    generator = np.random.default_rng(seed)
    shape = (NUM_STATES, NUM_ACTIONS)
    probability = generator.dirichlet(np.full(NUM_STATES, 0.4), size=shape)
    reward = generator.uniform(-1.0, 1.0, (*shape, NUM_STATES))
    return {
        "log_probability": jnp.log(jnp.asarray(probability) + 1e-12),
        "reward": jnp.asarray(reward),
        "is_terminal": jnp.asarray(generator.random(NUM_STATES) < 0.25),
    }


def transition(key, world, state, action):
    following = jax.random.categorical(key, world["log_probability"][state, action])
    return following, world["is_terminal"][following]


def reward(world, state, action, following):
    return world["reward"][state, action, following]


def leaf(world, state):
    return jnp.cos(1.0 * state)


def belief_of(seeds, log_weight):
    worlds = jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(table, seeds))
    return Belief(worlds, jnp.asarray(log_weight, float))


SETTING = {
    "transition_fn": transition,
    "reward_fn": reward,
    "actions": NUM_ACTIONS,
    "discount": 0.9,
}
plan = partial(
    forward_search_sparse_sampling,
    **SETTING,
    depth=DEPTH,
    num_samples=NUM_SAMPLES,
    value_bounds=(-1.0, 1.0),
)


def whole_tree(world, state, key=KEY, is_shared=True, **options):
    setting = {name: SETTING[name] for name in SETTING} | options
    functions = [
        setting.pop(name) for name in ("transition_fn", "reward_fn", "actions")
    ]
    problem = make_problem(*functions, **setting)
    return recursive_values(key, problem, world, state, DEPTH, NUM_SAMPLES, is_shared)


@pytest.mark.parametrize("is_shared", [True, False])
def test_decision_and_value_are_the_whole_trees(is_shared):
    num_expansions = []
    for seed in range(6 if is_shared else 3):
        world = table(seed)
        found = plan(KEY, certain(world), seed, common_random_numbers=is_shared)
        expected = whole_tree(world, seed, is_shared=is_shared)
        assert found.tree.is_solved
        assert found.tree.is_exact
        np.testing.assert_allclose(found.value, expected.max(), rtol=1e-12)
        np.testing.assert_allclose(found.value, expected[found.index], rtol=1e-12)
        assert np.all(found.tree.num_contradictions == 0)
        num_expansions.append(int(found.tree.num_expansions[0]))
    assert max(num_expansions) < NUM_NODES
    assert np.mean(num_expansions) < 0.7 * NUM_NODES


def test_leaf_values_and_held_actions_enter_as_in_the_whole_tree():
    options = {"leaf_fn": leaf, "action_repeat": 2}
    for seed in range(3):
        world = table(seed)
        found = plan(KEY, certain(world), seed, leaf_bounds=(-1.0, 1.0), **options)
        expected = whole_tree(world, seed, **options)
        np.testing.assert_allclose(found.value, expected.max(), rtol=1e-12)
        np.testing.assert_allclose(found.value, expected[found.index], rtol=1e-12)


def test_bounds_hold_whenever_the_budget_is_spent():
    world = table(3)
    expected = whole_tree(world, 2)
    widths = []
    for max_expansions in (3, 16):
        found = plan(KEY, certain(world), 2, max_expansions=max_expansions)
        assert np.all(found.tree.lower <= expected + 1e-12)
        assert np.all(found.tree.upper >= expected - 1e-12)
        assert found.tree.num_expansions[0] <= max_expansions
        middle = 0.5 * (found.tree.lower + found.tree.upper)
        np.testing.assert_allclose(found.q_values, middle)
        widths.append(float((found.tree.upper - found.tree.lower).sum()))
        if max_expansions == 3:
            assert not found.tree.is_solved
            assert not found.tree.is_exact
            assert found.tree.num_expansions[0] == max_expansions
    assert np.all(np.diff(widths) <= 1e-12)
    assert widths[-1] < widths[0]


def test_a_decision_takes_less_than_its_value():
    counts = []
    for seed in range(6):
        world = table(seed)
        exact = plan(KEY, certain(world), seed)
        decided = plan(KEY, certain(world), seed, exact_value=False)
        assert decided.tree.is_solved
        assert decided.index == exact.index
        assert decided.tree.lower[decided.index] <= exact.value + 1e-12
        assert decided.tree.upper[decided.index] >= exact.value - 1e-12
        counts.append((decided.tree.num_expansions[0], exact.tree.num_expansions[0]))
    counts = np.array(counts)
    assert np.all(counts[:, 0] <= counts[:, 1])
    assert counts[:, 0].sum() < counts[:, 1].sum()


def test_hypotheses_are_averaged_by_weight():
    weight = np.array([0.6, 0.4])
    for state in range(4):
        found = plan(KEY, belief_of((0, 1), np.log(weight) + 3.0), state)
        values = np.stack([whole_tree(table(seed), state) for seed in range(2)])
        average = weight @ values
        assert found.tree.is_exact
        np.testing.assert_allclose(found.value, average.max(), rtol=1e-12)
        chosen = values[:, found.index]
        np.testing.assert_allclose(
            found.hypothesis_q_values[:, found.index], chosen, rtol=1e-12
        )
        assert np.all(found.tree.num_expansions < NUM_NODES)


def test_a_hypothesis_that_is_ruled_out_has_no_say():
    broken = jax.tree.map(lambda leaf: leaf, table(1))
    broken["reward"] = jnp.full_like(broken["reward"], jnp.nan)
    worlds = jax.tree.map(lambda *leaves: jnp.stack(leaves), table(0), broken)
    found = plan(KEY, Belief(worlds, jnp.array([0.0, -jnp.inf])), 1)
    alone = plan(KEY, certain(table(0)), 1)
    assert found.tree.is_exact
    np.testing.assert_allclose(found.value, alone.value, rtol=1e-12)


def test_a_large_belief_is_thinned():
    belief = belief_of(range(6), np.zeros(6))
    found = jax.eval_shape(lambda: plan(KEY, belief, 0, num_hypotheses=4))
    assert found.hypothesis_q_values.shape == (4, NUM_ACTIONS)


def test_wrong_bounds_are_noticed():
    world = table(0)
    assert np.all(plan(KEY, certain(world), 0).tree.num_contradictions == 0)
    for bounds in ((-1.0, -0.2), (0.2, 1.0)):
        found = plan(KEY, certain(world), 0, value_bounds=bounds)
        assert found.tree.num_contradictions[0] > 0


def test_bounds_by_functions_save_expansions():
    class Close:
        def lower(self, world, state, num_left):
            return world["value"][state, num_left] - 0.3

        def upper(self, world, state, num_left):
            return world["value"][state, num_left] + 0.3

    world = line_world()
    setting = {
        "transition_fn": move_on_line,
        "reward_fn": reward_on_line,
        "actions": 3,
        "depth": 5,
    }
    close = Close()
    told = forward_search_sparse_sampling(
        KEY, certain(world), 2, **setting, lower_fn=close.lower, upper_fn=close.upper
    )
    loose = forward_search_sparse_sampling(
        KEY, certain(world), 2, **setting, value_bounds=(-2.0, 1.0)
    )
    assert told.value == loose.value == world["value"][2, 5]
    assert told.tree.num_expansions[0] < loose.tree.num_expansions[0]
    assert loose.tree.num_contradictions[0] == 0


def line_world():
    """A line without noise; its best returns by dynamic programming."""
    gain = np.array([0.5, -1.0, 0.0, -2.0, 0.25, 1.0])
    place = np.arange(6)
    moves = np.clip(place[:, None] + np.array([-1, 0, 1]), 0, 5)
    value = [np.zeros(6)]
    for _ in range(5):
        value.append(np.max(gain[moves] + value[-1][moves], axis=1))
    return {"gain": jnp.asarray(gain), "value": jnp.stack(value, axis=1)}


def move_on_line(key, world, state, action):
    return jnp.clip(state + action - 1, 0, 5), False


def reward_on_line(world, state, action, following):
    return world["gain"][following]


def test_sequence_without_noise_earns_the_value():
    world = line_world()
    for state in range(6):
        found = forward_search_sparse_sampling(
            KEY,
            certain(world),
            state,
            transition_fn=move_on_line,
            reward_fn=reward_on_line,
            actions=3,
            depth=5,
            value_bounds=(-2.0, 1.0),
        )
        place, earned = state, 0.0
        for action in found.sequence:
            place = int(np.clip(place + action - 1, 0, 5))
            earned += float(world["gain"][place])
        assert found.sequence[0] == found.index == found.action
        assert earned == found.value == world["value"][state, 5]


def test_counts_are_those_of_a_tree_that_is_visited_whole():
    found = forward_search_sparse_sampling(
        KEY,
        certain(jnp.zeros(())),
        0.0,
        transition_fn=lambda key, _, state, action: (
            state + jax.random.normal(key),
            False,
        ),
        reward_fn=lambda _, state, action, following: jnp.tanh(following),
        actions=1,
        depth=4,
        num_samples=3,
        action_repeat=5,
        value_bounds=(-1.0, 1.0),
    )
    assert found.tree.is_exact
    np.testing.assert_array_equal(found.info.num_nodes, [[1, 3, 9, 27]])
    assert found.tree.num_expansions[0] == 40
    assert found.info.num_model_calls == 40 * 3 * 5


def test_batch_and_jit_give_what_single_calls_give():
    one = partial(plan, KEY, belief_of((0, 1), np.zeros(2)))
    states = jnp.arange(NUM_STATES)
    single = jax.tree.map(lambda *x: jnp.stack(x), *map(one, states))
    assert len(np.unique(single.tree.num_expansions)) > 2
    several = jax.jit(jax.vmap(one))(states)
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12), several, single
    )


def test_single_precision_gives_the_same_decision(precision):
    world = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), table(2))
    found = plan(KEY, certain(world), jnp.asarray(4))
    expected = whole_tree(world, 4)
    assert found.value.dtype == jnp.asarray(1.0).dtype
    assert found.tree.is_exact
    tolerance = precision.choose(single=1e-5, double=1e-12)
    np.testing.assert_allclose(found.value, expected.max(), rtol=tolerance)


def test_arrays_and_numbers_of_the_world_do_not_compile_anew():
    traces = []

    def counted(key, world, state, action):
        traces.append(0)
        return transition(key, world, state, action)

    for seed in range(3):
        options = {"transition_fn": counted, "discount": 0.8 + 0.05 * seed}
        plan(jax.random.key(seed), certain(table(seed)), seed, **options)
        if not seed:
            first = len(traces)
    assert len(traces) == first


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"depth": 0}, ValueError, "depth: expected a positive"),
        ({"num_samples": 0}, ValueError, "num_samples: expected a positive"),
        ({"max_expansions": -1}, ValueError, "max_expansions: expected a positive"),
        ({"num_hypotheses": 0}, ValueError, "num_hypotheses: expected a positive"),
        ({"value_bounds": None}, ValueError, "value_bounds: needed unless"),
        ({"value_bounds": (1.0, 0.0)}, ValueError, "value_bounds: .* in order"),
        ({"leaf_bounds": (1.0, 0.0)}, ValueError, "leaf_bounds: .* in order"),
        ({"leaf_fn": leaf}, ValueError, "leaf_bounds: leaf_fn is given"),
        ({"discount": 1.5}, ValueError, "discount: expected a number"),
        ({"actions": jnp.zeros((0, 2))}, ValueError, "actions: every leaf"),
    ],
)
def test_bad_input_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        plan(KEY, certain(table(0)), 0, **options)
