"""Predictions of what only poses were read of: starts beside least squares."""

import dataclasses

import jax
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.posteriors.predict import predict
from boomdp_jax.inference.posteriors.prediction_starts import (
    carried_readings,
    filtered_starts,
    followed_starts,
    last_velocity,
)
from boomdp_jax.physics import empty_params
from tests.inference.made_posteriors import (
    draws_like,
    make_posterior,
    room_spec,
    table_spec,
)
from tests.inference.posteriors.test_predict import (
    DENSITY,
    DT,
    FORCE,
    MASS,
    NOISE,
    pushed_table,
)

NUM_DRAWS, NUM_ROWS = 400, 12
MOVING = np.zeros(1, bool)


def posterior(num_draws=NUM_DRAWS):
    params = draws_like(empty_params(1, density=DENSITY), num_draws)
    return make_posterior(table_spec(), params, params, noise_scale=tuple(NOISE))


def seen_by_camera(num_episodes=1, seed=0, unread=(3, 4, 5)):
    """Each instant once, no velocities; 360 rows at most, as in other tests."""
    state, action, next_state, episode = pushed_table(num_episodes, NUM_ROWS, seed)
    is_inner = episode[1:] == episode[:-1]
    next_state[:-1][is_inner] = state[1:][is_inner]
    state[..., list(unread)] = next_state[..., list(unread)] = np.nan
    return make_history(state, action, next_state, DT, episode=episode, capacity=360)


def least_squares(times, readings, rate, sd, at):
    """Place and speed at some time, and their covariance, given constant force."""
    design = np.stack([np.ones_like(times), times], axis=1)
    covariance = sd**2 * np.linalg.inv(design.T @ design)
    known = readings - 0.5 * rate * times**2
    found = covariance @ design.T @ known / sd**2
    to_then = np.array([[1.0, at], [0.0, 1.0]])
    added = np.array([0.5 * rate * at**2, rate * at])
    return to_then @ found + added, to_then @ covariance @ to_then.T


@pytest.mark.parametrize("row", [1, 7])
def test_starts_are_where_least_squares_puts_them(row):
    history = seen_by_camera()
    key = jax.random.key(0)
    starts = filtered_starts(key, posterior(), history, carried_readings(history))
    times = DT * np.arange(row + 1)
    reading = np.asarray(history.state)[: row + 1, 0, 0]
    mean, covariance = least_squares(times, reading, FORCE / MASS, NOISE[0], times[-1])
    drawn = np.asarray(starts)[:, row, 0, [0, 3]]
    sd = np.sqrt(np.diagonal(covariance))
    # A speed is within a metre a second to begin with, and its noise above a tenth.
    np.testing.assert_allclose(drawn.mean(axis=0), mean, atol=0.2 * sd.max(), rtol=0.03)
    np.testing.assert_allclose(drawn.std(axis=0), sd, rtol=0.12)
    expected = covariance[0, 1] / np.prod(sd)
    assert np.corrcoef(drawn.T)[0, 1] == pytest.approx(expected, abs=0.1)


def test_predictions_err_and_are_as_sure_as_least_squares():
    report = predict(posterior(100), seen_by_camera(30), (1, 5), num_draws=100)
    assert report["starts"] == "filtered"
    assert report["num_starts"] == {"1": 30 * 11, "5": 30 * 7}
    for horizon in (1, 5):
        variances = []
        for row in range(1, NUM_ROWS - horizon + 1):
            times = DT * np.arange(row + 1)
            _, at_row = least_squares(times, 0 * times, 0.0, NOISE[0], times[-1])
            ahead = np.array([1.0, horizon * DT])
            variances.append(NOISE[0] ** 2 + ahead @ at_row @ ahead)
        scores = report["horizons"][str(horizon)]
        found = scores["position"]
        assert found["rmse"] == pytest.approx(np.sqrt(2 * np.mean(variances)), rel=0.15)
        assert found["coverage90"] == pytest.approx(0.9, abs=0.04)
        expected = -0.5 * np.mean(np.log(2 * np.pi * np.array(variances))) - 0.5
        assert found["log_score"] == pytest.approx(expected, abs=0.15)
        assert found["baseline_rmse"] > 1.5 * found["rmse"]
        assert scores["velocity"]["rmse"] is None


