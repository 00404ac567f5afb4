"""Sparse sampling as it is written on paper: a recursion over one tree, node by node.

The numbers of `hold` and `leaf` come from the problem itself, everything else is plain
Python. Random keys: a transition out of the node with path number $p$ at level $d$ has
the key `fold_in(fold_in(key, d), p C + c)` for the draw $c$ of $C$, whatever the
action; or, where actions do not share their random numbers,
`fold_in(fold_in(key, d), (p C + c) A + a)`. The root is node 0 of level 0; draw $c$ of
action $a$ leads from node $p$ to node $p A C + a C + c$ of the next level, modulo
$2^{32}$.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from boomdp_jax.planning.problem import Problem


def recursive_values(
    key: Any,
    problem: Problem,
    hypothesis: Any,
    state: Any,
    depth: int,
    num_samples: int | Sequence[int],
    common_random_numbers: bool = True,
) -> np.ndarray:
    """Return of each action at the root, by the whole tree.

    Args:
        key: random key of the search.
        problem: what is planned for.
        hypothesis: the one that the tree is of.
        state: at the root.
        depth: actions in a row, at least 1.
        num_samples: draws of each action, one number or one a level.
        common_random_numbers: whether actions share their draws.

    Returns:
        `[action]`.
    """
    widths = [num_samples] * depth if isinstance(num_samples, int) else num_samples
    assert len(widths) == depth
    num_actions = problem.num_actions
    actions = [problem.action(action) for action in range(num_actions)]

    def value(level, path, state):
        if level == depth:
            return _leaf(problem, hypothesis, state)
        return q_values(level, path, state).max()

    def q_values(level, path, state):
        width = widths[level]
        values = np.zeros((num_actions, width))
        for action in range(num_actions):
            for sample in range(width):
                number = path * width + sample
                if not common_random_numbers:
                    number = number * num_actions + action
                place = np.array([level, number % 2**32], np.uint32)
                outcome = _hold(key, place, problem, hypothesis, state, actions[action])
                values[action, sample] = outcome.reward
                if outcome.continuation > 0:
                    child = path * num_actions * width + action * width + sample
                    future = value(level + 1, child % 2**32, outcome.state)
                    values[action, sample] += float(outcome.continuation) * future
        return values.mean(axis=1)

    return q_values(0, 0, jax.tree.map(np.asarray, state))


@eqx.filter_jit
def _hold(key, place, problem, hypothesis, state, action):
    level_key = jax.random.fold_in(key, place[0])
    transition_key = jax.random.fold_in(level_key, place[1])
    return problem.hold(transition_key, hypothesis, state, action)


@eqx.filter_jit
def _leaf(problem, hypothesis, state):
    return problem.leaf(hypothesis, state)
