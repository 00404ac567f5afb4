"""Random mazes, whose shortest paths Dijkstra's algorithm knows."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from boomdp_jax.planning import a_star

KEY = jax.random.key(0)
TRACES = []
SIZE = 11
MOVES = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])


def maze(seed):
    """Cost of entering each cell, infinite in walls; corners are free."""
    generator = np.random.default_rng(seed)
    cost = generator.uniform(0.5, 2.0, (SIZE, SIZE))
    cost[generator.random((SIZE, SIZE)) < 0.35] = np.inf
    cost[0, 0] = cost[-1, -1] = 1.0
    return cost


def move(key, cost, state, action):
    TRACES.append(0)
    target = jnp.clip(state + action, 0, SIZE - 1)
    target = jnp.where(jnp.isinf(cost[target[0], target[1]]), state, target)
    return target, jnp.all(target == SIZE - 1)


def pay(cost, state, action, target):
    return -cost[target[0], target[1]]


def distance(cost, state):
    return -0.5 * jnp.sum(SIZE - 1 - state)


def steps_left(cost, state):
    return -1.0 * jnp.sum(SIZE - 1 - state)


def distances(cost):
    """From the first corner to every cell, by Dijkstra's algorithm."""
    edges = np.zeros((SIZE * SIZE, SIZE * SIZE))
    for place in np.argwhere(np.isfinite(cost)):
        for target in np.clip(place + MOVES, 0, SIZE - 1):
            if np.isfinite(cost[tuple(target)]):
                number, following = np.array([place, target]) @ [SIZE, 1]
                edges[number, following] = cost[tuple(target)]
    return dijkstra(csr_array(edges), indices=0)


def earned(cost, sequence, length):
    """Return and end of a path through a maze, walked on the host."""
    place, total = np.zeros(2, int), 0.0
    for action in np.asarray(sequence)[:length]:
        target = np.clip(place + action, 0, SIZE - 1)
        place = target if np.isfinite(cost[tuple(target)]) else place
        total -= cost[tuple(place)]
    return total, place


traced = partial(
    a_star,
    transition_fn=move,
    reward_fn=pay,
    actions=MOVES,
    cell_size=1.0,
    max_expansions=400,
    max_plan_length=60,
)


def plan(*arguments, **options):
    """A plan in arrays of NumPy."""
    return jax.device_get(traced(*arguments, **options))


in_maze = partial(plan, leaf_fn=distance)
START = np.zeros(2, int)
