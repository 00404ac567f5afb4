"""A*: shortest paths on random mazes, round a wall, and under pressure."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import Belief, certain
from tests.planning.mazes import (
    KEY,
    MOVES,
    SIZE,
    START,
    TRACES,
    distance,
    distances,
    earned,
    in_maze,
    maze,
    move,
    pay,
    plan,
    steps_left,
    traced,
)


@pytest.mark.slow
@pytest.mark.parametrize("num_expanded_at_once", [1, 6])
def test_paths_through_mazes_are_the_shortest(num_expanded_at_once):
    num_found = 0
    for seed in range(10):
        cost = maze(seed)
        found = in_maze(
            KEY,
            certain(cost),
            START,
            num_expanded_at_once=num_expanded_at_once,
        )
        expected = distances(cost)[-1]
        assert found.tree.is_found == found.tree.is_best == np.isfinite(expected)
        assert found.info.num_model_calls == 4 * found.tree.num_expansions
        assert found.tree.num_overflowed == 0
        if not np.isfinite(expected):
            continue
        num_found += 1
        total, place = earned(cost, found.sequence, found.tree.plan_length)
        np.testing.assert_array_equal(place, SIZE - 1)
        np.testing.assert_allclose(total, -expected, rtol=1e-12)
        np.testing.assert_allclose(found.value, -expected, rtol=1e-12)
        np.testing.assert_array_equal(found.action, MOVES[found.index])
        np.testing.assert_array_equal(found.sequence[0], found.action)
    assert 3 <= num_found < 10


@pytest.mark.slow
def test_leaf_values_save_expansions():
    cost = np.ones((SIZE, SIZE))
    found = plan(KEY, certain(cost), START, leaf_fn=steps_left)
    blind = plan(KEY, certain(cost), START)
    assert found.value == blind.value == -2.0 * (SIZE - 1)
    # All paths promise the same, and the one that was begun is gone to its end.
    assert found.tree.num_expansions == 2 * (SIZE - 1)
    assert blind.tree.num_expansions > SIZE * (SIZE - 1)


def test_every_cell_is_expanded_once_where_there_is_no_goal():
    cost = maze(1)
    cost[-1, -2] = cost[-2, -1] = np.inf
    reached = np.isfinite(distances(cost)).sum()
    found = plan(KEY, certain(cost), START)
    # The first cell is not in the table, so it is entered again.
    assert found.tree.num_expansions - found.tree.num_reopened == reached + 1
    assert not found.tree.is_found
    assert not found.tree.is_best


GRAPH = {
    "next": np.array([[1, 2], [2, 2], [3, 3], [3, 3]]),
    "cost": np.array([[1.0, 3.0], [1.0, 1.0], [5.0, 5.0], [0.0, 0.0]]),
}
in_graph = partial(
    plan,
    transition_fn=lambda key, graph, state, action: (
        graph["next"][state, action].astype(state.dtype),
        graph["next"][state, action] == 3,
    ),
    reward_fn=lambda graph, state, action, _: -graph["cost"][state, action],
    actions=2,
    cell_size=1.0,
    leaf_fn=lambda _, state: jnp.array([-7.0, -6.0, 0.0, 0.0])[state],
    max_plan_length=8,
)


def test_a_better_path_opens_a_cell_again():
    found = in_graph(KEY, certain(GRAPH), 0)
    assert found.tree.num_reopened == 1
    assert found.tree.is_best
    assert found.value == -7.0
    np.testing.assert_array_equal(found.sequence[:2], [0, 0])
    assert found.tree.plan_length == 3


def test_a_goal_that_may_not_be_the_best_is_told_apart():
    found = in_graph(KEY, certain(GRAPH), 0, max_expansions=2)
    assert found.tree.is_found
    assert not found.tree.is_best
    assert found.value == -8.0
    np.testing.assert_array_equal(found.sequence[0], 1)


@pytest.mark.slow
def test_a_small_budget_leads_to_the_nearest_known_state():
    cost = np.ones((SIZE, SIZE))
    cost[:-1, 3] = np.inf
    found = plan(KEY, certain(cost), START, leaf_fn=steps_left, max_expansions=7)
    assert not found.tree.is_found
    assert found.tree.num_expansions == 7
    assert found.info.num_model_calls == 28
    total, place = earned(cost, found.sequence, found.tree.plan_length)
    nearest = float(steps_left(cost, place))
    assert found.value == total + nearest
    # Nearer than seven steps seven expansions cannot lead.
    assert nearest == steps_left(cost, START) + 7
    assert total == -7


def test_of_equally_near_states_the_cheapest_to_reach_is_gone_to():
    cost = np.random.default_rng(3).uniform(1.0, 2.0, (SIZE, SIZE))
    found = plan(KEY, certain(cost), np.array([5, 5]), max_expansions=7)
    around = cost[tuple((np.array([5, 5]) + MOVES).T)]
    assert found.tree.plan_length == 1
    assert found.index == around.argmin()
    np.testing.assert_allclose(found.value, -around.min(), rtol=1e-12)


def walk(key, wall, state, action):
    """A step of 0.3 in a direction, not through a wall at x = 1 but for its gap."""
    target = state + 0.3 * jnp.stack([jnp.cos(action), jnp.sin(action)])
    crosses = (state[0] < 1.0) != (target[0] < 1.0)
    is_blocked = crosses & (jnp.abs(target[1] - wall["gap"]) > 0.4)
    target = jnp.where(is_blocked, state, target)
    return target, jnp.linalg.norm(target - wall["goal"]) < 0.3


@pytest.mark.slow
def test_a_point_goes_round_a_wall_to_where_the_likelier_gap_is():
    goal = np.array([2.0, 0.0])
    walls = {"gap": jnp.array([2.0, -2.0]), "goal": jnp.asarray(np.stack([goal, goal]))}
    angles = jnp.linspace(0.0, 2.0 * jnp.pi, 8, endpoint=False)
    steps = partial(
        plan,
        KEY,
        transition_fn=walk,
        reward_fn=lambda wall, state, action, target: -0.3,
        leaf_fn=lambda wall, state: -jnp.linalg.norm(state - wall["goal"]),
        actions=angles,
        cell_size=np.array([0.2, 0.2]),
        max_plan_length=40,
    )
    for likelier in (0, 1):
        log_weight = jnp.where(jnp.arange(2) == likelier, 0.0, -1.0)
        found = steps(Belief(walls, log_weight), np.zeros(2))
        wall = {"gap": walls["gap"][likelier], "goal": goal}
        place, heights = jnp.zeros(2), []
        for number, action in enumerate(found.sequence[: found.tree.plan_length]):
            place, done = jax.jit(walk)(KEY, wall, place, action)
            heights.append(float(place[1]))
            assert done == (number == found.tree.plan_length - 1)
        assert found.tree.is_best
        assert np.abs(heights).max() > 1.5
        assert np.sign(heights[np.argmax(np.abs(heights))]) == (1, -1)[likelier]
        np.testing.assert_allclose(found.value, -0.3 * found.tree.plan_length)
        # Through the gap it is 3.5 at least, on eight directions a twelfth more, and
        # either end and the turn in the gap are up to a step away from where they
        # should be.
        assert -4.7 < found.value < -3.4
        # The rest of the sequence repeats the last action.
        np.testing.assert_array_equal(
            found.sequence[found.tree.plan_length :],
            found.sequence[found.tree.plan_length - 1],
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table_size", "max_probes", "overflows"), [(100, 3, True), (131, 131, False)]
)
def test_a_crowded_table_changes_no_path(table_size, max_probes, overflows):
    cost = maze(4)
    found = in_maze(
        KEY,
        certain(cost),
        START,
        table_size=table_size,
        max_probes=max_probes,
        max_expansions=3000,
    )
    easy = in_maze(KEY, certain(cost), START)
    assert easy.tree.is_best
    assert found.tree.is_best
    assert found.value == easy.value
    assert (found.tree.num_overflowed > 0) == overflows
    if not overflows:
        assert found.tree.num_expansions == easy.tree.num_expansions
    else:
        assert found.tree.num_expansions > easy.tree.num_expansions


def test_held_actions_and_discount_enter_the_value():
    line = partial(
        plan,
        KEY,
        certain(jnp.zeros(())),
        transition_fn=lambda key, _, state, action: (
            state + action,
            state + action > 4.5,
        ),
        reward_fn=lambda _, state, action, target: -1.0,
        actions=jnp.array([-1.0, 1.0]),
        cell_size=0.5,
        discount=0.9,
        action_repeat=3,
        max_expansions=50,
        max_plan_length=4,
    )
    found = line(0.0)
    # Five steps of which the last one is in the middle of the second action.
    assert found.tree.is_best
    assert found.tree.plan_length == 2
    np.testing.assert_allclose(found.value, -np.sum(0.9 ** np.arange(5)))
    np.testing.assert_array_equal(found.sequence, 1.0)
    assert found.info.num_model_calls == 6 * found.tree.num_expansions


@pytest.mark.slow
def test_a_limit_of_depth_is_kept():
    cost = np.ones((SIZE, SIZE))
    limited = partial(in_maze, KEY, certain(cost), depth=2 * SIZE - 3)
    far, near = limited(START), limited(START + np.array([0, 1]))
    assert not far.tree.is_found
    assert far.tree.plan_length <= 2 * SIZE - 3
    assert far.tree.num_expansions < 400
    assert near.tree.is_best
    assert near.tree.plan_length == 2 * SIZE - 3


@pytest.mark.slow
def test_a_path_longer_than_the_sequence_is_cut_off():
    cost = maze(4)
    whole = in_maze(KEY, certain(cost), START)
    short = in_maze(KEY, certain(cost), START, max_plan_length=5)
    assert short.tree.plan_length == whole.tree.plan_length > 5
    np.testing.assert_array_equal(short.sequence, whole.sequence[:5])


@pytest.mark.slow
def test_forbidden_steps_are_not_taken():
    def reward(world, state, action, target):
        return jnp.where(world["is_forbidden"][target[0], target[1]], -jnp.inf, -1.0)

    cautious = partial(
        plan,
        KEY,
        transition_fn=lambda key, world, *rest: move(key, world["cost"], *rest),
        reward_fn=reward,
        leaf_fn=steps_left,
    )
    world = {
        "cost": np.ones((SIZE, SIZE)),
        "is_forbidden": np.zeros((SIZE, SIZE), bool),
    }
    world["is_forbidden"][5] = np.arange(SIZE) != 8
    found = cautious(certain(world), START)
    places = np.cumsum(found.sequence[: found.tree.plan_length], axis=0)
    assert found.tree.is_best
    assert [5, 8] in places.tolist()
    assert found.value == -2.0 * (SIZE - 1)

    world["is_forbidden"] = np.ones((SIZE, SIZE), bool)
    stuck = cautious(certain(world), START)
    assert not stuck.tree.is_found
    assert stuck.tree.plan_length == 0
    assert stuck.tree.num_expansions == 1
    assert stuck.value == steps_left(None, START)


def test_far_too_large_cells_still_yield_an_action():
    cost = np.ones((SIZE, SIZE))
    found = in_maze(KEY, certain(cost), START, cell_size=100.0)
    assert not found.tree.is_found
    assert found.tree.plan_length == 1
    # The first of the two actions that lead nearer.
    assert found.index == 0


@pytest.mark.slow
def test_coordinates_may_leave_out_part_of_the_state():
    def step(key, cost, state, action):
        target, done = move(key, cost, state["place"], action)
        return {"place": target, "clock": state["clock"] + 1}, done

    cost = maze(4)
    options = {
        "transition_fn": step,
        "reward_fn": lambda cost, state, action, target: pay(
            cost, state, action, target["place"]
        ),
        "leaf_fn": lambda cost, state: distance(cost, state["place"]),
    }
    state = {"place": START, "clock": 0}
    found = plan(
        KEY, certain(cost), state, coordinates_fn=lambda s: s["place"], **options
    )
    np.testing.assert_allclose(found.value, -distances(cost)[-1], rtol=1e-12)
    merged = found.tree.num_merged / found.info.num_model_calls
    loose = plan(KEY, certain(cost), state, **options)
    assert loose.tree.num_merged / loose.info.num_model_calls < merged


@pytest.mark.slow
def test_batch_and_jit_give_what_single_calls_give():
    cost = maze(4)
    free = np.argwhere(np.isfinite(cost))[::9]
    single = [in_maze(KEY, certain(cost), state) for state in free]
    single = jax.tree.map(lambda *x: np.stack(x), *single)
    assert len(np.unique(single.tree.num_expansions)) > 3
    one = partial(traced, KEY, certain(cost), leaf_fn=distance)
    several = jax.jit(jax.vmap(one))(free)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-12), several, single)


@pytest.mark.slow
def test_single_precision_finds_the_same_path(precision):
    cost = maze(4)
    found = in_maze(KEY, certain(cost), START)
    assert found.value.dtype == jnp.asarray(1.0).dtype
    assert found.tree.is_best
    tolerance = precision.choose(single=1e-5, double=1e-12)
    np.testing.assert_allclose(found.value, -distances(cost)[-1], rtol=tolerance)


@pytest.mark.slow
def test_arrays_and_numbers_of_the_world_do_not_compile_anew():
    in_maze(KEY, certain(maze(0)), START)
    TRACES.clear()
    for seed in range(3):
        in_maze(KEY, certain(maze(seed)), START + seed, cell_size=0.5 + 0.1 * seed)
    assert not TRACES
    in_maze(KEY, certain(maze(0)), START, max_probes=5)
    assert TRACES


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"depth": 0}, "depth: expected a positive"),
        ({"max_expansions": 0}, "max_expansions: expected a positive"),
        ({"max_plan_length": 0}, "max_plan_length: expected a positive"),
        ({"num_expanded_at_once": 0}, "num_expanded_at_once: expected a positive"),
        ({"table_size": 0}, "table_size: expected a positive"),
        ({"max_probes": 0}, "max_probes: expected a positive"),
        ({"cell_size": 0.0}, "cell_size: expected positive"),
        ({"cell_size": np.ones(3)}, "cell_size: expected one number or 2"),
        ({"coordinates_fn": lambda state: state[0]}, "coordinates_fn: expected a vec"),
        ({"discount": 0.0}, "discount: expected a number"),
    ],
)
def test_bad_input_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        in_maze(KEY, certain(maze(0)), START, **options)
