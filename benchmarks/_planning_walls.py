"""Two tasks in which walls mislead: a point mass in a pocket, a cart in a room."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _planning_task import (
    NUM_LEAF_STEPS,
    Task,
    scene_of,
    single_body,
    within_circle,
    wrapped,
)
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from boomdp_jax.physics import State, step


def _distance(place, goal):
    return jnp.sqrt(jnp.sum((place - goal) ** 2) + 1e-12)


# --- A point mass in a pocket ---------------------------------------------------------

POCKET = np.array(
    [[1.0, -1.1, 1.1, 1.1], [-0.2, 1.0, 1.0, 1.1], [-0.2, -1.1, 1.0, -1.0]]
)
"""Walls: least x and y, largest x and y [m]."""
POINT_GOAL = np.array([2.0, 0.0])
POINT_FORCE = 2.0


def point() -> Task:
    def transition(key, hypothesis, state, action):
        place, velocity = state
        velocity = 0.95 * velocity + 0.1 * within_circle(action, POINT_FORCE)
        moved = place + 0.1 * velocity
        hits = _is_inside(moved, POCKET)
        place = jnp.where(hits, place, moved)
        velocity = jnp.where(hits, 0.0, velocity)
        return (place, velocity), _distance(place, POINT_GOAL) < 0.2

    def start(key):
        place = jax.random.uniform(
            key,
            (2,),
            minval=jnp.array([0.2, -0.7]),
            maxval=jnp.array([0.8, 0.7]),
        )
        return place, jnp.zeros(2)

    geodesic = flood_filled(
        POCKET, POINT_GOAL, low=np.array([-3.0, -3.0]), high=np.array([4.0, 3.0])
    )
    return Task(
        name="point",
        transition_fn=transition,
        reward_fn=lambda h, s, a, n: -_distance(n[0], POINT_GOAL),
        actions=POINT_FORCE * jnp.array([[0.0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]),
        hypothesis=jnp.zeros(()),
        leaves={
            "zero": lambda h, s: 0.0,
            "straight": lambda h, s: -NUM_LEAF_STEPS * _distance(s[0], POINT_GOAL),
            "geodesic": lambda h, s: -NUM_LEAF_STEPS * geodesic(s[0]),
        },
        coordinates_fn=jnp.concatenate,
        cell_size=np.array([0.3, 0.3, 1.0, 1.0]),
        stratum_size=np.array([0.6, 0.6, 2.0, 2.0]),
        starts=start,
        num_steps=120,
        cost_bound=30.0,
        is_reached=lambda s: _distance(s[0], POINT_GOAL) < 0.2,
        action_repeat=2,
        depth=28,
        action_repeats=(2, 4, 8),
    )


def _is_inside(place, walls):
    """Whether a place is in any of some rectangles."""
    x, y = place
    x0, y0, x1, y1 = jnp.asarray(walls, place.dtype).T
    return jnp.any((x > x0) & (x < x1) & (y > y0) & (y < y1))


def flood_filled(walls, goal, *, low, high, margin=0.0, spacing=0.1):
    """Length of the way to a goal, from a table of a grid's shortest ways."""
    counts = np.round((high - low) / spacing).astype(int) + 1
    x = low[0] + spacing * np.arange(counts[0])
    y = low[1] + spacing * np.arange(counts[1])
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    x0, y0, x1, y1 = np.asarray(walls).T
    grown = np.stack([x0 - margin, y0 - margin, x1 + margin, y1 + margin])
    blocked = np.any(
        (grid[..., :1] > grown[0])
        & (grid[..., :1] < grown[2])
        & (grid[..., 1:] > grown[1])
        & (grid[..., 1:] < grown[3]),
        axis=-1,
    )
    number = np.arange(blocked.size).reshape(blocked.shape)
    edges = []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        ys = slice(max(0, -dy), counts[1] - max(0, dy))
        yt = slice(max(0, dy), counts[1] - max(0, -dy))
        source, target = number[: counts[0] - dx, ys], number[dx:, yt]
        free = ~blocked.ravel()[source] & ~blocked.ravel()[target]
        length = spacing * np.hypot(dx, dy)
        edges.append((source[free], target[free], np.full(free.sum(), length)))
    source, target, length = (np.concatenate(part) for part in zip(*edges, strict=True))
    graph = coo_matrix((length, (source, target)), shape=(blocked.size,) * 2)
    at = np.argmin(np.sum((grid.reshape(-1, 2) - goal) ** 2, axis=1))
    far = dijkstra(graph.tocsr(), directed=False, indices=at).reshape(blocked.shape)
    # In a wall's margin: a little more than at the nearest free place.
    finite = np.isfinite(far)
    away, nearest = distance_transform_edt(~finite, return_indices=True)
    far = far[tuple(nearest)] + spacing * away
    table = jnp.asarray(far, jnp.float32)

    def length_to_goal(place):
        where = (place - jnp.asarray(low, place.dtype)) / spacing
        where = jnp.clip(where, 0.0, jnp.asarray(counts, place.dtype) - 1.001)
        at = jnp.floor(where).astype(int)
        part = where - at
        i, j = at
        a, b = part
        near = table[i, j] * (1 - a) * (1 - b) + table[i + 1, j] * a * (1 - b)
        return near + table[i, j + 1] * (1 - a) * b + table[i + 1, j + 1] * a * b

    return length_to_goal


