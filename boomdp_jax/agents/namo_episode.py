"""One robot in one room, from the start to the goal or to giving up."""

import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.agents.namo_agent import (
    COVERED,
    Character,
    Choice,
    NamoPlanner,
)
from boomdp_jax.agents.namo_hand import Hand
from boomdp_jax.core.arrays import Key
from boomdp_jax.core.thread_precision import in_this_precision
from boomdp_jax.envs.namo import (
    NOBODY,
    NamoState,
    NamoWorld,
    grasped,
    is_at_goal,
    make_world,
    with_delay,
)
from boomdp_jax.envs.namo_drive import (
    NUM_STEPS,
    Command,
    Driven,
    drive,
    going,
    pushing,
)
from boomdp_jax.envs.namo_room import TIME_STEP, Room
from boomdp_jax.models.room_belief import RoomBelief
from boomdp_jax.physics.state import State

LONGEST = 150.0
"""Seconds of simulated time after which an episode is over."""
_MOST_PUSHES = 16
"""Of one attempt."""
_STUCK = 3
"""Pushes in a row that move nothing, after which an attempt is broken off."""
_STIR = 0.03
"""What counts as moving [m]."""
_MOST_BRAKES, _SLOW = 4, 0.15
"""Commands to brake with, and the speed at which it lets go [m/s]."""
_NEAR = 0.02
"""How near the robot has to come to its grasp [m]."""

_COMPILER = ThreadPoolExecutor(max_workers=1)
_grasped = jax.jit(grasped)
_is_at_goal = jax.jit(is_at_goal)


class Try(NamedTuple):
    """One attempt at moving a thing, or one test."""

    thing: int
    is_test: bool
    num_pushes: int
    opened: bool
    """Whether the robot's region was joined to another one then."""
    promised: float
    """Probability of that, before."""
    begin: int
    """Steps of the world since the start, when it began and when it ended."""
    end: int
    shares: tuple[dict[str, float], ...]
    """What was believed of the thing, before and after each push: share of each kind
    (`kind_shares`); empty for who has no belief."""


class NamoRecord(NamedTuple):
    """All that happened."""

    is_solved: bool
    """The robot's body is at its goal and overlaps nothing."""
    seconds: float
    """Of simulated time."""
    effort: float
    """Mean force over the greatest, times time [s]."""
    num_pushes: int
    num_wasted: int
    """Pushes of tries that opened nothing."""
    tries: tuple[Try, ...]
    poses: np.ndarray
    """True ones after each step of the world, `[time, body, 3]`."""
    decision_seconds: np.ndarray
    """Of real time, for learning and planning anew after each push or try."""
    most_force: float
    """Transmitted by the grasp [N]."""
    most_overlap: float
    """Of any two outlines [m]."""


