"""What all comparators have in common: one call, and what it promises."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax import planning
from boomdp_jax.planning import certain
from tests.planning.small_worlds import drift, reach_right

LEFT_RIGHT = jnp.array([[-1.0], [0.0], [1.0]])
LEFT, RIGHT = 0, 2
# Small; and which count of its own each planner has.
OPTIONS = {
    "random_shooting": {"num_samples": 64},
    "cross_entropy_method": {"num_samples": 32, "num_iterations": 3},
    "mppi": {"num_samples": 64, "num_iterations": 2},
    "gradient_shooting": {"num_starts": 2, "num_steps": 15},
    "mctx_search": {"num_simulations": 40},
}


@pytest.fixture(params=OPTIONS)
def name(request):
    if request.param == "mctx_search":
        pytest.importorskip("mctx")
    return request.param


def call(name, key, belief, state, **changes):
    options = {
        "transition_fn": drift,
        "reward_fn": reach_right,
        "actions": LEFT_RIGHT,
        "depth": 3,
        **OPTIONS[name],
        **changes,
    }
    return getattr(planning, name)(key, belief, state, **options)


SIGNS = jnp.array([1.0, -1.0])
START = jnp.asarray(0.0)


@pytest.mark.slow
@pytest.mark.parametrize(("odds", "best"), [(4.0, RIGHT), (0.25, LEFT)])
def test_weights_decide_between_opposed_hypotheses(name, odds, best):
    belief = (SIGNS, jnp.log(jnp.array([odds, 1.0])))
    plan = call(name, jax.random.key(0), belief, START)
    assert plan.index == best
    assert plan.sequence.shape == (3, 1)
    np.testing.assert_array_equal(plan.sequence[0], plan.action)


def test_hypothesis_without_weight_does_not_count_even_if_it_breaks(name):
    belief = (jnp.array([1.0, jnp.nan]), jnp.array([0.0, -jnp.inf]))
    plan = call(name, jax.random.key(0), belief, START)
    assert plan.index == RIGHT
    assert np.isfinite(plan.value)


@pytest.mark.slow
def test_jit_and_vmap_over_states_equal_a_loop(name):
    belief, key = (SIGNS, jnp.array([0.5, 0.0])), jax.random.key(1)
    states = jnp.array([-1.0, 0.3, 2.0])
    together = jax.jit(jax.vmap(functools.partial(call, name, key, belief)))(states)
    for i, state in enumerate(states):
        one = call(name, key, belief, state)
        # Signed zeros and sums in another order.
        for leaf, expected in zip(
            jax.tree.leaves(together), jax.tree.leaves(one), strict=True
        ):
            np.testing.assert_allclose(leaf[i], expected, rtol=1e-9, atol=1e-9)


# Smaller still, and how many sequences of three levels they make; simulations of mctx
# are single levels.
COUNTED = {
    "random_shooting": ({"num_samples": 5}, 5),
    "cross_entropy_method": ({"num_samples": 4, "num_iterations": 3}, 4 * 3),
    "mppi": ({"num_samples": 4, "num_iterations": 2}, 4 * 2 + 1),
    "gradient_shooting": ({"num_starts": 2, "num_steps": 3}, 2 * (3 + 1)),
    "mctx_search": ({"num_simulations": 12}, 12 / 3),
}


@pytest.mark.slow
def test_one_program_serves_all_numbers_and_its_calls_of_the_model_are_counted(name):
    num_traces, hypotheses = 0, []

    def counted(key, hypothesis, state, action):
        nonlocal num_traces
        num_traces += 1
        # Given the state too: there is one call for each value of what is given.
        jax.debug.callback(lambda h, _: hypotheses.append(float(h)), hypothesis, state)
        return drift(key, hypothesis, state, action)

    options, num_sequences = COUNTED[name]
    options |= {"transition_fn": counted, "action_repeat": 2, "num_hypotheses": 2}
    # Four of thirty hypotheses weigh anything, and two are drawn of them.
    log_weight = jnp.full(30, -jnp.inf).at[3:7].set(0.0)
    numbers = jnp.arange(30.0)
    plan = call(name, jax.random.key(0), (numbers, log_weight), START, **options)
    jax.effects_barrier()
    num_calls = num_sequences * 3 * 2 * 2
    assert len(hypotheses) == plan.info.num_model_calls == num_calls
    assert len(set(hypotheses)) == 2
    assert set(hypotheses) <= {3.0, 4.0, 5.0, 6.0}
    num_first = num_traces
    options |= {"actions": 2 * LEFT_RIGHT, "discount": 0.9}
    call(name, jax.random.key(1), (-numbers, 2 * log_weight), START + 1.0, **options)
    jax.effects_barrier()
    assert num_traces == num_first
    assert len(hypotheses) == 2 * num_calls


def end_at_once(key, hypothesis, state, action):
    del key, hypothesis
    return state + action[0], True


def nan_after_the_first_step(hypothesis, state, action, next_state):
    del hypothesis, action
    return jnp.where(state == 0.0, next_state, jnp.nan)


def nan_but_at_the_root(hypothesis, state):
    del hypothesis
    return jnp.where(state == 0.0, 0.0, jnp.nan)


def test_nothing_counts_after_the_end_of_an_episode(name):
    plan = call(
        name,
        jax.random.key(0),
        certain(1.0),
        START,
        transition_fn=end_at_once,
        reward_fn=nan_after_the_first_step,
        leaf_fn=nan_but_at_the_root,
    )
    assert plan.index == RIGHT
    # The reward of a single step is how far the action goes, at most 1.
    assert plan.value == pytest.approx(float(plan.action[0]), abs=1e-12)
    assert plan.value > 0.4


@pytest.mark.parametrize("is_double", [False, True])
def test_single_precision_stays_single(name, is_double):
    """Where it is the rule, and where numbers of it come in though double is."""

    def plan():
        actions, signs = LEFT_RIGHT.astype(jnp.float32), SIGNS.astype(jnp.float32)
        state, belief = START.astype(jnp.float32), (signs, jnp.zeros(2))
        return call(name, jax.random.key(0), belief, state, actions=actions)

    with jax.enable_x64(is_double):
        shapes = jax.eval_shape(plan)
    assert shapes.action.dtype == shapes.sequence.dtype == jnp.float32
    # Returns are of the type of the discount.
    assert shapes.value.dtype == (jnp.float64 if is_double else jnp.float32)


@pytest.mark.parametrize("count", ["depth", "num_hypotheses", "action_repeat"])
def test_counts_that_are_not_positive_are_refused(name, count):
    with pytest.raises(ValueError, match=f"{count}: expected a positive integer"):
        call(name, jax.random.key(0), certain(1.0), START, **{count: 0})


def test_own_counts_that_are_not_positive_are_refused(name):
    for count in OPTIONS[name]:
        with pytest.raises(ValueError, match=f"{count}: expected a positive integer"):
            call(name, jax.random.key(0), certain(1.0), START, **{count: 0})


@pytest.mark.parametrize(
    "planner",
    [
        planning.cross_entropy_method,
        planning.mppi,
        planning.gradient_shooting,
    ],
)
def test_continuous_planners_refuse_actions_that_span_no_box(planner):
    with pytest.raises(ValueError, match=r"one array of floats \[action, dim\]"):
        planner(
            jax.random.key(0),
            certain(1.0),
            0.0,
            transition_fn=drift,
            reward_fn=reach_right,
            actions=3,
            depth=2,
        )


def test_counts_of_other_types_make_the_same_plan(name):
    """The shape checks of the tests refuse them before the function does."""
    planner = inspect.unwrap(getattr(planning, name))
    counts = OPTIONS[name] | {"depth": 3, "num_hypotheses": 2, "action_repeat": 1}
    counts = {count: np.int64(value) for count, value in counts.items()}
    belief, key = (SIGNS, jnp.array([0.5, 0.0])), jax.random.key(1)
    options = {"transition_fn": drift, "reward_fn": reach_right, "actions": LEFT_RIGHT}
    found = planner(key, belief, START, **options, **counts)
    assert found.value == call(name, key, belief, START, num_hypotheses=2).value
