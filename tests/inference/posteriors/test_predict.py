"""Predictions of a free body, whose predictive distribution is known in closed form."""

import json

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.posteriors.predict import _levels, predict
from boomdp_jax.inference.posteriors.prediction_starts import usable_starts
from boomdp_jax.physics import empty_params
from tests.inference.made_posteriors import (
    draws_like,
    make_posterior,
    room_spec,
    table_spec,
)

DT, FORCE, TORQUE, DENSITY = 0.02, 3.0, 0.2, 20.0
MASS = DENSITY * 0.6 * 0.4
NOISE = np.array([0.002, 0.003, 0.01, 0.02])
HORIZONS = (1, 10)
CAPACITY, NUM_DRAWS = 360, 100  # The same everywhere, so that one program serves all.


def free_posterior(num_draws=NUM_DRAWS):
    params = draws_like(empty_params(1, density=DENSITY), num_draws)
    return make_posterior(table_spec(), params, params, noise_scale=tuple(NOISE))


def pushed_table(num_episodes=30, num_rows=12, seed=0):
    """Constant force and torque, true motion in closed form, independent readings."""
    generator = np.random.default_rng(seed)
    time = DT * np.arange(num_rows + 1)
    inertia = MASS * (0.6**2 + 0.4**2) / 12.0
    rate = np.array([FORCE / MASS, 0.0, TORQUE / inertia])
    scale = NOISE[[0, 0, 1, 2, 2, 3]]
    tables = []
    for _ in range(num_episodes):
        start = generator.normal(size=3)
        twist = start[None] + time[:, None] * rate
        pose = time[:, None] * start + 0.5 * time[:, None] ** 2 * rate
        truth = np.concatenate([pose, twist], axis=-1)[:, None]
        reading = truth + scale * generator.normal(size=truth.shape)
        tables.append((reading[:-1], reading[1:]))
    state, next_state = (np.concatenate(part) for part in zip(*tables, strict=True))
    action = np.broadcast_to([FORCE, 0.0, TORQUE], (len(state), 1, 3))
    episode = np.repeat(np.arange(num_episodes), num_rows)
    return state, action, next_state, episode


def score(state, action, next_state, episode, num_hypotheses=NUM_DRAWS):
    history = make_history(
        state, action, next_state, DT, episode=episode, capacity=CAPACITY
    )
    posterior = free_posterior(num_hypotheses)
    return predict(posterior, history, HORIZONS, num_draws=NUM_DRAWS)


@pytest.fixture(scope="module")
def report():
    return score(*pushed_table())


def expected_sd(horizon):
    """Sd of one number's prediction error: both readings and the start's velocity."""
    position, angle, velocity, spin = NOISE
    elapsed = horizon * DT
    return {
        "position": np.sqrt(2 * position**2 + (elapsed * velocity) ** 2),
        "angle": np.sqrt(2 * angle**2 + (elapsed * spin) ** 2),
        "velocity": np.sqrt(2) * velocity,
        "spin": np.sqrt(2) * spin,
    }


@pytest.mark.slow
@pytest.mark.parametrize("horizon", HORIZONS)
def test_errors_are_those_of_the_readings(report, horizon):
    scores = report["horizons"][str(horizon)]
    for channel, sd in expected_sd(horizon).items():
        numbers = 2 if channel in ("position", "velocity") else 1
        # Overlapping windows of 30 episodes: at least 30 independent errors each.
        assert scores[channel]["rmse"] == pytest.approx(np.sqrt(numbers) * sd, rel=0.35)


@pytest.mark.slow
@pytest.mark.parametrize("horizon", HORIZONS)
def test_intervals_cover_and_the_score_is_that_of_a_normal(report, horizon):
    scores = report["horizons"][str(horizon)]
    for channel, sd in expected_sd(horizon).items():
        assert 0.8 <= scores[channel]["coverage90"] <= 0.98
        expected = -0.5 * np.log(2 * np.pi * sd**2) - 0.5
        assert scores[channel]["log_score"] == pytest.approx(expected, abs=0.35)


def test_the_baseline_misses_what_the_force_adds(report):
    elapsed = 10 * DT
    added = FORCE / MASS * elapsed
    sd = expected_sd(10)
    scores = report["horizons"]["10"]
    assert scores["velocity"]["baseline_rmse"] == pytest.approx(
        np.sqrt(added**2 + 2 * sd["velocity"] ** 2), rel=0.1
    )
    assert scores["position"]["baseline_rmse"] == pytest.approx(
        np.sqrt((0.5 * added * elapsed) ** 2 + 2 * sd["position"] ** 2), rel=0.2
    )
    assert scores["velocity"]["rmse"] < 0.3 * scores["velocity"]["baseline_rmse"]


@pytest.mark.parametrize("num_hypotheses", [1, 25])
def test_few_hypotheses_foretell_as_wide_a_spread(report, num_hypotheses):
    """They differ in nothing here; what is foretold is noise, drawn as often."""
    few = score(*pushed_table(), num_hypotheses)
    for horizon in map(str, HORIZONS):
        for channel, scores in report["horizons"][horizon].items():
            found = few["horizons"][horizon][channel]
            assert found["rmse"] == pytest.approx(scores["rmse"], rel=0.05)
            assert found["coverage90"] == pytest.approx(scores["coverage90"], abs=0.05)
            assert found["log_score"] == pytest.approx(scores["log_score"], abs=0.05)


