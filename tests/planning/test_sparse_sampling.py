"""Beliefs, risk and options of the planner, each against a value known by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.planning import Belief, certain, sparse_sampling

KEY = jax.random.key(0)


def slide(key, hypothesis, state, action):
    """An action moves by what the hypothesis says."""
    return state + hypothesis * action, False


def place(hypothesis, state, action, after):
    return after


MODEL = {
    "transition_fn": slide,
    "reward_fn": place,
    "actions": jnp.array([-1.0, 0.0, 1.0]),
}


def test_weights_average_the_hypotheses():
    belief = (jnp.array([2.0, -1.0]), jnp.log(jnp.array([0.3, 0.7])))
    plan = sparse_sampling(KEY, belief, jnp.asarray(0.5), depth=1, **MODEL)
    expected = 0.5 + np.outer([2.0, -1.0], [-1.0, 0.0, 1.0])
    np.testing.assert_allclose(plan.hypothesis_q_values, expected)
    np.testing.assert_allclose(plan.q_values, [0.3, 0.7] @ expected)
    assert float(plan.value) == pytest.approx(float(plan.q_values.max()))
    assert float(plan.action) == 1.0 - 2.0 * (0.3 * 2.0 - 0.7 < 0)


@pytest.mark.parametrize(
    ("measure", "level", "expected"),
    [
        ("worst", 0.5, -2.0),
        ("cvar", 0.2, -2.0),
        ("cvar", 0.6, -0.5),
        ("cvar", 1.0, 0.5),
    ],
)
def test_risk_measures(measure, level, expected):
    # Values of action 1: −2, 1, 2 with weights 0.3, 0.3, 0.4, and one ruled out.
    belief = (
        jnp.array([1.0, -2.0, 2.0, -9.0]),
        jnp.log(jnp.array([0.3, 0.3, 0.4, 0.0])),
    )
    plan = sparse_sampling(
        KEY, belief, jnp.asarray(0.0), depth=1, risk=measure, risk_level=level, **MODEL
    )
    assert float(plan.q_values[2]) == pytest.approx(expected)


def test_map_and_mean_take_one_hypothesis():
    belief = (jnp.array([2.0, -1.0]), jnp.log(jnp.array([0.4, 0.6])))
    for hypotheses, slope in (("map", -1.0), ("mean", 0.4 * 2.0 - 0.6)):
        plan = sparse_sampling(
            KEY, belief, jnp.asarray(0.0), depth=1, hypotheses=hypotheses, **MODEL
        )
        np.testing.assert_allclose(plan.q_values, [-slope, 0.0, slope])


def test_fresh_hypotheses_give_the_mean_of_outcomes():
    belief = (jnp.array([2.0, -1.0]), jnp.log(jnp.array([0.3, 0.7])))
    plan = sparse_sampling(
        KEY,
        belief,
        jnp.asarray(0.0),
        depth=1,
        num_samples=20_000,
        hypotheses="fresh",
        **MODEL,
    )
    # Sd of one draw is 3 sqrt(0.21).
    error = 3.0 * np.sqrt(0.21 / 20_000)
    np.testing.assert_allclose(plan.q_values, [0.1, 0.0, -0.1], atol=4 * error)


@pytest.mark.slow
def test_hypotheses_are_kept_down_the_tree():
    # Whoever knows the sign gains at every level; drawn anew nothing can be gained.
    belief = (jnp.array([1.0, -1.0]), jnp.zeros(2))
    options = {"depth": 4, "cell_size": 0.5, **MODEL}
    kept = sparse_sampling(KEY, belief, jnp.asarray(0.0), **options)
    fresh = sparse_sampling(
        KEY,
        belief,
        jnp.asarray(0.0),
        num_samples=256,
        hypotheses="fresh",
        capacity=16,
        **options,
    )
    # By hand: a right first step, then +1 each: 1+2+3+4; a wrong one −1+0+1+2.
    np.testing.assert_allclose(kept.q_values[jnp.array([0, 2])], (10 + 2) / 2)
    assert float(fresh.value) < 4.0


def test_few_hypotheses_are_drawn_by_weight():
    weights = jnp.array([0.5, 0.25, 0.125, 0.125])
    belief = (jnp.arange(4.0), jnp.log(weights))
    found = []
    for number in range(400):
        plan = sparse_sampling(
            jax.random.key(number),
            belief,
            jnp.asarray(0.0),
            depth=1,
            num_hypotheses=2,
            **MODEL,
        )
        assert plan.hypothesis_q_values.shape == (2, 3)
        found.append(float(plan.q_values[2]))
    # Systematic: one of two is the first with certainty or nearly; mean of all: 0.875.
    assert np.mean(found) == pytest.approx(0.875, abs=4 * np.std(found) / 20)


def test_posteriors_are_beliefs():
    class Drawn:
        params = jnp.array([1.0, 3.0])
        log_weight = jnp.zeros(2)

    plan = sparse_sampling(KEY, Drawn(), jnp.asarray(0.0), depth=1, **MODEL)
    np.testing.assert_allclose(plan.q_values, [-2.0, 0.0, 2.0])


@pytest.mark.slow
def test_a_dropped_action_is_no_veto():
    # One place at level 2: whatever does not lead there is dropped, under each
    # hypothesis something else.
    belief = (jnp.array([1.0, -1.0]), jnp.zeros(2))
    plan = sparse_sampling(
        KEY, belief, jnp.asarray(0.0), depth=3, cell_size=0.1, capacity=1, **MODEL
    )
    assert np.all(np.isfinite(plan.q_values))
    assert int(plan.info.num_dropped.sum()) > 0


@pytest.mark.slow
def test_the_rest_of_a_good_plan_is_not_forgotten():
    # The prize is at the end of a line of steps that a tree of one place loses.
    def step(key, hypothesis, state, action):
        return state + action, False

    def prize(hypothesis, state, action, after):
        return jnp.where(after == 5.0, 20.0, -jnp.abs(after))

    options = {
        "transition_fn": step,
        "reward_fn": prize,
        "actions": jnp.array([-1.0, 0.0, 1.0]),
        "depth": 5,
        "cell_size": 1.0,
    }
    belief = certain(jnp.zeros(()))
    good = sparse_sampling(KEY, belief, jnp.asarray(0.0), capacity=20, **options)
    np.testing.assert_array_equal(good.sequence, np.ones(5))
    narrow = {"capacity": 1, "overflow": "bound", **options}
    forgot = sparse_sampling(KEY, belief, jnp.asarray(1.0), **narrow)
    kept = sparse_sampling(KEY, belief, jnp.asarray(1.0), previous=good, **narrow)
    assert float(kept.action) == 1.0
    # −2−3−4+20, and one more step of the last action: −6.
    assert float(kept.value) == pytest.approx(5.0)
    assert float(forgot.value) < 5.0
    extra = int(kept.info.num_model_calls) - int(forgot.info.num_model_calls)
    assert extra == 5


@pytest.mark.slow
def test_cell_size_from_steps_is_half_a_step():
    # Both coordinates move by known steps; the third never does.
    def step(key, hypothesis, state, action):
        return state + jnp.array([0.2, 3.0, 0.0]) * action, False

    plan = sparse_sampling(
        KEY,
        certain(jnp.zeros(())),
        jnp.zeros(3),
        transition_fn=step,
        reward_fn=lambda h, s, a, n: n[0],
        actions=jnp.array([-1.0, 1.0]),
        depth=3,
        cell_size="auto",
    )
    np.testing.assert_allclose(plan.info.cell_size, [0.1, 1.5, np.inf])
    # At most one node for each sum of steps.
    np.testing.assert_array_equal(plan.info.num_nodes[0], [1, 2, 3])


@pytest.mark.slow
def test_pytrees_of_states_and_actions():
    def step(key, hypothesis, state, action):
        return {"x": state["x"] + action["push"], "n": state["n"] + 1}, False

    plan = sparse_sampling(
        KEY,
        certain({"unused": jnp.zeros(3)}),
        {"x": jnp.zeros(2), "n": jnp.asarray(0)},
        transition_fn=step,
        reward_fn=lambda h, s, a, n: n["x"][0] - a["cost"],
        actions={
            "push": jnp.array([[0.0, 1.0], [1.0, 0.0]]),
            "cost": jnp.array([0.0, 0.5]),
        },
        depth=3,
        cell_size=1.0,
        keep_tree=True,
    )
    np.testing.assert_allclose(plan.action["push"], [1.0, 0.0])
    assert float(plan.value) == pytest.approx(1 + 2 + 3 - 1.5)
    assert plan.sequence["push"].shape == (3, 2)


def informative(key, hypothesis, state, action):
    """Action 0 shows a light and pays nothing; 1 and 2 bet on either hypothesis."""
    light = jnp.where(action == 0, hypothesis, 0.0)
    return jnp.array([light, action.astype(float)]), False


def bet(hypothesis, state, action, after):
    is_won = (action == 1) == (hypothesis > 0)
    return jnp.where(action == 0, 0.0, jnp.where(is_won, 1.0, -1.2))


def sees_light(hypothesis, state, action, after):
    expected = jnp.where(action == 0, hypothesis, 0.0)
    return -0.5 * ((after[0] - expected) / 0.1) ** 2


BETTING = {
    "transition_fn": informative,
    "reward_fn": bet,
    "actions": 3,
    "depth": 3,
    "cell_size": 0.5,
}


@pytest.mark.slow
def test_adaptive_root_pays_for_what_it_will_know():
    belief = (jnp.array([1.0, -1.0]), jnp.zeros(2))
    state = jnp.zeros(2)
    greedy = sparse_sampling(KEY, belief, state, **BETTING)
    # Known from the start: 3 with the light, whatever is done first: no use for it.
    np.testing.assert_allclose(greedy.q_values, [2.0, 1.9, 1.9])
    adaptive = sparse_sampling(
        KEY,
        belief,
        state,
        hypotheses="adaptive",
        likelihood_fn=sees_light,
        **BETTING,
    )
    # After the light 1 + 1. After a bet (−0.1) it is as unknown as before: the light is
    # then better than another bet (0 to −0.1), and one more bet follows (1).
    np.testing.assert_allclose(adaptive.q_values, [2.0, 0.9, 0.9])
    assert int(adaptive.index) == 0


@pytest.mark.slow
def test_adaptive_root_is_the_other_where_nothing_is_seen():
    belief = Belief(jnp.array([1.0, -1.0]), jnp.log(jnp.array([0.8, 0.2])))
    adaptive = sparse_sampling(
        KEY,
        belief,
        jnp.zeros(2),
        hypotheses="adaptive",
        likelihood_fn=lambda h, s, a, n: 0.0,
        **BETTING,
    )
    bet_once = 0.8 - 0.2 * 1.2
    # What is done second is the same for both hypotheses.
    np.testing.assert_allclose(
        adaptive.q_values[:2], [bet_once + 1.0, 2 * bet_once + 1.0]
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"depth": 0}, "depth: expected a positive integer; got 0"),
        ({"num_samples": (1, 2)}, "num_samples: expected one number, or one for each"),
        ({"num_samples": 0}, "num_samples: expected a positive"),
        ({"hypotheses": "best"}, "hypotheses: expected one of"),
        ({"overflow": "all"}, "overflow: expected one of"),
        ({"risk": "var"}, "risk: expected one of"),
        ({"risk_level": 0.0}, "risk_level"),
        ({"risk_level": jnp.asarray(2.0)}, "risk_level: expected a number in"),
        ({"cell_size": "half"}, "cell_size: expected sizes, 'auto' or None"),
        ({"cell_size": [1.0, 2.0]}, "cell_size: expected one number or 1"),
        ({"cell_size": 0.0}, "cell_size: expected positive"),
        ({"capacity": 0}, "capacity"),
        ({"discount": 0.0}, "discount"),
        ({"discount": jnp.asarray(2.0)}, "discount: expected a number in"),
        ({"actions": True}, "actions: expected arrays .* or how many"),
        ({"actions": np.True_}, "actions: expected arrays .* or how many"),
        ({"action_repeat": 0}, "action_repeat"),
        ({"actions": jnp.zeros((0, 2))}, "actions"),
        ({"actions": {"a": jnp.zeros(2), "b": jnp.zeros(3)}}, "actions"),
        ({"hypotheses": "adaptive", "cell_size": 1.0}, "likelihood_fn"),
        ({"depth": 30}, "give a cell_size"),
        (
            {"reward_fn": lambda h, s, a, n: jnp.zeros(2)},
            "reward_fn: expected one number",
        ),
        (
            {"cell_size": 1.0, "coordinates_fn": lambda s: s},
            "coordinates_fn: expected a vector",
        ),
    ],
)
def test_bad_options_are_named(options, message):
    options = {"depth": 3, **MODEL, **options}
    with pytest.raises(ValueError, match=message):
        sparse_sampling(KEY, certain(jnp.ones(())), jnp.asarray(0.0), **options)


@pytest.mark.parametrize(
    ("belief", "error", "message"),
    [
        (jnp.zeros(3), TypeError, "belief: expected a Belief"),
        ((jnp.zeros(3), jnp.zeros(2)), ValueError, "expected a leading axis of 2"),
        ((jnp.zeros(3), jnp.zeros(())), ValueError, "one number for each hypothesis"),
        (
            (jnp.zeros(2), [0.0, jnp.nan]),
            ValueError,
            r"belief: log_weight.*nan\]",
        ),
        ((jnp.zeros(2), [0.0, jnp.inf]), ValueError, r"belief: log_weight.*inf\]"),
        ((jnp.zeros(1), [-jnp.inf]), ValueError, r"at least one .* finite; got \[-inf"),
    ],
)
def test_bad_beliefs_are_named(belief, error, message):
    with pytest.raises(error, match=message):
        sparse_sampling(KEY, belief, jnp.asarray(0.0), depth=1, **MODEL)


def test_weights_that_are_traced_are_left_alone():
    def value(log_weight):
        belief = (jnp.ones(2), log_weight)
        return sparse_sampling(KEY, belief, jnp.asarray(0.0), depth=1, **MODEL).value

    assert float(jax.jit(value)(jnp.array([0.0, -jnp.inf]))) == 1.0
    assert np.isnan(jax.jit(value)(jnp.full(2, jnp.nan)))


BROKEN = {
    "reward_fn": lambda h, s, a, n: jnp.nan * s,
    "transition_fn": lambda key, h, s, a: (jnp.nan * s, False),
}


@pytest.mark.parametrize("part", BROKEN)
@pytest.mark.parametrize("verify", [False, True])
def test_where_nothing_is_known_there_is_no_value(part, verify):
    options = {**MODEL, part: BROKEN[part], "depth": 2, "verify": verify}
    plan = sparse_sampling(KEY, certain(jnp.ones(())), jnp.asarray(0.0), **options)
    np.testing.assert_array_equal(plan.q_values, [-np.inf] * 3)
    np.testing.assert_array_equal(plan.hypothesis_q_values, [[-np.inf] * 3])
    assert plan.value == -np.inf


@pytest.mark.parametrize("risk", ["mean", "cvar", "worst"])
def test_a_hypothesis_that_breaks_leaves_the_choice_to_the_others(risk):
    hypotheses, options = jnp.array([1.0, jnp.nan]), {**MODEL, "depth": 2, "risk": risk}
    broken = (hypotheses, jnp.array([0.0, 1.0]))
    plan = sparse_sampling(KEY, broken, jnp.asarray(5.0), **options)
    assert plan.index == 2
    np.testing.assert_array_equal(plan.q_values, [-np.inf] * 3)
    ruled_out = (hypotheses, jnp.array([0.0, -jnp.inf]))
    plan = sparse_sampling(KEY, ruled_out, jnp.asarray(5.0), **options)
    assert plan.index == 2
    np.testing.assert_allclose(plan.q_values, [4.0 + 5.0, 5.0 + 6.0, 6.0 + 7.0])


def test_a_function_that_is_none():
    with pytest.raises(TypeError, match="reward_fn"):
        sparse_sampling(
            KEY,
            certain(jnp.ones(())),
            jnp.asarray(0.0),
            **{"depth": 1, **MODEL, "reward_fn": 3},
        )
