"""A robot that gets to its goal, and moves furniture out of its way where it must.

Levels, after Levihn, Scholz and Stilman (2012), Hierarchical decision theoretic
planning for navigation among movable obstacles:

1. Regions of free space for the robot (`planning.regions`). If the goal is in its own,
   it goes there on the shortest way.
2. Else trials: for each thing that alone keeps two regions apart, the probability and
   the cost of moving it so that they join (`manipulation`), and the order in which to
   try them (`planning.trials`). Work is linear in the number of things, and what has
   not changed is not worked out again.
3. The first of that order: go to the grasp, hold, push and plan anew after each push,
   on what was learnt from it, until the way is open or hope is lost.

A test push, at the grasp that is nearest, comes first where finding out what a thing is
pays for itself. How agents differ is in `Character`.
"""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from boomdp_jax.agents.manipulation import (
    NOT_OPENED,
    PUSH_SECONDS,
    Ground,
    attempt,
    grasp_sites,
    ground_of,
)
from boomdp_jax.agents.namo_sites import Site, on_the_way
from boomdp_jax.core.arrays import Key
from boomdp_jax.envs.free_space import FreeSpace, distance_to, pose_table
from boomdp_jax.envs.namo import REACH
from boomdp_jax.envs.namo_room import Room
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief
from boomdp_jax.planning.regions import Ways, label_regions, ways_from
from boomdp_jax.planning.trials import (
    Trial,
    best_order,
    region_values,
    worth_of_test,
)

COVERED = -1
"""Region of the goal, while a thing stands on it."""
GIVE_UP = 600.0
"""Cost of not getting to the goal [s]."""
_LEAST_CHANCE = 0.01
"""That a thing can be moved although no plan was found: plans look some seconds ahead
and from a few grasps."""
_NUM_GRASPS = 4
"""Tried for each thing and pair of regions."""
_LEAST_REGION = 6
"""Cells of a region that is worth going through."""
_NEAR = 0.6
"""How far the robot may be from a free cell, since it stands at something [m]."""


class Character(NamedTuple):
    """What sets agents apart."""

    name: str
    learns: bool
    """Whether pushes change what it believes."""
    has_tests: bool = False
    """Whether it may push a thing just to find out what it is."""
    picks_lightest: bool = False
    """Whether it takes the lightest thing, whatever that promises."""
    moves_things: bool = True


@runtime_checkable
class Believer(Protocol):
    """What an agent believes of things."""

    def belief(self, thing: int) -> Belief:
        """Hypotheses about a thing."""
        ...

    def version(self, thing: int) -> int:
        """A number that changes when what is believed of it does."""
        ...

    def scene(self, thing: int) -> Scene:
        """The thing alone."""
        ...

    def mass(self, thing: int) -> float:
        """Expected [kg]."""
        ...


class Choice(NamedTuple):
    """What to do next, and why."""

    trial: Trial | None
    """None: nothing is worth trying."""
    is_test: bool
    place: np.ndarray
    """Of the robot's middle, in the grasp [m]."""
    ground: Ground | None
    ways: Ways
    goal_region: int
    labels: np.ndarray
    trials: tuple[Trial, ...]
    """All that were weighed, from the robot's own region."""