def test_starts_do_not_cross_an_episode(report):
    assert report["schema"] == "boomdp-predict-1"
    assert report["num_starts"]["1"] == 30 * 12
    assert report["num_starts"]["10"] == 30 * 3
    json.dumps(report, allow_nan=False)


def test_angles_keep_their_turns():
    # Ten turns from one reading to the next would be no error modulo a turn.
    state, action, next_state, episode = pushed_table(num_episodes=2)
    state[..., 2] += 20 * np.pi
    scores = score(state, action, next_state, episode)
    assert scores["horizons"]["1"]["angle"]["rmse"] == pytest.approx(
        20 * np.pi, rel=1e-3
    )


def test_missing_readings_are_not_scored():
    state, action, next_state, episode = pushed_table(num_episodes=2)
    next_state[..., 3:] = np.nan
    next_state[::2, :, :3] = np.nan
    scores = score(state, action, next_state, episode)["horizons"]["1"]
    assert scores["velocity"]["rmse"] is None
    assert scores["spin"]["coverage90"] is None
    assert scores["position"]["rmse"] < 0.01


def test_a_start_needs_a_whole_reading_of_what_moves():
    state, action, next_state, episode = pushed_table(num_episodes=2, num_rows=5)
    state[1, 0, 4] = np.nan
    history = make_history(state, action, next_state, DT, episode=episode, capacity=16)
    moving, still = np.zeros(1, bool), np.ones(1, bool)
    np.testing.assert_array_equal(
        usable_starts(history, 3, moving), np.array([0, 2, 5, 6, 7])
    )
    np.testing.assert_array_equal(
        usable_starts(history, 3, still), np.array([0, 1, 2, 5, 6, 7])
    )
    assert len(usable_starts(history, 40, moving)) == 0


def test_a_horizon_longer_than_every_episode_is_null():
    report = score(*pushed_table(num_episodes=2, num_rows=5))
    assert report["num_starts"]["1"] == 10
    scores = report["horizons"]["10"]
    assert report["num_starts"]["10"] == 0
    assert scores["position"] == {
        "rmse": None,
        "coverage90": None,
        "log_score": None,
        "baseline_rmse": None,
    }


@pytest.mark.usefixtures("no_type_checks")
def test_bad_requests_are_refused():
    state, action, next_state, episode = pushed_table(num_episodes=1)
    history = make_history(state, action, next_state, DT, episode=episode)
    posterior = free_posterior(10)
    with pytest.raises(ValueError, match="horizons: expected steps of at least 1"):
        predict(posterior, history, (0, 5))
    with pytest.raises(ValueError, match=r"horizons: expected a whole .*, got 1\.5"):
        predict(posterior, history, (1.5,))
    with pytest.raises(ValueError, match=r"horizons: expected steps .*, got \[\]"):
        predict(posterior, history, ())
    empty = make_history(state[:0], action[:0], next_state[:0], DT)
    with pytest.raises(ValueError, match="history: expected at least one row, got n"):
        predict(posterior, empty)
    with pytest.raises(ValueError, match="history: expected at least one row, got n"):
        predict(posterior, empty.padded(4))
    with pytest.raises(ValueError, match="num_draws: expected at least 2, got 1"):
        predict(posterior, history, num_draws=1)
    params = draws_like(empty_params(3), 5)
    room = make_posterior(room_spec(), params, params)
    with pytest.raises(ValueError, match="history: expected 3 bodies"):
        predict(room, history)


def test_the_same_key_gives_the_same_numbers(report):
    state, action, next_state, episode = pushed_table()
    history = make_history(state, action, next_state, DT, episode=episode)
    again = free_posterior().predict(history, HORIZONS, num_draws=NUM_DRAWS)
    assert again == report


@pytest.mark.usefixtures("no_type_checks")
def test_one_horizon_needs_no_list():
    state, action, next_state, episode = pushed_table()
    history = make_history(
        state, action, next_state, DT, episode=episode, capacity=CAPACITY
    )
    posterior = free_posterior()
    expected = posterior.predict(history, {1}, num_draws=NUM_DRAWS)
    for one in (1, np.array(1), [1, 1]):
        assert posterior.predict(history, one, num_draws=NUM_DRAWS) == expected


@pytest.mark.parametrize("num_draws", [40, 128, 1000])
def test_nine_in_ten_further_draws_lie_between_the_levels(num_draws):
    """Of uniform draws: the mean of what lies between them is all there is to it."""
    draws = np.random.default_rng(num_draws).random((4000, num_draws))
    low, high = np.quantile(draws, np.asarray(_levels(num_draws)), axis=1)
    share = np.mean(high - low)
    error = np.std(high - low) / np.sqrt(len(draws))
    assert share == pytest.approx(0.9, abs=4 * error)


def test_levels_of_few_draws_are_the_least_and_the_largest():
    np.testing.assert_allclose(_levels(2), [0.0, 1.0])
    np.testing.assert_allclose(_levels(10), [0.0, 1.0])
