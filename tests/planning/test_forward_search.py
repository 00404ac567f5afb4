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
TRACES = []


def table(seed):
    """A world of few states in which some end the episode; rewards in [-1, 1]."""
    generator = np.random.default_rng(seed)
    shape = (NUM_STATES, NUM_ACTIONS)
    probability = generator.dirichlet(np.full(NUM_STATES, 0.4), size=shape)
    reward = generator.uniform(-1.0, 1.0, (*shape, NUM_STATES))
    return {
        "cumulative": np.cumsum(probability, axis=-1)[..., :-1],
        "reward": reward,
        "is_terminal": generator.random(NUM_STATES) < 0.25,
    }


def transition(key, world, state, action):
    TRACES.append(0)
    following = jnp.sum(jax.random.uniform(key) > world["cumulative"][state, action])
    return following, world["is_terminal"][following]


def reward(world, state, action, following):
    return world["reward"][state, action, following]


def leaf(world, state):
    return jnp.cos(1.0 * state)


def belief_of(seeds, log_weight):
    worlds = jax.tree.map(lambda *leaves: np.stack(leaves), *map(table, seeds))
    return Belief(worlds, jnp.asarray(log_weight, float))


SETTING = {
    "transition_fn": transition,
    "reward_fn": reward,
    "actions": NUM_ACTIONS,
    "discount": 0.9,
}
traced = partial(
    forward_search_sparse_sampling,
    **SETTING,
    depth=DEPTH,
    num_samples=NUM_SAMPLES,
    value_bounds=(-1.0, 1.0),
)


def plan(*arguments, **options):
    """A plan in arrays of NumPy."""
    return jax.device_get(traced(*arguments, **options))


def whole_tree(world, state, key=KEY, is_shared=True, **options):
    setting = {name: SETTING[name] for name in SETTING} | options
    functions = [
        setting.pop(name) for name in ("transition_fn", "reward_fn", "actions")
    ]
    problem = make_problem(*functions, **setting)
    return recursive_values(key, problem, world, state, DEPTH, NUM_SAMPLES, is_shared)


@pytest.mark.slow
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


@pytest.mark.slow
def test_bounds_hold_whenever_the_budget_is_spent():
    world = table(3)
    for state in range(4):
        expected = whole_tree(world, state)
        short = plan(KEY, certain(world), state, max_expansions=3)
        long = plan(KEY, certain(world), state)
        for found in (short, long):
            assert np.all(found.tree.lower <= expected + 1e-12)
            assert np.all(found.tree.upper >= expected - 1e-12)
            middle = 0.5 * (found.tree.lower + found.tree.upper)
            np.testing.assert_allclose(found.q_values, middle)
        assert not short.tree.is_solved
        assert not short.tree.is_exact
        assert short.tree.num_expansions[0] == 3
        assert np.all(short.tree.lower < short.tree.upper)


@pytest.mark.slow
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


HELD = {"leaf_fn": leaf, "action_repeat": 2}
plan_held = partial(plan, leaf_bounds=(-1.0, 1.0), **HELD)


@pytest.mark.slow
def test_hypotheses_are_averaged_by_weight_with_leaf_values_and_held_actions():
    weight = np.array([0.6, 0.4])
    for state in range(4):
        found = plan_held(KEY, belief_of((0, 1), np.log(weight) + 3.0), state)
        values = np.stack([whole_tree(table(seed), state, **HELD) for seed in range(2)])
        average = weight @ values
        assert found.tree.is_exact
        np.testing.assert_allclose(found.value, average.max(), rtol=1e-12)
        np.testing.assert_allclose(
            found.hypothesis_q_values[:, found.index],
            values[:, found.index],
            rtol=1e-12,
        )
        assert np.all(found.tree.num_expansions < NUM_NODES)
        assert np.all(found.tree.num_contradictions == 0)


@pytest.mark.slow
def test_a_hypothesis_that_is_ruled_out_has_no_say():
    broken = table(1)
    broken["reward"] = np.full_like(broken["reward"], np.nan)
    worlds = jax.tree.map(lambda *leaves: np.stack(leaves), table(0), broken)
    found = plan_held(KEY, (worlds, np.array([0.0, -np.inf])), 1)
    assert found.tree.is_exact
    expected = whole_tree(table(0), 1, **HELD)
    np.testing.assert_allclose(found.value, expected.max(), rtol=1e-12)


def steps(bad_reward=None, bad_leaf=None, belief=None, **options):
    """Walk by 0 or 1 at a cost of 5, but for what is made bad."""

    def reward_fn(hypothesis, state, action, after):
        cost = -5.0 * hypothesis
        return (
            cost if bad_reward is None else jnp.where(bad_reward(after), jnp.nan, cost)
        )

    def leaf_fn(hypothesis, state):
        return jnp.where(bad_leaf(state), jnp.nan, 0.0)

    return forward_search_sparse_sampling(
        KEY,
        certain(jnp.asarray(1.0)) if belief is None else belief,
        jnp.asarray(0.0),
        transition_fn=lambda key, hypothesis, state, action: (state + action, False),
        reward_fn=reward_fn,
        leaf_fn=None if bad_leaf is None else leaf_fn,
        leaf_bounds=None if bad_leaf is None else (0.0, 0.0),
        actions=jnp.array([0.0, 1.0]),
        value_bounds=(-10.0, 0.0),
        **options,
    )


