"""Velocities that poses contradict: which recordings are named, and which are not."""

import copy
import functools

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.doubts.pose_velocity_agreement import (
    pose_velocity_notes,
    pose_velocity_reasons,
)
from boomdp_jax.inference.kinds.verdict import with_kind_doubts
from tests.inference.made_posteriors import table_posterior
from tests.inference.recordings import DT, INERTIA, MASS, NOISE, box_scene
from tests.inference.residual_worlds import dry, nothing_else, viscous

NOISES = {
    "exact": 0.0 * NOISE,
    "usual": NOISE,
    "poses noisy": np.repeat([5e-3, 5e-4], 3),
    "velocities noisy": np.repeat([1e-5, 5e-2], 3),
}
INVERSE = np.array([1.0 / MASS, 1.0 / MASS, 1.0 / INERTIA])


def states_of(rng, dt, force=nothing_else, *, substeps=40, hold=5):
    """States of a pushed box, `[instant, 6]`; one step for each of `dt` [s].

    A simulator's way: velocities are changed first, and move the box.
    """
    wrench = rng.normal(size=(-(-len(dt) // hold), 3)) * [15.0, 15.0, 2.0]
    now, states = np.append(rng.normal(size=3), np.zeros(3)), []
    for step, push in zip(dt, np.repeat(wrench, hold, axis=0)[: len(dt)], strict=True):
        states.append(now.copy())
        for _ in range(substeps):
            now[3:] += step / substeps * INVERSE * force(now, push)
            now[:3] += step / substeps * now[3:]
    return np.array([*states, now])


def read(rng, states, noise=NOISE):
    return states + noise * rng.normal(size=states.shape)


_scene = functools.cache(box_scene)


def reasons_of(states, dt=DT, **options):
    """Reasons for doubt; where there are none, notes."""
    rows = states[:, None]
    action = np.zeros((len(rows) - 1, 1, 3))
    history = make_history(rows[:-1], action, rows[1:], dt, **options)
    reasons = pose_velocity_reasons(_scene(), history)
    notes = pose_velocity_notes(_scene(), history)
    assert not (reasons and notes)
    return reasons + notes


def pushed(seed, num=60, force=nothing_else, noise=NOISE, **options):
    states, rng = _moved(seed, num, force, **options)
    return read(copy.deepcopy(rng), states, noise)


@functools.cache
def _moved(seed, num, force, **options):
    """States, and the generator as it then is: many tests read one motion anew."""
    rng = np.random.default_rng(seed)
    return states_of(rng, np.full(num, DT), force, **options), rng


def differenced(states, smoothing=1.0):
    """With velocities that are differences of the poses up to then."""
    slope = np.diff(states[:, :3], axis=0) / DT
    velocity = [slope[0], slope[0]]
    for each in slope[1:]:
        velocity.append(velocity[-1] + smoothing * (each - velocity[-1]))
    return np.concatenate([states[:, :3], velocity], axis=1)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("force", [nothing_else, viscous(6.0), dry(6.0)])
@pytest.mark.parametrize("num", [8, 20, 60, 200])
def test_velocities_that_are_right_are_not_named(noise, force, num):
    for seed in range(5):
        states = pushed(seed, num, force, NOISES[noise])
        assert reasons_of(states) == []


@pytest.mark.parametrize("noise", NOISES)
def test_a_box_at_rest_is_not_named(noise):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert reasons_of(read(rng, np.zeros((60, 6)), NOISES[noise])) == []


@pytest.mark.parametrize("noise", NOISES)
def test_a_box_between_two_walls_is_not_named(noise):
    """It hits one every few rows, in the midst of them."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        now, states = np.array([0.0, 0.0, 0.0, 2.0, 0.4, 1.0]), []
        for _ in range(61):
            states.append(now.copy())
            for _ in range(40):
                now[:3] += DT / 40 * now[3:]
                if abs(now[0]) > 0.15 and now[0] * now[3] > 0.0:
                    now[3], now[5] = -now[3], rng.normal()
        assert reasons_of(read(rng, np.array(states), NOISES[noise])) == []


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("smoothing", [1.0, 0.5])
@pytest.mark.parametrize("noise", ["exact", "usual"])
def test_differences_of_poses_are_named(seed, smoothing, noise):
    states = differenced(pushed(seed, noise=NOISES[noise]), smoothing)
    (reason,) = reasons_of(states)
    assert reason.startswith("box: velocities and angular velocities look like")
    assert reason.endswith("leave velocities out (NaN)")
    if smoothing == 1.0:
        assert "(they fit about 10 ms earlier)" in reason


@pytest.mark.parametrize("seed", range(5))
def test_differences_to_both_sides_are_in_order(seed):
    """What is smoothed but not late does not mislead."""
    states = pushed(seed)
    states[1:-1, 3:] = (states[2:, :3] - states[:-2, :3]) / (2.0 * DT)
    assert reasons_of(states[1:-1]) == []


@pytest.mark.parametrize("seed", range(5))
def test_single_steps_of_a_simulator_are_named(seed):
    (reason,) = reasons_of(pushed(seed, noise=0.1 * NOISE, substeps=1))
    assert "or rows are few steps of a simulator (they fit about" in reason
    assert 8.0 < float(reason.split("about ")[1].split(" ms")[0]) < 13.0
    for noise in NOISES.values():
        assert reasons_of(pushed(seed, noise=noise, substeps=10)) == []


def test_an_angle_alone_is_named():
    states = pushed(0)
    states[:, 5] = differenced(states)[:, 5]
    (reason,) = reasons_of(states)
    assert reason.startswith("box: angular velocities look like differences of angles")


@pytest.mark.parametrize("seed", range(5))
def test_ratios_that_are_not_one_are_named(seed):
    states = pushed(seed)
    (both, angle) = reasons_of(states, 0.5 * DT)
    assert both.startswith("box: positions change 2 times as much in a step as velo")
    assert angle.startswith("box: angles change 2 times as much in a step as angular")
    in_degrees = states * [1.0, 1.0, 180.0 / np.pi, 1.0, 1.0, 1.0]
    (reason,) = reasons_of(in_degrees)
    assert "angles change 57." in reason
    assert "expected radians, seconds, and 'dt' as long as the step" in reason
    in_millimetres = states * [1e3, 1e3, 1.0, 1.0, 1.0, 1.0]
    (reason,) = reasons_of(in_millimetres)
    assert "expected metres" in reason
    in_degrees_a_second = states * [1.0, 1.0, 1.0, 1.0, 1.0, 180.0 / np.pi]
    (reason,) = reasons_of(in_degrees_a_second)
    assert "angles change 0.01" in reason


@pytest.mark.parametrize("seed", range(5))
def test_velocities_that_nobody_filled_in_are_named(seed):
    """But not those of a body at rest, whose poses are noise about one place."""
    states = pushed(seed) * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    (linear, angular) = reasons_of(states)
    expected = "are zero in all 60 rows in which positions change; expected NaN where"
    assert linear.startswith(f"box: velocities {expected}")
    assert angular.startswith("box: angular velocities are zero in all 60 rows")
    rng = np.random.default_rng(seed)
    resting = read(rng, np.zeros((200, 6))) * [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert reasons_of(resting) == []


def test_wrapped_angles_are_in_order():
    states = pushed(3, 200, noise=0.1 * NOISE)
    states[:, 2] += 40.0 * DT * np.arange(len(states))
    states[:, 5] += 40.0
    assert reasons_of(states) == []
    states[:, 2] = np.angle(np.exp(1j * states[:, 2]))
    assert reasons_of(states) == []


def jittered(seed, sd, noise):
    """Rows of uneven steps, and their lengths [s]."""
    rng = np.random.default_rng(seed)
    instants = DT * np.arange(101) + sd * rng.normal(size=101)
    dt = np.maximum(np.diff(instants), 1e-3)
    return read(rng, states_of(rng, dt), noise), dt


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", ["exact", "usual"])
def test_uneven_steps_told_as_even_are_named(seed, noise):
    states, dt = jittered(seed, 4e-3, NOISES[noise])
    (reason,) = reasons_of(states)
    assert "by more the faster it moves, as if lengths of steps varied by" in reason
    about = float(reason.split("about ")[1].split(" ms")[0])
    assert 0.5 < about / (1e3 * dt.std()) < 2.0
    assert reasons_of(states, dt) == []


def test_poses_that_are_rounded_to_more_than_a_step_are_no_jitter():
    for seed in range(10):
        states = 0.05 * pushed(seed, 200, viscous(6.0), NOISES["exact"])
        states[:, :3] = np.round(states[:, :3] / 5e-3) * 5e-3
        assert reasons_of(states) == []


def test_going_round_fast_is_no_other_unit():
    """The way is shorter than the velocities at both ends say."""
    rng = np.random.default_rng(0)
    for rate in (20.0, 30.0):
        spin = rate * (1.0 + 0.1 * rng.standard_normal(61))
        angle = np.append(0.0, np.cumsum(0.5 * (spin[1:] + spin[:-1]) * DT * 2.5))
        around = 0.3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        along = spin[:, None] * around[:, ::-1] * [-1.0, 1.0]
        states = np.column_stack([around, angle, along, spin])
        assert reasons_of(read(rng, states), 2.5 * DT) == []


def test_what_was_not_read_is_not_compared():
    states = differenced(pushed(0))
    poses = np.array(states)
    poses[:, 3:] = np.nan
    assert reasons_of(poses) == []
    in_turn = np.array(states)
    in_turn[::2, 3:] = np.nan
    assert reasons_of(in_turn) == []
    # Rows that are masked, and runs of few rows each.
    assert reasons_of(states[:5], capacity=64) == []
    episode = np.arange(60) // 3
    assert len(reasons_of(states, episode=episode)) == 1


def test_each_body_has_its_own_line_and_kinds_are_doubted_too():
    posterior = table_posterior(8, diagnostics={"ok": True, "reasons": []})
    rows = differenced(pushed(0))[:, None]
    action = np.zeros((len(rows) - 1, 1, 3))
    history = make_history(rows[:-1], action, rows[1:], DT)
    doubted = with_kind_doubts(posterior, history, [], None).diagnostics
    assert not doubted["ok"]
    name = posterior.spec.names[0]
    assert doubted["reasons"][0].startswith(f"{name}: velocities and angular veloci")
    at_rest = with_kind_doubts(posterior, history, [0], None).diagnostics
    assert at_rest["reasons"] == []