def test_whole_readings_are_started_from_unless_told_otherwise():
    history = seen_by_camera(30, unread=())
    found = {
        starts: predict(posterior(100), history, 10, num_draws=100, starts=starts)
        for starts in ("auto", "readings", "filtered")
    }
    assert found["auto"] == found["readings"]
    assert found["readings"]["num_starts"]["10"] == 30 * 3
    # Of several readings a start is known better than of one.
    scores = {name: each["horizons"]["10"]["angle"] for name, each in found.items()}
    assert scores["filtered"]["rmse"] < 0.9 * scores["readings"]["rmse"]
    assert scores["filtered"]["coverage90"] == pytest.approx(0.9, abs=0.1)
    with pytest.raises(ValueError, match="starts: expected one of auto, readings"):
        predict(posterior(100), history, 10, starts="smoothed")


def test_poses_are_carried_on_to_rows_without_a_reading():
    history = seen_by_camera(2)
    state_mask = history.state_mask.at[2:4].set(False)
    next_state_mask = history.next_state_mask.at[1:3].set(False)
    history = dataclasses.replace(
        history, state_mask=state_mask, next_state_mask=next_state_mask
    )
    carried = carried_readings(history)
    pose = np.asarray(history.state)[..., :3]
    np.testing.assert_array_equal(carried.num[:6, 0, 0], [1, 2, 2, 2, 3, 4])
    np.testing.assert_array_equal(carried.num[12:14, 0, 0], [1, 2])
    np.testing.assert_array_equal(carried.pose[3], pose[1])
    np.testing.assert_allclose(carried.age[:5, 0, 0], [0, 0, DT, 2 * DT, 0], atol=1e-9)
    np.testing.assert_allclose(carried.rate[4], (pose[4] - pose[1]) / (3 * DT))
    foretold = last_velocity(history, 2, carried)[3, 0, :3]
    rate = (pose[1] - pose[0]) / DT
    np.testing.assert_allclose(foretold, (pose[1] + 4 * DT * rate)[0])
    rows = followed_starts(history, 3, MOVING, carried)
    np.testing.assert_array_equal(rows, [*range(1, 10), *range(13, 22)])


def test_channels_that_nobody_reads_are_not_waited_for():
    history = seen_by_camera(unread=(2, 3, 4, 5))
    rows = followed_starts(history, 1, MOVING, carried_readings(history))
    np.testing.assert_array_equal(rows, range(1, NUM_ROWS))
    nowhere = seen_by_camera(unread=(0, 3, 4, 5))
    assert len(followed_starts(nowhere, 1, MOVING, carried_readings(nowhere))) == 0


def test_angles_start_within_half_a_turn_of_the_reading_and_walls_stay():
    rng = np.random.default_rng(0)
    state = rng.normal(size=(7, 3, 6))
    state[:, 2, 2] += 2 * np.pi * np.arange(7)
    state[:, 1:, 3:] = np.nan
    history = make_history(state[:-1], np.zeros((6, 3, 3)), state[1:], DT)
    params = draws_like(empty_params(3, num_revolute=2, num_wheel=2, density=20.0), 3)
    several = make_posterior(room_spec(), params, params)
    key, carried = jax.random.key(1), carried_readings(history)
    starts = np.asarray(filtered_starts(key, several, history, carried))
    off = starts[:, 1:, 2, 2] - state[1:-1, 2, 2]
    assert np.max(np.abs(off)) < np.pi
    np.testing.assert_array_equal(
        starts[:, :, 0], np.broadcast_to(state[:-1, 0], (3, 6, 6))
    )