class _Episode:
    """What goes on while the robot is at it."""

    def __init__(
        self,
        key: Key,
        room: Room,
        character: Character,
        belief: RoomBelief,
        delay: int,
    ):
        self.key, self.room, self.character = key, room, character
        self.world, start = make_world(room)
        self.state = with_delay(start, delay)
        self.delay = delay
        self.belief = belief
        self.planner = NamoPlanner(room, character, belief)
        self.read: State = self.state.physics
        self.poses = [np.asarray(self.state.physics.pose)[None]]
        self.tries: list[Try] = []
        self.seconds: list[float] = []
        self.effort = self.most_force = self.most_overlap = 0.0
        self.num_steps = 0
        self.hand = Hand(self.world, delay)
        # The world's step takes long to compile; the first plan is made meanwhile.
        nothing = pushing(jnp.zeros(3))
        self._compiled: Future | None = _COMPILER.submit(
            in_this_precision(drive), key, self.world, self.state, nothing
        )
        belief.warm_up()

    @property
    def robot(self) -> np.ndarray:
        """Where it reads itself to be."""
        return np.asarray(self.read.pose, float)[self.room.num_things, :2]

    @property
    def is_over(self) -> bool:
        """Whether time is up."""
        return self.num_steps * TIME_STEP >= LONGEST

    def split(self) -> Key:
        """A fresh key."""
        self.key, key = jax.random.split(self.key)
        return key

    def carry_out(self, command: Command) -> Driven:
        """Drive, and keep count; what was felt is that of the steps that are told."""
        if self._compiled is not None:
            self._compiled.result()
            self._compiled = None
        self.state, driven = drive(self.split(), self.world, self.state, command)
        self.read = jax.tree.map(lambda leaf: leaf[-1], driven.reading.after)
        self.poses.append(np.asarray(driven.place))
        self.effort += float(driven.effort)
        self.most_force = max(self.most_force, float(driven.force))
        self.most_overlap = max(self.most_overlap, float(driven.overlap))
        self.num_steps += NUM_STEPS
        return self.hand.paired(driven)

    def go(self, way: np.ndarray, near: float) -> bool:
        """Along a way; whether its end was reached."""
        command = going(way, self.room.robot.speed)
        length = float(np.sum(np.linalg.norm(np.diff(way, axis=0), axis=-1)))
        allowed = 2.0 * length / self.room.robot.speed + 6.0
        for _ in range(int(np.ceil(allowed / (NUM_STEPS * TIME_STEP)))):
            if np.linalg.norm(self.robot - way[-1]) < near:
                return True
            if self.is_over:
                break
            self.carry_out(command)
        return bool(np.linalg.norm(self.robot - way[-1]) < near)

    def decide(self, avoided: frozenset[int], tested: frozenset[int]) -> Choice:
        """Choose, and keep the time."""
        begin = time.perf_counter()
        choice = self.planner.choose(
            self.split(), self.read, self.robot, avoided, tested
        )
        self.seconds.append(time.perf_counter() - begin)
        return choice

    def attempt(self, choice: Choice) -> bool:
        """Go, hold and push; whether regions were joined."""
        trial = choice.trial
        assert trial is not None
        begin, shares = self.num_steps, [self.belief.shares(trial.thing)]
        region = choice.labels == trial.start
        cells, _ = self.planner.cells_of(choice.place[None], region)
        is_here = np.linalg.norm(choice.place - self.robot) < _NEAR
        way = choice.ways.path_to(choice.ways.start if is_here else cells[0])
        num_pushes, opened = 0, False
        if way is not None:
            if not is_here:
                self.go(np.concatenate([way, choice.place[None]]), _NEAR)
            self.state = _grasped(self.world, self.state, trial.thing)
            if int(self.state.held) != NOBODY:
                num_pushes, opened = self._push_on(choice, shares)
        self.state = _grasped(self.world, self.state, NOBODY)
        self.tries.append(
            Try(
                thing=trial.thing,
                is_test=choice.is_test,
                num_pushes=num_pushes,
                opened=opened,
                promised=trial.probability,
                begin=begin,
                end=self.num_steps,
                shares=tuple(shares),
            )
        )
        return opened

    def _push_on(self, choice: Choice, shares: list) -> tuple[int, bool]:
        """Push by push, learning and planning anew after each."""
        trial = choice.trial
        assert trial is not None
        num_still, begin = 0, time.perf_counter()
        for num in range(1 if choice.is_test else _MOST_PUSHES):
            hope, action = self.planner.push(
                self.split(), choice, self.read, self.robot
            )
            self.seconds.append(time.perf_counter() - begin)
            # Without a hypothesis left under which the way opens, it is broken off.
            is_stuck = num_still >= _STUCK
            if self.is_over or (num > 0 and (hope <= 0.0 or is_stuck)):
                return num, False
            before = np.asarray(self.read.pose, float)[trial.thing]
            driven = [self.carry_out(pushing(jnp.asarray(action, float)))]
            # What came of a push is seen late: it stands still until then.
            for _ in range(-(-self.delay // NUM_STEPS)):
                driven.append(self.carry_out(self._standing()))
            begin = time.perf_counter()
            after = np.asarray(self.read.pose, float)[trial.thing]
            moved = np.linalg.norm(after[:2] - before[:2])
            moved += self.room.things[trial.thing].reach * abs(after[2] - before[2])
            num_still = num_still + 1 if moved < _STIR else 0
            self._learn(trial.thing, driven)
            shares.append(self.belief.shares(trial.thing))
            if self._is_joined(choice) and self._comes_to_rest(choice):
                return num + 1, True
            if int(self.state.held) == NOBODY:
                return num + 1, False
        return (1 if choice.is_test else _MOST_PUSHES), False

    def _comes_to_rest(self, choice: Choice) -> bool:
        """Brake before letting go; whether the way is still open then."""
        for _ in range(_MOST_BRAKES):
            twist = np.asarray(self.read.twist, float)[self.room.num_things]
            if np.hypot(twist[0], twist[1]) < _SLOW or int(self.state.held) == NOBODY:
                break
            self.carry_out(self._standing())
        return self._is_joined(choice)

    def _standing(self) -> Command:
        """To stay where it is."""
        return going(self.robot[None], self.room.robot.speed)

    def _learn(self, thing: int, driven: list[Driven]) -> None:
        """From the last commands."""
        if not self.character.learns:
            return
        rows = self.hand.rows(thing, driven)
        if rows:
            self.belief.update(self.split(), thing, rows)

    def _is_joined(self, choice: Choice) -> bool:
        """Whether the robot can get from where it is to where it wanted to."""
        trial = choice.trial
        assert trial is not None
        num = self.room.num_things
        poses = np.asarray(self.read.pose, float)[:num]
        labels, _ = self.planner.labels(poses)
        here, _ = self.planner.region_at(labels, self.robot)
        goal = labels[tuple(self.planner.goal_cell)]
        if trial.end == COVERED:
            return here > 0 and goal == here
        aimed = (choice.labels == trial.end) & (labels > 0)
        return here > 0 and goal > 0 and bool(np.any(labels[aimed] == here))


def run_namo(
    key: Key,
    room: Room,
    character: Character,
    belief: RoomBelief,
    *,
    delay: int = 0,
) -> NamoRecord:
    """Let a robot get to its goal.

    Args:
        key: random key; all that happens is decided by it.
        room: the room, the truth included.
        character: what sort of agent it is.
        belief: what it believes of the room's things; changed by what it learns.
        delay: of the poses and twists that it reads, in steps of the world; the hand
            feels at once. It knows of it, and waits after each push for what came of
            it.

    Returns:
        What happened.

    Raises:
        ValueError: a negative delay.
    """
    episode = _Episode(key, room, character, belief, delay)
    avoided: set[int] = set()
    tested: set[int] = set()
    count = np.zeros(room.num_things, int)
    while not episode.is_over:
        choice = episode.decide(frozenset(avoided), frozenset(tested))
        labels = choice.labels
        here, _ = episode.planner.region_at(labels, episode.robot)
        if here == choice.goal_region and here > 0:
            way = choice.ways.path_to(
                episode.planner.space.grid.cell(np.asarray(room.goal))
            )
            if way is None:
                break
            if episode.go(np.concatenate([way, np.asarray(room.goal)[None]]), 0.05):
                break
            continue
        if choice.trial is None:
            # What did not work may work yet, if nothing else is left.
            again = {t for t in avoided if count[t] < 3}
            if not again:
                break
            avoided -= again
            continue
        thing = choice.trial.thing
        opened = episode.attempt(choice)
        if choice.is_test:
            tested.add(thing)
        if opened:
            avoided.clear()
        elif not choice.is_test or not episode.tries[-1].num_pushes:
            count[thing] += 1
            avoided.add(thing)
    return _record(episode, episode.world, episode.state)


def _record(episode: _Episode, world: NamoWorld, state: NamoState) -> NamoRecord:
    tries = tuple(episode.tries)
    return NamoRecord(
        is_solved=bool(_is_at_goal(world, state)),
        seconds=episode.num_steps * TIME_STEP,
        effort=episode.effort,
        num_pushes=sum(one.num_pushes for one in tries),
        num_wasted=sum(one.num_pushes for one in tries if not one.opened),
        tries=tries,
        poses=np.concatenate(episode.poses),
        decision_seconds=np.array(episode.seconds),
        most_force=episode.most_force,
        most_overlap=episode.most_overlap,
    )