# --- A cart in the papers' room -------------------------------------------------------

ROOM = np.array(
    [
        [-1.0, -1.0, 0.06, 5.8],
        [6.34, -1.0, 7.4, 5.8],
        [-1.0, -1.0, 7.4, 0.06],
        [-1.0, 4.74, 7.4, 5.8],
        [3.1, 0.0, 3.3, 2.88],
        [3.1, 4.32, 3.3, 4.79],
        [0.0, 2.3, 0.64, 2.5],
        [2.56, 2.3, 3.84, 2.5],
        [5.76, 2.3, 6.4, 2.5],
    ]
)
CART_GOAL = np.array([5.28, 1.38])
HALF_LENGTH, HALF_WIDTH, AXLE = 0.50, 0.28, 0.40
CART_FORCE, PUSH_STEPS = 30.0, 4
NEAR_GOAL = 0.35


def cart() -> Task:
    spec = scene_of(
        {
            "gravity": [0.0, 0.0],
            "dt": 0.1,
            "bodies": [
                {
                    "name": "cart",
                    "pose": [0.0, 0.0, 0.0],
                    "shape": {"type": "box", "half_extents": [HALF_LENGTH, HALF_WIDTH]},
                    "density": 10.0,
                }
            ],
            "constraints": [
                {
                    "type": "wheel",
                    "a": "cart",
                    "pose": [-AXLE, 0.0, 0.0],
                    "viscous": [30.0, 600.0],
                }
            ],
        }
    )
    angles = np.arange(8) * np.pi / 4
    actions = CART_FORCE * np.stack([np.cos(angles), np.sin(angles)], 1)

    def transition(key, hypothesis, state, action):
        force = within_circle(action, CART_FORCE)
        wrench = jnp.zeros((1, 3)).at[0, :2].set(force)

        def one(_, state):
            moved, _ = step(spec.scene, hypothesis, state, wrench)
            hits = touches_room(moved.pose[0])
            pose = jnp.where(hits, state.pose, moved.pose)
            return State(pose, jnp.where(hits, 0.0, moved.twist))

        state = jax.lax.fori_loop(0, PUSH_STEPS, one, state)
        return state, _distance(state.pose[0, :2], CART_GOAL) < NEAR_GOAL

    def start(key):
        place_key, angle_key = jax.random.split(key)
        spread = jnp.array([0.25, 0.25])
        place = jnp.array([1.75, 1.34]) + jax.random.uniform(
            place_key, (2,), minval=-spread, maxval=spread
        )
        angle = jax.random.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi)
        return single_body(jnp.append(place, angle), jnp.zeros(3))

    geodesic = flood_filled(
        ROOM,
        CART_GOAL,
        low=np.array([0.0, 0.0]),
        high=np.array([6.4, 4.8]),
        margin=HALF_WIDTH,
    )
    return Task(
        name="cart",
        transition_fn=transition,
        reward_fn=lambda h, s, a, n: -_distance(n.pose[0, :2], CART_GOAL),
        actions=jnp.asarray(actions, jnp.float32),
        hypothesis=spec.params(),
        leaves={
            "zero": lambda h, s: 0.0,
            "straight": lambda h, s: (
                -NUM_LEAF_STEPS * _distance(s.pose[0, :2], CART_GOAL)
            ),
            "geodesic": lambda h, s: -NUM_LEAF_STEPS * geodesic(s.pose[0, :2]),
        },
        coordinates_fn=lambda s: s.pose[0].at[2].set(wrapped(s.pose[0, 2])),
        cell_size=np.array([0.25, 0.25, 0.8]),
        stratum_size=np.array([1.0, 1.0, np.inf]),
        starts=start,
        num_steps=40,
        cost_bound=15.0,
        is_reached=lambda s: _distance(s.pose[0, :2], CART_GOAL) < NEAR_GOAL,
        action_repeat=2,
        depth=14,
        action_repeats=(1, 2, 4),
    )


def touches_room(pose):
    """Whether the cart's outline reaches into a wall: corners and middles of sides."""
    x, y, angle = pose
    c, s = jnp.cos(angle), jnp.sin(angle)
    along = HALF_LENGTH * jnp.array([1.0, 1, 1, 0, -1, -1, -1, 0])
    across = HALF_WIDTH * jnp.array([-1.0, 0, 1, 1, 1, 0, -1, -1])
    px, py = x + c * along - s * across, y + s * along + c * across
    x0, y0, x1, y1 = jnp.asarray(ROOM, pose.dtype).T
    inside = (px[:, None] > x0[None]) & (px[:, None] < x1[None])
    inside = inside & (py[:, None] > y0[None]) & (py[:, None] < y1[None])
    return jnp.any(inside)


def axle_hypotheses(num: int, seed: int):
    """Carts with the axle at either end, in turn, at a random part of its length."""
    task = cart()
    rng = np.random.default_rng([47, seed])
    where = rng.uniform(0.3, 0.48, num) * np.where(np.arange(num) % 2, 1.0, -1.0)
    params = task.hypothesis

    def moved(place):
        position = params.wheel.position.at[..., 0].set(place)
        return eqx.tree_at(lambda p: p.wheel.position, params, position)

    return jax.vmap(moved)(jnp.asarray(where, jnp.float32))
