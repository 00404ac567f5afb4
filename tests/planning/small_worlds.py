"""Worlds of which everything is known: a double integrator, a table, a line."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

# x = (position [m], velocity [m/s]), u = acceleration [m/s²], steps of 0.5 s.
DYNAMICS, INPUT = np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([0.125, 0.5])
STATE_COST, INPUT_COST, LAST_COST = np.diag([1.0, 0.2]), 0.3, np.diag([3.0, 1.0])
# Wide enough for the optimum from the states of the tests.
ACCELERATIONS = jnp.array([[-3.0], [-1.0], [0.0], [1.0], [3.0]])


def integrate(key, hypothesis, state, action):
    """The hypothesis scales what an acceleration does."""
    del key
    force = hypothesis * action[0] * INPUT.astype(state.dtype)
    return DYNAMICS.astype(state.dtype) @ state + force, False


def quadratic_reward(hypothesis, state, action, next_state):
    del hypothesis, next_state
    cost = STATE_COST.astype(state.dtype)
    return -(state @ cost @ state) - INPUT_COST * action[0] ** 2


def quadratic_leaf(hypothesis, state):
    del hypothesis
    return -(state @ LAST_COST.astype(state.dtype) @ state)


def riccati(state: np.ndarray, depth: int) -> tuple[float, list[float]]:
    """Best return and accelerations over a finite horizon, by backward recursion."""
    cost, gains = LAST_COST, []
    for _ in range(depth):
        gain = (INPUT @ cost @ DYNAMICS) / (INPUT_COST + INPUT @ cost @ INPUT)
        closed = DYNAMICS - np.outer(INPUT, gain)
        cost = STATE_COST + INPUT_COST * np.outer(gain, gain) + closed.T @ cost @ closed
        gains.append(gain)
    value, x, actions = -state @ cost @ state, state, []
    for gain in reversed(gains):
        actions.append(float(-gain @ x))
        x = DYNAMICS @ x + INPUT * actions[-1]
    return float(value), actions


# A table of six states and three actions with no pattern: greed does not pay in it.
_numbers = np.random.default_rng(3)
NUM_STATES, NUM_ACTIONS = 6, 3
NEXT_STATE = _numbers.integers(0, NUM_STATES, (NUM_STATES, NUM_ACTIONS))
IS_LAST = np.zeros((NUM_STATES, NUM_ACTIONS), bool)
IS_LAST[2, 1] = IS_LAST[4, 0] = True
TABLE_REWARD = _numbers.normal(size=(NUM_STATES, NUM_ACTIONS)).round(2)
TABLE_LEAF = _numbers.normal(size=NUM_STATES).round(2)


def move_in_table(key, hypothesis, state, action):
    del key, hypothesis
    return jnp.asarray(NEXT_STATE)[state, action], jnp.asarray(IS_LAST)[state, action]


def table_reward(hypothesis, state, action, next_state):
    """The hypothesis scales and shifts rewards."""
    del next_state
    return hypothesis[0] * jnp.asarray(TABLE_REWARD)[state, action] + hypothesis[1]


def table_leaf(hypothesis, state):
    del hypothesis
    return jnp.asarray(TABLE_LEAF)[state]


def table_returns(
    state: int,
    depth: int,
    discount: float,
    scale: float = 1.0,
    shift: float = 0.0,
    repeat: int = 1,
    leaf: np.ndarray = TABLE_LEAF,
) -> dict[tuple[int, ...], float]:
    """Return of every sequence of actions, one by one."""
    found = {}
    for sequence in itertools.product(range(NUM_ACTIONS), repeat=depth):
        now, total, factor = state, 0.0, 1.0
        for action in np.repeat(sequence, repeat):
            total += factor * (scale * TABLE_REWARD[now, action] + shift)
            factor *= 0.0 if IS_LAST[now, action] else discount
            now = NEXT_STATE[now, action]
        found[sequence] = total + factor * leaf[now]
    return found


def optimal_values(discount: float) -> np.ndarray:
    """Of each state of the table over an infinite horizon, by value iteration."""
    value = np.zeros(NUM_STATES)
    for _ in range(1000):
        later = np.where(IS_LAST, 0.0, discount * value[NEXT_STATE])
        value = (TABLE_REWARD + later).max(axis=1)
    return value


def best_by_first(returns: dict[tuple[int, ...], float]) -> np.ndarray:
    """Best return of the sequences that begin with each action."""
    return np.array(
        [
            max(value for sequence, value in returns.items() if sequence[0] == action)
            for action in range(NUM_ACTIONS)
        ]
    )


def drift(key, hypothesis, state, action):
    """A line on which the step is the action, its sign the hypothesis, with noise."""
    noise = jax.random.normal(key, (), state.dtype)
    return state + hypothesis * action[0] + 0.1 * noise, False


def reach_right(hypothesis, state, action, next_state):
    del hypothesis, state, action
    return next_state
