"""States that no plan could be made from are refused by every planner."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax import planning
from boomdp_jax.planning import certain
from boomdp_jax.planning.problem import make_problem
from tests.planning.small_worlds import drift, reach_right

BOUNDS = {"value_bounds": (-1.0, 1.0), "max_expansions": 4}
OPTIONS = {
    "sparse_sampling": {"depth": 2},
    "forward_search_sparse_sampling": {"depth": 2, **BOUNDS},
    "a_star": {"cell_size": 0.1, "max_expansions": 4, "max_plan_length": 4},
    "random_shooting": {"depth": 2, "num_samples": 8},
    "cross_entropy_method": {"depth": 2, "num_samples": 8},
    "mppi": {"depth": 2, "num_samples": 8},
    "gradient_shooting": {"depth": 2, "num_starts": 2, "num_steps": 2},
    "mctx_search": {"depth": 2, "num_simulations": 4},
}


@pytest.fixture(params=OPTIONS)
def plan_from(request):
    if request.param == "mctx_search":
        pytest.importorskip("mctx")

    def plan_from(state, transition_fn=drift, reward_fn=reach_right):
        return getattr(planning, request.param)(
            jax.random.key(0),
            certain(jnp.asarray(1.0)),
            state,
            transition_fn=transition_fn,
            reward_fn=reward_fn,
            actions=jnp.array([[-1.0], [0.0], [1.0]]),
            **OPTIONS[request.param],
        )

    return plan_from


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf])
def test_a_state_that_is_not_finite_is_refused(plan_from, bad):
    with pytest.raises(ValueError, match=r"state: expected finite numbers.*(nan|inf)"):
        plan_from(jnp.asarray(bad))


def test_whole_numbers_are_refused_where_the_model_makes_fractions(plan_from):
    """Cut to whole numbers nothing would move, and all actions be worth the same."""

    def half_a_step(key, hypothesis, state, action):
        return state + 0.5 * action[0], False

    with pytest.raises(TypeError, match=r"returns float.* for a part that is int"):
        plan_from(jnp.asarray(0), half_a_step)


def test_the_part_that_is_not_finite_is_named(plan_from):
    state = {"place": jnp.zeros(2), "speed": jnp.array([0.0, jnp.nan])}
    with pytest.raises(ValueError, match=r"state\['speed'\].*0\. nan"):
        plan_from(state, lambda key, hypothesis, state, action: (state, False))


FORGETFUL = {
    "a pair": (
        lambda key, hypothesis, state, action: state + action[0],
        TypeError,
        r"transition_fn: expected a pair \(next_state, done\); got.* shape \(2,\)",
    ),
    "a triple": (
        lambda key, hypothesis, state, action: (state, 0.0, False),
        TypeError,
        r"transition_fn: expected a pair \(next_state, done\); got",
    ),
    "the structure": (
        lambda key, hypothesis, state, action: ({"place": state}, False),
        TypeError,
        r"next_state of the structure of the state.*shape \(2,\); got.*'place'",
    ),
    "the shape": (
        lambda key, hypothesis, state, action: (state[:1], False),
        ValueError,
        r"transition_fn: next_state: expected shape \(2,\).*got \(1,\)",
    ),
    "one end": (
        lambda key, hypothesis, state, action: (state, state > 0),
        ValueError,
        r"transition_fn: done: expected one number.*got shape \(2,\)",
    ),
    "an end": (
        lambda key, hypothesis, state, action: (state, None),
        TypeError,
        r"transition_fn: done: expected one truth value; got .*None",
    ),
}


@pytest.mark.parametrize("forgotten", FORGETFUL)
def test_what_a_model_returns_is_checked(plan_from, forgotten):
    """An array of two numbers unpacks as a pair does."""
    transition_fn, error, message = FORGETFUL[forgotten]
    with pytest.raises(error, match=message):
        plan_from(jnp.zeros(2), transition_fn, lambda h, s, a, n: jnp.sum(n))


def test_a_part_of_another_precision_has_the_type_of_the_state():
    """Whole numbers for floats too, and an end that is a number."""

    def jump(key, hypothesis, state, action):
        return {"x": jnp.asarray(2), "v": np.float64(1.0)}, 0.0

    state = {"x": jnp.zeros((), jnp.float32), "v": jnp.zeros((), jnp.float32)}
    problem = make_problem(jump, lambda h, s, a, n: n["x"], 2)
    outcome = problem.hold(jax.random.key(0), None, state, problem.action(0))
    assert outcome.state["x"] == 2.0
    assert all(leaf.dtype == jnp.float32 for leaf in outcome.state.values())
