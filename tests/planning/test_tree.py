"""The tree against the recursion, backward induction and closed forms."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import certain, sparse_sampling
from boomdp_jax.planning.problem import make_problem
from tests.planning.tabular import random_process
from tests.reference.recursive_sparse_sampling import recursive_values

NOTHING = certain(jnp.zeros(()))


def plan_of(process, state, **options):
    return sparse_sampling(
        jax.random.key(5), NOTHING, jnp.asarray(state), **process.model(), **options
    )


@pytest.mark.parametrize(
    ("depth", "num_samples", "is_common", "repeat"),
    [
        (1, 3, True, 1),
        (3, 2, False, 1),
        (2, (3, 1), True, 2),
        pytest.param(3, 2, True, 1, marks=pytest.mark.slow),
        pytest.param(3, (3, 1, 2), True, 1, marks=pytest.mark.slow),
        pytest.param(2, 1, False, 6, marks=pytest.mark.slow),
    ],
)
def test_full_tree_is_the_recursion(depth, num_samples, is_common, repeat):
    for seed in range(3):
        process = random_process(seed, 5, 3)
        leaf = jnp.asarray(np.random.default_rng(seed).standard_normal(5))
        options = {"leaf_fn": lambda h, s, leaf=leaf: leaf[s], "discount": 0.9}
        plan = plan_of(
            process,
            seed,
            depth=depth,
            num_samples=num_samples,
            common_random_numbers=is_common,
            action_repeat=repeat,
            **options,
        )
        problem = make_problem(**process.model(), action_repeat=repeat, **options)
        expected = recursive_values(
            jax.random.key(5),
            problem,
            jnp.zeros(()),
            jnp.asarray(seed),
            depth,
            num_samples,
            common_random_numbers=is_common,
        )
        np.testing.assert_allclose(plan.q_values, expected, rtol=1e-12, atol=1e-12)
        assert int(plan.index) == int(np.argmax(expected))


@pytest.mark.slow
def test_error_falls_with_the_square_root_of_draws():
    process = random_process(3, 6, 2)
    expected = process.q_values(2, 0.95)[0]
    errors = []
    for num_samples in (4, 16, 64):
        run = functools.partial(
            sparse_sampling,
            belief=NOTHING,
            state=jnp.asarray(0),
            depth=2,
            num_samples=num_samples,
            discount=0.95,
            **process.model(),
        )
        keys = jax.random.split(jax.random.key(1), 200)
        found = jax.vmap(lambda key, run=run: run(key).q_values)(keys)
        errors.append(np.sqrt(np.mean((found - expected[None]) ** 2)))
    # Halved by four times the draws; 400 numbers give a ratio within 10 %.
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.25)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.25)


@pytest.mark.slow
def test_merging_on_the_states_is_backward_induction():
    depth = 30
    for seed in range(3):
        process = random_process(seed, 20, 4, is_deterministic=True)
        plan = plan_of(process, 0, depth=depth, discount=0.9, cell_size=1.0)
        expected = process.q_values(depth, 0.9)[0]
        np.testing.assert_allclose(plan.q_values, expected, rtol=1e-9)
        assert np.all(np.asarray(plan.info.num_nodes) <= 20)
        assert np.all(np.asarray(plan.info.num_dropped) == 0)


def wander(key, hypothesis, state, action):
    noise = 0.3 * jax.random.normal(key, state.shape, state.dtype)
    return state + hypothesis * (action - 1.0) + noise, state[0] > 2.0


def closeness(hypothesis, state, action, after):
    return -jnp.sum(after**2) - 0.1 * action**2


WANDERING = {
    "transition_fn": wander,
    "reward_fn": closeness,
    "actions": jnp.arange(3.0),
    "discount": 0.9,
}


@pytest.mark.slow
def test_merged_tree_is_the_full_one_where_nothing_merges():
    state, belief = jnp.array([0.4, -0.3]), (jnp.array([1.0, 0.5]), jnp.zeros(2))
    options = {"depth": 4, "num_samples": 2, **WANDERING}
    full = sparse_sampling(jax.random.key(2), belief, state, **options)
    for overflow in ("stratified", "bound", "first"):
        merged = sparse_sampling(
            jax.random.key(2),
            belief,
            state,
            cell_size=1e-7,
            capacity=6**3,
            overflow=overflow,
            **options,
        )
        assert int(merged.info.num_merged.sum()) == 0
        np.testing.assert_allclose(
            merged.hypothesis_q_values, full.hypothesis_q_values, rtol=1e-12
        )
        np.testing.assert_array_equal(merged.sequence, full.sequence)
        assert int(merged.info.num_model_calls) == int(full.info.num_model_calls)


@pytest.mark.slow
def test_counts_add_up_and_agree_with_unique_cells():
    plan = sparse_sampling(
        jax.random.key(0),
        certain(jnp.ones(())),
        jnp.zeros(2),
        depth=6,
        num_samples=2,
        cell_size=0.2,
        capacity=40,
        keep_tree=True,
        **WANDERING,
    )
    nodes, merged, dropped = (
        np.asarray(getattr(plan.info, name))[0]
        for name in ("num_nodes", "num_merged", "num_dropped")
    )
    runs = jax.tree.map(lambda leaf: np.asarray(leaf[0]), plan.tree).records
    levels = []
    for run in runs:
        if run.place.ndim == 3:
            levels.append(run)
        else:
            levels += [
                jax.tree.map(lambda leaf, i=i: leaf[i], run)
                for i in range(len(run.place))
            ]
    assert len(levels) == 6
    for number, level in enumerate(levels[1:-1], start=1):
        on = level.nodes.exists[:, None, None] & (level.continuation > 0)
        below = levels[number + 1].nodes
        assert nodes[number + 1] == below.exists.sum() <= 40
        # Every living child is a node, merged into one, or of a cell without a place.
        unplaced = np.sum(on & (level.place < 0))
        assert dropped[number] <= unplaced
        assert on.sum() == nodes[number + 1] + merged[number] + dropped[number]
        cells = np.round(below.state[below.exists] / 0.2)
        assert len(np.unique(cells, axis=0)) == nodes[number + 1]
    assert dropped.sum() > 0
    assert merged.sum() > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"depth": 2, "num_samples": 2},
        {"depth": 2, "hypotheses": "fresh"},
        pytest.param(
            {"depth": 5, "num_samples": 1, "cell_size": 0.2, "capacity": 7},
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"depth": 3, "action_repeat": 2, "cell_size": "auto", "capacity": 5},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_calls_are_counted(options):
    count = []

    def counted(key, hypothesis, state, action):
        jax.debug.callback(lambda *_: count.append(1), state, hypothesis)
        return wander(key, hypothesis, state, action)

    plan = sparse_sampling(
        jax.random.key(0),
        (jnp.array([1.0, 0.5]), jnp.zeros(2)),
        jnp.zeros(2),
        **{**WANDERING, "transition_fn": counted, **options},
    )
    jax.effects_barrier()
    jax.block_until_ready(plan.value)
    assert len(count) == int(plan.info.num_model_calls)


@pytest.mark.slow
def test_mirrored_states_have_mirrored_values():
    def swing(key, hypothesis, state, action):
        angle, rate = state
        rate = rate + 0.1 * (action - 9.81 * jnp.sin(angle))
        return (angle + 0.1 * rate, rate), False

    def height(hypothesis, state, action, after):
        return -jnp.cos(after[0])

    run = functools.partial(
        sparse_sampling,
        jax.random.key(0),
        NOTHING,
        transition_fn=swing,
        reward_fn=height,
        actions=jnp.array([-2.0, 0.0, 2.0]),
        depth=6,
        cell_size=0.05,
        capacity=500,
        action_repeat=2,
    )
    one = run((jnp.asarray(0.31), jnp.asarray(-0.7)))
    other = run((jnp.asarray(-0.31), jnp.asarray(0.7)))
    assert int(one.info.num_merged.sum()) > 0
    np.testing.assert_allclose(one.q_values, other.q_values[::-1], atol=1e-9)


@pytest.mark.slow
def test_regulator_is_near_its_optimum():
    # x' = x + u, cost x² + u² and P x² at the horizon: the Riccati equation gives the
    # value with a free u; with one of 81 it is a little less.
    def move(key, hypothesis, state, action):
        return state + action, False

    def cost(hypothesis, state, action, after):
        return -(state[0] ** 2 + action**2)

    depth, p, at = 6, 1.0, 1.7
    for _ in range(depth):
        p = 1.0 + p - p**2 / (1.0 + p)
    plan = sparse_sampling(
        jax.random.key(0),
        NOTHING,
        jnp.array([at]),
        transition_fn=move,
        reward_fn=cost,
        leaf_fn=lambda h, s: -(s[0] ** 2),
        actions=jnp.linspace(-2.0, 2.0, 81),
        depth=depth,
        cell_size=0.01,
        capacity=800,
    )
    assert float(plan.value) == pytest.approx(-p * at**2, rel=0.01)
    gain = p_gain(depth)
    assert float(plan.action) == pytest.approx(-gain * at, abs=0.06)


def p_gain(depth):
    p = 1.0
    for _ in range(depth):
        gain = p / (1.0 + p)
        p = 1.0 + p - p**2 / (1.0 + p)
    return gain


@pytest.mark.slow
def test_the_end_pays_nothing_after_it():
    def step(key, hypothesis, state, action):
        return state + action, state + action >= 2

    def pay(hypothesis, state, action, after):
        return jnp.where(action == 1, -1.0, -0.4)

    options = {
        "transition_fn": step,
        "reward_fn": pay,
        "actions": 2,
        "depth": 6,
        "leaf_fn": lambda h, s: -100.0,
    }
    for grid in ({}, {"cell_size": 1.0, "capacity": 4}, {"action_repeat": 3}):
        plan = sparse_sampling(
            jax.random.key(0), NOTHING, jnp.asarray(0), **options, **grid
        )
        # Two steps of 1 end it, whatever comes first; staying leads to the leaf.
        assert float(plan.value) == pytest.approx(-2.0)
    at_end = sparse_sampling(
        jax.random.key(0), NOTHING, jnp.asarray(1), **options, cell_size=1.0
    )
    np.testing.assert_allclose(at_end.q_values, [-1.4, -1.0])


@pytest.mark.slow
def test_what_is_not_finite_is_avoided():
    def step(key, hypothesis, state, action):
        return jnp.where(action == 2, jnp.nan, state + action), False

    plan = sparse_sampling(
        jax.random.key(0),
        NOTHING,
        jnp.zeros(()),
        transition_fn=step,
        reward_fn=lambda h, s, a, n: n,
        actions=jnp.arange(3.0),
        depth=4,
        cell_size=0.5,
    )
    assert int(plan.index) == 1
    assert float(plan.value) == pytest.approx(1 + 2 + 3 + 4)
    assert np.all(np.isfinite(plan.q_values))


@pytest.mark.slow
@pytest.mark.parametrize("overflow", ["stratified", "gumbel"])
def test_vmap_is_a_loop_and_jit_is_eager(overflow):
    options = {
        "depth": 5,
        "cell_size": 0.2,
        "capacity": 10,
        "overflow": overflow,
        **WANDERING,
    }
    belief = (jnp.array([1.0, 0.5, 0.2]), jnp.array([0.0, -1.0, -0.5]))

    def value(key, state):
        return sparse_sampling(key, belief, state, **options).hypothesis_q_values

    keys = jax.random.split(jax.random.key(3), 4)
    states = jax.random.normal(jax.random.key(4), (4, 2))
    looped = np.stack([value(*each) for each in zip(keys, states, strict=True)])
    together = jax.jit(jax.vmap(value))(keys, states)
    np.testing.assert_allclose(together, looped, rtol=1e-9)
    assert np.all(np.isfinite(looped))


@pytest.mark.slow
def test_stratified_gets_round_a_wall_that_the_bound_runs_into():
    # Straight at the goal is a pocket; the way round is at first a way back.
    def step(key, hypothesis, state, action):
        moved = state + action
        x, y = moved
        hits = (jnp.abs(x - 1.0) < 0.05) & (jnp.abs(y) < 2.05)
        return jnp.where(hits, state, moved), jnp.sum((moved - GOAL) ** 2) < 0.01

    GOAL = jnp.array([2.0, 0.0])
    steps = 0.5 * jnp.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
    reached = {}
    for overflow in ("stratified", "bound"):
        plan = sparse_sampling(
            jax.random.key(0),
            NOTHING,
            jnp.zeros(2),
            transition_fn=step,
            reward_fn=lambda h, s, a, n: -jnp.linalg.norm(n - GOAL),
            actions=steps,
            depth=40,
            cell_size=0.5,
            capacity=24,
            overflow=overflow,
        )
        state, done = jnp.zeros(2), False
        for action in plan.sequence:
            if not done:
                state, done = step(None, None, state, action)
        reached[overflow] = bool(done)
    assert reached == {"stratified": True, "bound": False}
