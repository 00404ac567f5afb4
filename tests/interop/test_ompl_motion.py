"""Motions by OMPL, in spaces where what is free is plain."""

import importlib

import numpy as np
import pytest

from boomdp_jax.interop import plan_motion
from boomdp_jax.planning import motion_length, motion_points

LOWER, UPPER = np.array([-2.0, -2.0]), np.array([2.0, 2.0])
LEVERS = np.ones(2)
START, GOAL = np.array([-1.5, 0.0]), np.array([1.5, 0.0])


def gap_in_wall(half: float):
    """A wall across the middle of the square, with a gap at its upper end."""

    def is_free(points):
        return (np.abs(points[:, 0]) > 0.1) | (np.abs(points[:, 1] - 1.5) < half)

    return is_free


def plan(is_free, seed: int = 0, goals=GOAL[None], **options):
    pytest.importorskip("ompl")
    options = {"levers": LEVERS, "resolution": 0.02} | options
    return plan_motion(seed, START, goals, is_free, LOWER, UPPER, **options)


def test_motion_goes_through_the_gap_and_is_not_much_longer_than_it_has_to_be():
    is_free = gap_in_wall(0.1)
    for seed in range(5):
        path = plan(is_free, seed)
        np.testing.assert_allclose(path[[0, -1]], [START, GOAL])
        assert is_free(motion_points(path, LEVERS, 0.02)).all()
        # In the sum of sizes, from start to gap and on: no less.
        least = 2.0 * (1.5 + 1.4)
        assert least - 1e-9 <= motion_length(path, LEVERS) < 1.1 * least


def test_equal_seeds_give_equal_motions_and_others_give_others():
    is_free = gap_in_wall(0.1)
    first, second, again = (plan(is_free, seed) for seed in (3, 4, 3))
    np.testing.assert_array_equal(first, again)
    assert first.shape != second.shape or np.any(first != second)


def test_no_way_no_free_start_and_no_free_goal_give_none():
    assert plan(gap_in_wall(0.0), max_iterations=300) is None
    assert plan(lambda points: points[:, 0] > 0.0) is None
    assert plan(lambda points: points[:, 0] < 0.0) is None
    assert plan(gap_in_wall(0.1), goals=np.empty((0, 2))) is None
    assert plan(gap_in_wall(0.1), goals=np.array([[0.0, 5.0]])) is None


def test_one_of_several_goals_that_is_free_is_reached():
    goals = np.array([[0.0, 0.0], [-1.0, -1.0]])
    path = plan(gap_in_wall(0.0), goals=goals)
    np.testing.assert_allclose(path[-1], goals[1])


def test_angle_turns_the_shorter_way_and_is_not_wrapped():
    pytest.importorskip("ompl")
    start, goal = np.array([0.0, 3.0 + 2.0 * np.pi]), np.array([0.0, -3.0])
    path = plan_motion(
        0,
        start,
        goal[None],
        lambda points: np.ones(len(points), bool),
        LOWER,
        UPPER,
        levers=LEVERS,
        resolution=0.05,
        is_periodic=np.array([False, True]),
    )
    np.testing.assert_allclose(path[0], start)
    np.testing.assert_allclose(path[-1], [0.0, -3.0 + 4.0 * np.pi])
    assert np.ptp(path[:, 1]) < 0.3


def test_what_the_callers_function_raises_comes_through():
    def is_free(points):
        if len(points) > 1:
            raise RuntimeError("mind the gap")
        return np.ones(len(points), bool)

    with pytest.raises(RuntimeError, match="mind the gap"):
        plan(is_free)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("goals", {"goals": np.zeros((1, 3))}),
        ("levers", {"levers": np.ones(3)}),
        ("seed", {"seed": -1}),
        ("resolution", {"resolution": 0.0}),
        ("step", {"step": -0.1}),
        ("max_iterations", {"max_iterations": 0}),
    ],
)
def test_bad_input_is_refused(name, options):
    with pytest.raises(ValueError, match=f"{name}: expected"):
        plan(gap_in_wall(0.1), **options)


def test_bounds_that_cross_are_refused():
    with pytest.raises(ValueError, match="lower: expected less than upper"):
        plan_motion(
            0,
            START,
            GOAL[None],
            gap_in_wall(0.1),
            UPPER,
            LOWER,
            levers=LEVERS,
            resolution=0.1,
        )


def test_missing_library_is_named(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ImportError, match=r"boomdp_jax\[motion\]"):
        plan_motion(
            0,
            START,
            GOAL[None],
            gap_in_wall(0.1),
            LOWER,
            UPPER,
            levers=LEVERS,
            resolution=0.1,
        )
