"""Motions planned by RRT-Connect of OMPL, in a space of configurations.

Two trees of random branches grow towards each other from start and goals; the motion
found is then shortened by random short cuts. To be preferred to a search on a grid from
four or five dimensions on; of narrow passages it takes the longer the narrower they
are, and where there is no way it only gives up.

Kuffner and LaValle (2000), RRT-Connect: an efficient approach to single-query path
planning; Sucan, Moll and Kavraki (2012), The open motion planning library.
"""

import importlib
import itertools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from boomdp_jax.planning.motion import IsFree, edge_points

_MAX_SEED = 2**32 - 1


def plan_motion(
    seed: int,
    start: Float[np.ndarray, " coordinate"],
    goals: Float[np.ndarray, "goal _"],
    is_free: IsFree,
    lower: Float[np.ndarray, " _"],
    upper: Float[np.ndarray, " _"],
    *,
    levers: Float[np.ndarray, " _"],
    resolution: float,
    is_periodic: Bool[np.ndarray, " _"] | None = None,
    step: float = 0.5,
    max_iterations: int = 5000,
) -> Float[np.ndarray, "point coordinate"] | None:
    """Find a motion from the start to one of the goals (`planning.PlanMotion`).

    The seed of OMPL's own random numbers is set, for the process: motions of different
    threads at once are not reproducible.

    Args:
        seed: equal ones give equal motions.
        start: configuration.
        goals: configurations, any of which will do; those that are not free are left
            out.
        is_free: which of some configurations are free of collision.
        lower: least of each coordinate.
        upper: largest of each coordinate; of a periodic one both are ignored.
        levers: metres per unit of each coordinate; distances are sums of these times
            changes.
        resolution: between configurations that are checked [m].
        is_periodic: which coordinates are angles of a full turn; none: no one.
        step: longest branch that is added at once [m].
        max_iterations: branches that are tried before the search gives up.

    Returns:
        Corners of the motion, straight in between, from start to goal, angles not
        wrapped; None if none was found, the start is not free, or no goal is.

    Raises:
        ImportError: OMPL is not installed.
        ValueError: numbers of coordinates that differ, a seed out of range, bounds that
            cross, or a length or count that is not positive.
    """
    num = start.shape[0]
    periodic = np.zeros(num, bool) if is_periodic is None else is_periodic
    _check_sizes(num, goals, (lower, upper, levers, periodic))
    _check_numbers(seed, lower, upper, periodic, (resolution, step, max_iterations))
    space = _Space(_modules(), lower, upper, levers, periodic, resolution)
    goals = goals[_within(space, goals) & is_free(goals)] if len(goals) else goals
    if len(goals) == 0 or not (_within(space, start[None]) & is_free(start[None]))[0]:
        return None
    util = space.library.util
    level = util.getLogLevel()
    # Seeding anew is a fault to OMPL, as generators that exist go on as they are; all
    # of this search's are made below.
    util.setLogLevel(util.LOG_NONE)
    try:
        util.RNG.setSeed(seed + 1)
        corners = _search(space, start, goals, is_free, step, max_iterations)
    finally:
        util.setLogLevel(level)
    return None if corners is None else _unwrapped(space, start, corners)


class _Library(NamedTuple):
    base: Any
    geometric: Any
    util: Any


class _Space(NamedTuple):
    library: _Library
    lower: Float[np.ndarray, " coordinate"]
    upper: Float[np.ndarray, " coordinate"]
    levers: Float[np.ndarray, " coordinate"]
    is_periodic: Bool[np.ndarray, " coordinate"]
    resolution: float


def _modules() -> _Library:
    try:
        # Looked up by name, since it is an extra.
        parts = [importlib.import_module(f"ompl.{name}") for name in _Library._fields]
    except ImportError as error:
        raise ImportError(
            "plan_motion: expected OMPL, got none; pip install 'boomdp_jax[motion]'"
        ) from error
    return _Library(*parts)


