"""How to move one thing out of the way: grasps tried, and pushes planned, on a belief.

For every place where the robot may take hold of a thing, `sparse_sampling` plans pushes
under each hypothesis about what the thing is, as if all other things stayed where they
are and stopped it. A plan is done where the thing is at a pose from which the way is
open (`PoseTable`). Cost is time and effort; under hypotheses that no plan moves far
enough the attempt fails, and the weight of the others is its probability.

The robot is part of what moves: its mass is added to the thing's, and it must find room
where it holds it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.envs.free_space import FreeSpace, PoseTable
from boomdp_jax.envs.namo_drive import NUM_STEPS
from boomdp_jax.envs.namo_room import TIME_STEP, Robot
from boomdp_jax.models.known_kinds import pinned_where_it_is
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import prepare_step
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.sparse_sampling import sparse_sampling

PUSH_SECONDS = 2.0 * NUM_STEPS * TIME_STEP
"""Time and effort of one push with full force [s]."""
GAP = 0.04
"""Between the robot's rim and a thing that it is about to hold [m]."""
NOT_OPENED = 40.0
"""Cost of a plan that does not open the way [s]; more than any that does."""
_SPEED = 0.25
"""At which what is left to be moved is guessed to be moved [m/s]."""
_NUM_DIRECTIONS = 8
_DEPTH, _CAPACITY = 7, 16
_CELL = (0.1, 0.1, 0.2, 0.25, 0.25, 0.5)
"""In which states are one: pose [m, m, rad] and twist."""
_STRATUM = (0.4, 0.4, 0.8, np.inf, np.inf, np.inf)


class Ground(eqx.Module):
    """What is where, for moving one thing; data, so that all things are one program."""

    low: Float[Array, "3"]
    step: Float[Array, "3"]
    blocked: Bool[Array, "x y angle"]
    ahead: Float[Array, "x y angle"]
    """[m]"""
    free: Bool[Array, "column row"]
    """Where the robot's middle may be."""
    free_low: Float[Array, "2"]
    spacing: Float[Array, ""]


class Attempt(NamedTuple):
    """What is to be had of one thing from one region, on the host."""

    probability: float
    """Weight of hypotheses under which the way is opened."""
    cost: float
    """Mean time and effort under these, from the grasp on [s]; NaN if there is none."""
    grasp: int
    """The best one."""
    action: np.ndarray
    """First push with it, `[3]` [N, N, N m]."""


def ground_of(
    space: FreeSpace, table: PoseTable, free: Bool[np.ndarray, "x y"]
) -> Ground:
    """Maps as arrays.

    Args:
        space: the room's maps.
        table: of the thing.
        free: cells for the robot, without the thing.
    """
    num = 16 // table.blocked.shape[2]
    return Ground(
        low=on_device(table.low),
        step=on_device((*table.step[:2], table.step[2] / num)),
        blocked=on_device(np.repeat(table.blocked, num, axis=2), bool),
        # A region that cannot be reached by moving this thing is far.
        ahead=on_device(np.repeat(np.minimum(table.ahead, 1e3), num, axis=2)),
        free=on_device(free, bool),
        free_low=on_device(space.grid.low),
        spacing=on_device(space.grid.spacing),
    )


def grasp_sites(
    space: FreeSpace, thing: int, pose: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "site 2"]:
    """Where the robot's middle may be, to take hold of a thing [m].

    Args:
        space: the room's maps.
        thing: which.
        pose: where it is.

    Returns:
        Places round its outline, three on each side of a box.
    """
    outline = space.room.things[thing].outline
    away = space.room.robot.radius + GAP
    if len(outline) == 1:
        angle = 2 * np.pi * np.arange(12) / 12
        own = (outline[0] + away) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    else:
        w, h = outline
        part = np.array([-0.75, 0.0, 0.75])
        one = np.ones(3)
        own = np.concatenate(
            [
                np.stack([(w + away) * one, part * h], axis=-1),
                np.stack([-part * w, (h + away) * one], axis=-1),
                np.stack([-(w + away) * one, -part * h], axis=-1),
                np.stack([part * w, -(h + away) * one], axis=-1),
            ]
        )
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turned = own @ np.array([[cos, sin], [-sin, cos]])
    return turned + np.asarray(pose, float)[:2]


def actions_of(force: float) -> Float[np.ndarray, "action 3"]:
    """Drives that are tried: full force in each direction, and half of it."""
    angle = 2 * np.pi * np.arange(_NUM_DIRECTIONS) / _NUM_DIRECTIONS
    round_circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    return force * np.concatenate([round_circle, 0.5 * round_circle[::2]])


def attempt(
    key: Key,
    scene: Scene,
    ground: Ground,
    belief: Belief,
    state: State,
    places: Float[np.ndarray, "grasp 2"],
    robot: Robot,
    way_costs: Float[np.ndarray, " grasp"],
) -> Attempt:
    """Plan with every grasp, and take the best.

    Args:
        key: random key.
        scene: of the thing alone.
        ground: maps.
        belief: hypotheses about the thing.
        state: of the thing.
        places: of the robot's middle in each grasp [m].
        robot: its mass and force.
        way_costs: of getting to each grasp [s].

    Returns:
        What comes of the best grasp.

    Raises:
        ValueError: no grasp.
    """
    if not len(places):
        raise ValueError("places: expected one grasp at least, got none")
    actions = actions_of(robot.force)
    mass, wrenches = on_device(robot.mass), on_device(actions)
    planned = [
        _planned(key, scene, ground, belief, state, on_device(place), mass, wrenches)
        for place in places
    ]
    values = np.stack([np.asarray(value, float) for value, _ in planned])
    index = np.array([int(first) for _, first in planned])
    weight = np.asarray(belief.weight, float)
    opens = values > -NOT_OPENED
    probability = opens @ weight
    paid = np.where(opens, -values, 0.0) @ weight
    cost = paid / np.where(probability > 0, probability, np.nan)
    # Sorted by what a trial costs until one works, as in `planning.trials`.
    odds = (1 - probability) / np.maximum(probability, 1e-9)
    score = np.where(probability > 0, cost, NOT_OPENED) + way_costs
    score = score + (way_costs + PUSH_SECONDS) * np.minimum(odds, 1e3)
    best = int(np.argmin(score))
    return Attempt(
        float(probability[best]), float(cost[best]), best, actions[index[best]]
    )