class NamoPlanner:
    """Plans of one robot in one room; remembers what has not changed."""

    def __init__(self, room: Room, character: Character, believer: Believer):
        """Begin in a room, on what is believed of it."""
        self.room, self.character = room, character
        self.believer = believer
        self.space = FreeSpace(room)
        self.goal_cell = self.space.grid.cell(np.asarray(room.goal))
        self._grounds: dict = {}
        self._attempts: dict = {}

    def labels(
        self, poses: Float[np.ndarray, "thing 3"]
    ) -> tuple[np.ndarray, Bool[np.ndarray, "x y"]]:
        """Regions, and free cells, with things at some poses."""
        free = self.space.free(poses)
        return label_regions(free)[0], free

    def region_at(
        self, labels: np.ndarray, place: Float[np.ndarray, "2"]
    ) -> tuple[int, np.ndarray]:
        """The region of a place, or the nearest one, and its cell there.

        Zero, if there is none near.
        """
        away = np.linalg.norm(self.space.places - np.asarray(place), axis=-1)
        away = np.where(labels > 0, away, np.inf)
        cell = np.array(np.unravel_index(np.argmin(away), away.shape))
        if away[tuple(cell)] > _NEAR:
            return 0, cell
        return int(labels[tuple(cell)]), cell

    def choose(
        self,
        key: Key,
        state: State,
        robot: Float[np.ndarray, "2"],
        avoided: frozenset[int] = frozenset(),
        tested: frozenset[int] = frozenset(),
    ) -> Choice:
        """What to do from where things and the robot are.

        Args:
            key: random key.
            state: as read.
            robot: its middle [m].
            avoided: things that are not to be tried now.
            tested: things that have had a test push, and told what one tells.
        """
        num = self.room.num_things
        poses = np.asarray(state.pose, float)[:num]
        labels, free = self.labels(poses)
        here, cell = self.region_at(labels, robot)
        if here == 0:
            # It is wedged in; where it stands is a region by itself.
            inside = self.space.open
            cell = self.cells_of(np.asarray(robot, float)[None], inside)[0][0]
            here = int(labels.max()) + 1
            labels, free = labels.copy(), free.copy()
            labels[tuple(cell)], free[tuple(cell)] = here, True
        # Where a thing stands on the goal, that is a region by itself.
        goal = int(labels[tuple(self.goal_cell)]) or COVERED
        ways = ways_from(self.space.grid, free, cell)
        nothing = Choice(
            None, False, np.asarray(robot), None, ways, goal, labels, trials=()
        )
        if here in (0, goal) or not self.character.moves_things:
            return nothing
        found, places, grounds = [], {}, {}
        for site in on_the_way(self._sites(poses, labels, here), here, goal):
            if site.thing in avoided:
                continue
            trial, place, ground = self._trial(
                key, state, labels, ways, here, site, np.asarray(robot, float)
            )
            if trial is not None:
                found.append(trial)
                places[trial], grounds[trial] = place, ground
        if not found:
            return nothing
        values = region_values(found, goal, GIVE_UP)
        own = tuple(trial for trial in found if trial.start == here)
        order = best_order(own, values, GIVE_UP)
        if not order.trials:
            return nothing._replace(trials=own)
        trial, is_test = order.trials[0], False
        if self.character.picks_lightest:
            able = [t for t in own if t.probability > 0.0]
            trial = min(able, key=lambda t: self.believer.mass(t.thing))
        elif self.character.has_tests:
            worth = [
                -math.inf
                if one.thing in tested
                else worth_of_test(own, one, values, GIVE_UP)
                for one in order.trials
            ]
            best = int(np.argmax(worth))
            if worth[best] > 0.0:
                trial, is_test = order.trials[best], True
        place = places[trial][1 if is_test else 0]
        return Choice(
            trial, is_test, place, grounds[trial], ways, goal, labels, trials=own
        )

    def push(
        self,
        key: Key,
        choice: Choice,
        state: State,
        robot: Float[np.ndarray, "2"],
    ) -> tuple[float, np.ndarray]:
        """The next push of a thing that is held.

        Args:
            key: random key.
            choice: what is being done.
            state: as read.
            robot: its middle [m].

        Returns:
            Probability that pushing on opens the way, and the drive `[3]` [N, N, N m].
        """
        assert choice.trial is not None
        assert choice.ground is not None
        thing = choice.trial.thing
        lone = State(state.pose[thing][None], state.twist[thing][None])
        found = attempt(
            key,
            self.believer.scene(thing),
            choice.ground,
            self.believer.belief(thing),
            lone,
            np.asarray(robot, float)[None],
            self.room.robot,
            np.zeros(1),
        )
        return found.probability, found.action

    def _sites(self, poses: np.ndarray, labels: np.ndarray, here: int) -> list[Site]:
        """Things that alone keep two regions apart, both ways."""
        sizes = np.bincount(labels.reshape(-1))
        # However small they are, the robot is in one of them and has to get to one.
        for region in (here, labels[tuple(self.goal_cell)]):
            sizes[region] = max(sizes[region], _LEAST_REGION)
        found = []
        for thing in range(self.room.num_things):
            joined, num = label_regions(self.space.free(poses, without=thing))
            at_goal = joined[tuple(self.goal_cell)]
            for region in range(1, num + 1):
                parts = np.unique(labels[joined == region])
                parts = [p for p in parts if p > 0 and sizes[p] >= _LEAST_REGION]
                if region == at_goal and not labels[tuple(self.goal_cell)]:
                    found += [Site(thing, int(one), COVERED) for one in parts]
                found += [
                    Site(thing, int(one), int(other))
                    for one in parts
                    for other in parts
                    if one != other
                ]
        return found

    def _trial(
        self,
        key: Key,
        state: State,
        labels: np.ndarray,
        ways: Ways,
        here: int,
        site: Site,
        robot: np.ndarray,
    ) -> tuple[Trial | None, tuple[np.ndarray, np.ndarray], Ground | None]:
        """What a thing promises between two regions; its best and nearest grasp."""
        thing, num = site.thing, self.room.num_things
        poses = np.asarray(state.pose, float)[:num]
        sites = grasp_sites(self.space, thing, poses[thing])
        cells, is_there = self.cells_of(sites, labels == site.start)
        outline = self.room.things[thing].outline
        away = float(distance_to(robot[None], outline, poses[thing])[0])
        gap = away - self.room.robot.radius
        if site.start == here and gap < REACH:
            # It may hold the thing where it stands.
            sites = np.concatenate([sites, robot[None]])
            cells = np.concatenate([cells, [ways.start]])
            is_there = np.append(is_there, True)
        none = np.zeros(2), np.zeros(2)
        if not is_there.any():
            return None, none, None
        places, cells = sites[is_there], cells[is_there]
        lengths = ways.length[cells[:, 0], cells[:, 1]]
        if site.start != here:
            # Where the robot will come from is not known yet.
            lengths = np.zeros(len(places))
        seconds = 1.5 * lengths / self.room.robot.speed
        kept = np.unique(np.linspace(0, len(places) - 1, _NUM_GRASPS).round(), axis=0)
        kept = kept.astype(int)
        # With what is told again and again nothing is worked out anew.
        ground = self._ground(thing, poses, labels, site)
        where = tuple(np.round(poses[thing] / 0.02).astype(int))
        seen = is_there.tobytes(), site.start == here
        name = (thing, self.believer.version(thing), where, id(ground), *seen)
        if name not in self._attempts:
            lone = State(state.pose[thing][None], 0.0 * state.twist[thing][None])
            self._attempts[name] = attempt(
                key,
                self.believer.scene(thing),
                ground,
                self.believer.belief(thing),
                lone,
                places[kept],
                self.room.robot,
                seconds[kept],
            )
        found = self._attempts[name]
        grasp, nearest = kept[found.grasp], int(np.argmin(seconds))
        # Of a few draws none may move it although it can be moved.
        num_draws = self.believer.belief(thing).num_hypotheses
        probability, cost = found.probability, found.cost
        if num_draws > 1:
            probability = (num_draws * probability + 0.5) / (num_draws + 1.0)
        probability = max(probability, _LEAST_CHANCE)
        if not math.isfinite(cost):
            cost = NOT_OPENED
        trial = Trial(
            thing=thing,
            start=site.start,
            end=site.end,
            probability=probability,
            cost=float(seconds[grasp]) + cost,
            loss=2.0 * float(seconds[grasp]) + 2.0 * PUSH_SECONDS,
            test=2.0 * float(seconds[nearest]) + PUSH_SECONDS,
        )
        return trial, (places[grasp], places[nearest]), ground

    def cells_of(
        self, places: Float[np.ndarray, "site 2"], region: Bool[np.ndarray, "x y"]
    ) -> tuple[np.ndarray, Bool[np.ndarray, " site"]]:
        """Cells of a region nearest to some places, and whether they are at them.

        Places next to a thing are free by less than half a cell.
        """
        inside = np.argwhere(region)
        away = self.space.grid.place(inside)[None] - places[:, None]
        away = np.linalg.norm(away, axis=-1)
        near = np.argmin(away, axis=1)
        least = away[np.arange(len(places)), near]
        return inside[near], least < self.space.grid.spacing

    def _ground(
        self, thing: int, poses: np.ndarray, labels: np.ndarray, site: Site
    ) -> Ground:
        """Maps for moving a thing; the same object as long as nothing else moved."""
        others = np.delete(np.round(poses / 0.02).astype(int), thing, axis=0)
        start, end = labels == site.start, labels == site.end
        keep = np.zeros_like(start)
        keep[tuple(self.goal_cell)] = True
        if site.end == COVERED:
            end = keep
        # Regions change their numbers, and their cells next to the thing; what they
        # are without it does not.
        base, _ = label_regions(self.space.free(poses, without=thing))
        ends = np.unique(base[start]).tobytes(), np.unique(base[end]).tobytes()
        corner = _first_cell(start), _first_cell(end)
        own = np.round((poses[thing]) / 0.5).astype(int).tobytes()
        name = (thing, others.tobytes(), own, ends, corner)
        if name not in self._grounds:
            table = pose_table(self.space, thing, poses, start, end, keep=keep)
            free = self.space.free(poses, without=thing)
            self._grounds[name] = ground_of(self.space, table, free)
        return self._grounds[name]


def _first_cell(cells: np.ndarray) -> int:
    return int(np.argmax(cells))