@pytest.mark.parametrize("num_samples", [1, 2])
def test_an_action_of_a_nan_is_the_worst(num_samples):
    for bad in ({"bad_reward": lambda s: s == 0}, {"bad_leaf": lambda s: s < 1}):
        found = steps(**bad, depth=1, num_samples=num_samples)
        np.testing.assert_array_equal(found.q_values, [-np.inf, -5.0])
        assert found.index == 1
    found = steps(lambda state: state == 0, depth=2, num_samples=num_samples)
    np.testing.assert_array_equal(found.q_values, [-np.inf, -10.0])
    assert found.index == 1


def test_a_nan_below_is_walked_around():
    """After the step there is nothing else; after staying there is."""
    found = steps(lambda state: state >= 1, depth=3)
    np.testing.assert_array_equal(found.q_values, [-15.0, -np.inf])
    found = steps(lambda state: state == 2, depth=2)
    np.testing.assert_array_equal(found.q_values, [-10.0, -10.0])
    assert found.tree.is_exact
    everywhere = steps(lambda state: state < 9, depth=3)
    np.testing.assert_array_equal(everywhere.q_values, [-np.inf, -np.inf])
    late = steps(lambda state: state >= 0, bad_leaf=lambda state: state < 9, depth=2)
    assert late.value == -np.inf


def test_a_nan_under_one_hypothesis_counts():
    belief = (jnp.array([1.0, 0.5]), jnp.zeros(2))
    found = steps(lambda state: state == 0, belief=belief, depth=2)
    np.testing.assert_array_equal(found.q_values, [-np.inf, -7.5])
    assert found.index == 1


def test_a_large_belief_is_thinned():
    belief = belief_of(range(6), np.zeros(6))
    found = jax.eval_shape(lambda: traced(KEY, belief, 0, num_hypotheses=4))
    assert found.hypothesis_q_values.shape == (4, NUM_ACTIONS)


def test_wrong_bounds_are_noticed():
    world = table(0)
    assert np.all(plan(KEY, certain(world), 0).tree.num_contradictions == 0)
    for bounds in ((-1.0, -0.2), (0.2, 1.0)):
        found = plan(KEY, certain(world), 0, value_bounds=bounds)
        assert found.tree.num_contradictions[0] > 0


@pytest.mark.parametrize("shift", [-1.5, 1.5])
def test_bounds_of_one_sign_allow_for_the_end_of_an_episode(shift):
    bounds = (shift - 1.0, shift + 1.0)
    for seed in range(6):
        world = table(seed)
        world["reward"] = world["reward"] + shift
        found = plan(KEY, certain(world), seed, value_bounds=bounds)
        expected = whole_tree(world, seed)
        assert found.tree.num_contradictions[0] == 0
        np.testing.assert_allclose(found.value, expected.max(), rtol=1e-12)


@pytest.mark.slow
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
    return {"gain": gain, "value": np.stack(value, axis=1)}


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_batch_and_jit_give_what_single_calls_give():
    states = np.arange(NUM_STATES)
    single = [plan(KEY, certain(table(0)), state) for state in states]
    single = jax.tree.map(lambda *x: np.stack(x), *single)
    assert len(np.unique(single.tree.num_expansions)) > 2
    several = jax.jit(jax.vmap(partial(traced, KEY, certain(table(0)))))(states)
    jax.tree.map(
        partial(np.testing.assert_allclose, rtol=1e-12, atol=1e-12), several, single
    )


@pytest.mark.slow
def test_single_precision_gives_the_same_decision(precision):
    world = table(2)
    found = plan(KEY, certain(world), 4)
    expected = whole_tree(world, 4)
    assert found.value.dtype == jnp.asarray(1.0).dtype
    assert found.tree.is_exact
    tolerance = precision.choose(single=1e-5, double=1e-12)
    np.testing.assert_allclose(found.value, expected.max(), rtol=tolerance)


@pytest.mark.slow
def test_arrays_and_numbers_of_the_world_do_not_compile_anew():
    plan(KEY, certain(table(0)), 0)
    TRACES.clear()
    for seed in range(3):
        discount = 0.8 + 0.05 * seed
        plan(jax.random.key(seed), certain(table(seed)), seed, discount=discount)
    assert not TRACES
    plan(KEY, certain(table(0)), 0, num_samples=1)
    assert TRACES


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"depth": 0}, ValueError, "depth: expected a positive"),
        ({"num_samples": 0}, ValueError, "num_samples: expected a positive"),
        ({"max_expansions": -1}, ValueError, "max_expansions: expected a positive"),
        ({"num_hypotheses": 0}, ValueError, "num_hypotheses: expected a positive"),
        ({"value_bounds": None}, ValueError, "value_bounds: needed unless"),
        ({"value_bounds": (1.0, 0.0)}, ValueError, "value_bounds: .* in order"),
        (
            {"value_bounds": (jnp.asarray(1.0), jnp.asarray(0.0))},
            ValueError,
            "value_bounds: .* in order",
        ),
        ({"leaf_bounds": (1.0, 0.0)}, ValueError, "leaf_bounds: .* in order"),
        ({"leaf_fn": leaf}, ValueError, "leaf_bounds: leaf_fn is given"),
        ({"discount": 1.5}, ValueError, "discount: expected a number"),
        ({"actions": jnp.zeros((0, 2))}, ValueError, "actions: every leaf"),
    ],
)
def test_bad_input_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        plan(KEY, certain(table(0)), 0, **options)