def _search(
    space: _Space, start: Any, goals: Any, is_free: IsFree, step: float, most: int
) -> np.ndarray | None:
    """Corners of the shortened motion, periodic coordinates wrapped."""
    base, geometric, _ = space.library
    states = _states(space)
    information = base.SpaceInformation(states)

    class Edges(base.MotionValidator):
        """Checks a whole edge in one call."""

        def checkMotion(self, first: Any, second: Any) -> bool:  # noqa: N802
            a, b = _read(space, first), _read(space, second)
            b = a + _change(space, a, b)
            return bool(
                is_free(edge_points(a, b, space.levers, space.resolution)).all()
            )

    def is_valid(state: Any) -> bool:
        return bool(is_free(_read(space, state)[None])[0])

    information.setStateValidityChecker(is_valid)
    edges = Edges(information)
    information.setMotionValidator(edges)
    information.setup()

    def state_of(configuration: np.ndarray) -> Any:
        state = states.allocState()
        _write(space, state, configuration)
        return state

    problem = base.ProblemDefinition(information)
    problem.addStartState(state_of(start))
    goal = base.GoalStates(information)
    for configuration in goals:
        goal.addState(state_of(configuration))
    problem.setGoal(goal)
    planner = geometric.RRTConnect(information)
    planner.setRange(step)
    planner.setProblemDefinition(problem)
    planner.setup()
    left = iter(range(most))
    # By count and not by time, so that a busy machine finds the same.
    done = base.PlannerTerminationCondition(lambda: next(left, None) is None)
    if not planner.solve(done) or not problem.hasExactSolution():
        return None
    path = problem.getSolutionPath()
    simplifier = geometric.PathSimplifier(information)
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path)
    simplifier.reduceVertices(path)
    return np.stack([_read(space, state) for state in path.getStates()])


def _states(space: _Space) -> Any:
    """One subspace for each coordinate, weighed by its lever."""
    base = space.library.base
    states = base.CompoundStateSpace()
    for lower, upper, lever, is_periodic in zip(*space[1:5], strict=True):
        part = base.SO2StateSpace() if is_periodic else base.RealVectorStateSpace(1)
        if not is_periodic:
            part.setBounds(float(lower), float(upper))
        states.addSubspace(part, float(lever))
    return states


def _read(space: _Space, state: Any) -> np.ndarray:
    return np.array(
        [
            state[i].value if is_periodic else state[i][0]
            for i, is_periodic in enumerate(space.is_periodic)
        ]
    )


def _write(space: _Space, state: Any, configuration: np.ndarray) -> None:
    for i, is_periodic in enumerate(space.is_periodic):
        if is_periodic:
            state[i].value = float(_wrapped(configuration[i]))
        else:
            state[i][0] = float(configuration[i])


def _change(space: _Space, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The shorter way round of periodic coordinates."""
    change = end - start
    return np.where(space.is_periodic, _wrapped(change), change)


def _wrapped(angle: Any) -> Any:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def _unwrapped(space: _Space, start: np.ndarray, corners: np.ndarray) -> np.ndarray:
    changes = [_change(space, a, b) for a, b in itertools.pairwise(corners)]
    return np.cumsum([start, *changes], axis=0)


def _within(space: _Space, configurations: np.ndarray) -> np.ndarray:
    inside = (configurations >= space.lower) & (configurations <= space.upper)
    return np.all(inside | space.is_periodic, axis=1)


def _check_sizes(num: int, goals: np.ndarray, others: tuple) -> None:
    for name, got in zip(
        ("goals", "lower", "upper", "levers", "is_periodic"),
        (goals.shape[1], *(len(other) for other in others)),
        strict=True,
    ):
        if got != num:
            raise ValueError(
                f"{name}: expected {num} coordinates like start, got {got}"
            )


def _check_numbers(
    seed: int, lower: Any, upper: Any, is_periodic: Any, positive: tuple
) -> None:
    if not 0 <= seed < _MAX_SEED:
        raise ValueError(
            f"seed: expected a number from 0 to {_MAX_SEED - 1}, got {seed}"
        )
    if np.any(~(lower < upper) & ~is_periodic):
        raise ValueError(f"lower: expected less than upper {upper}, got {lower}")
    names = ("resolution", "step", "max_iterations")
    for name, number in zip(names, positive, strict=True):
        if not number > 0:
            raise ValueError(f"{name}: expected a number above 0, got {number!r}")