def loaded(params: Params, scene: Scene, mass: Float[Array, ""]) -> Params:
    """A thing that is held: the robot's mass is added, its weight is not.

    Args:
        params: of a thing alone.
        scene: of the thing alone.
        mass: of the robot [kg].
    """
    own = params.density * scene.area
    share = own / (own + mass)
    ground = params.ground
    return dataclasses.replace(
        params,
        density=params.density / share,
        ground=dataclasses.replace(ground, dry=ground.dry * share[:, None]),
    )


def looked_up(ground: Ground, pose: Float[Array, "3"]) -> tuple[Array, Array]:
    """Whether a pose is blocked, and how far it is to one that opens the way [m]."""
    num = jnp.asarray(ground.blocked.shape, jnp.int32)
    index = jnp.round((pose - ground.low) / ground.step).astype(jnp.int32)
    angle = jnp.mod(index[2], num[2])
    is_in = (index[:2] >= 0) & (index[:2] < num[:2])
    i, j = jnp.clip(index[0], 0, num[0] - 1), jnp.clip(index[1], 0, num[1] - 1)
    blocked = ground.blocked[i, j, angle] | ~jnp.all(is_in)
    return blocked, ground.ahead[i, j, angle]


def _robot_fits(ground: Ground, place: Float[Array, "2"]) -> Array:
    index = jnp.round((place - ground.free_low) / ground.spacing).astype(jnp.int32)
    num = jnp.asarray(ground.free.shape, jnp.int32)
    index = jnp.clip(index, 0, num - 1)
    return ground.free[index[0], index[1]]


class _Hypothesis(NamedTuple):
    """What a tree is told, the same for all of a plan but Φ."""

    advance: Callable
    """One step of the thing, with the robot's mass on it."""
    dt: Array
    """Of a step [s]."""
    ground: Ground
    offset: Array
    """Of the robot's middle, in the thing's frame."""
    force: Array


def _transition(key, hypothesis: _Hypothesis, state: State, drive):
    del key
    arm = _arm(hypothesis, state)
    moment = drive[2] + arm[0] * drive[1] - arm[1] * drive[0]
    wrench = jnp.stack([drive[0], drive[1], moment])[None]
    moved = hypothesis.advance(state, wrench)[0]
    pose = moved.pose[0]
    blocked, ahead = looked_up(hypothesis.ground, pose)
    fits = _robot_fits(hypothesis.ground, pose[:2] + _arm(hypothesis, moved))
    stays = blocked | ~fits | ~jnp.all(jnp.isfinite(moved.array))
    halted = State(state.pose, jnp.zeros_like(state.twist))
    moved = jax.tree.map(lambda p, q: jnp.where(stays, p, q), halted, moved)
    return moved, (ahead <= 0.0) & ~stays


def _arm(hypothesis: _Hypothesis, state: State):
    cos, sin = jnp.cos(state.pose[0, 2]), jnp.sin(state.pose[0, 2])
    x, y = hypothesis.offset
    return jnp.stack([cos * x - sin * y, sin * x + cos * y])


def _reward(hypothesis: _Hypothesis, state, drive, next_state):
    del state, next_state
    share = jnp.sqrt(jnp.sum(drive[:2] ** 2)) / hypothesis.force
    return -hypothesis.dt * (1.0 + share)


def _leaf(hypothesis: _Hypothesis, state: State):
    _, ahead = looked_up(hypothesis.ground, state.pose[0])
    return -NOT_OPENED - ahead / _SPEED


def _coordinates(state: State):
    return state.array[0]


@jax.jit
def _planned(key, scene, ground, belief, state, place, mass, actions):
    """Values under each hypothesis with one grasp, and the first action."""
    num = belief.log_weight.shape[0]
    pose = state.pose[0]
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = place - pose[:2]
    offset = jnp.stack([cos * x + sin * y, cos * y - sin * x])
    force = jnp.max(jnp.sqrt(jnp.sum(actions[:, :2] ** 2, axis=-1)))

    def prepared(one: Params) -> Callable:
        return prepare_step(scene, loaded(pinned_where_it_is(one, state), scene, mass))

    advance = jax.vmap(prepared)(belief.hypotheses)
    same = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)),
        (scene.dt, ground, offset, force),
    )
    plan = sparse_sampling(
        key,
        Belief(_Hypothesis(advance, *same), belief.log_weight),
        state,
        transition_fn=_transition,
        reward_fn=_reward,
        actions=actions,
        depth=_DEPTH,
        action_repeat=NUM_STEPS,
        leaf_fn=_leaf,
        num_hypotheses=num,
        cell_size=jnp.asarray(_CELL),
        stratum_size=jnp.asarray(_STRATUM),
        coordinates_fn=_coordinates,
        capacity=_CAPACITY,
        verify=True,
    )
    values: Any = plan.hypothesis_q_values
    return jnp.max(values, axis=-1), plan.index
