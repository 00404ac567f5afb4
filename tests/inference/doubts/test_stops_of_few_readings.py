"""Stops of which only some channels were read, and what tells of them."""

import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.doubts.stretches import (
    Stretches,
    changes_of,
    cut,
    fit_of,
    readings_of,
)
from boomdp_jax.inference.doubts.told_by_channels import (
    about_pin,
    along_line,
    spin_about_pin,
)
from boomdp_jax.inference.doubts.way_of_body import Way
from boomdp_jax.inference.readings.reading_sequence import scatter
from tests.inference.doubts.test_end_stops import (
    DT,
    NUM_ROWS,
    ROWS_OF_RUN,
    reasons,
    recording,
)

AXIS = np.array([0.6, -0.8])
NOISE = 1e-3


def with_gaps(history: History, share: float, seed: int) -> History:
    """The same, of which single numbers were not read."""
    rng = np.random.default_rng([seed, 17])
    next_state, state = np.array(history.next_state), np.array(history.state)
    next_state[rng.random(next_state.shape) < share] = np.nan
    goes_on = np.arange(NUM_ROWS) % ROWS_OF_RUN > 0
    state[goes_on] = np.roll(next_state, 1, axis=0)[goes_on]
    episode = np.arange(NUM_ROWS) // ROWS_OF_RUN
    action = np.asarray(history.action)
    return make_history(state, action, next_state, DT, episode=episode)


@pytest.mark.parametrize("poses_only", [False, True])
@pytest.mark.parametrize("share", [0.15, 0.3])
@pytest.mark.parametrize(("kind", "end"), [("drawer", 0.1), ("door", 0.3)])
def test_stops_are_noticed_though_channels_are_missing(kind, end, share, poses_only):
    found = []
    for seed in range(8):
        history = recording(kind, seed, end=end, poses_only=poses_only)
        found.append(bool(reasons(kind, with_gaps(history, share, seed))))
    assert sum(found) >= 6


@pytest.mark.parametrize("kind", ["drawer", "door"])
@pytest.mark.parametrize("law", [{}, {"frictionloss": 0.5}, {"damping": 3.0}])
def test_missing_channels_are_no_stop(kind, law):
    for seed in range(4):
        for poses_only in (False, True):
            whole = recording(kind, seed, end=None, poses_only=poses_only, **law)
            for share in (0.15, 0.3):
                assert reasons(kind, with_gaps(whole, share, seed)) == []


def test_one_channel_tells_where_on_a_line():
    rng = np.random.default_rng(0)
    place = rng.normal(size=40)
    values = np.array([1.0, 2.0]) + place[:, None] * AXIS
    values[10:14, 0], values[20:24, 1], values[30:32] = np.nan, np.nan, np.nan
    told, error = along_line(values, np.array([1.0, 2.0]), AXIS, NOISE)
    is_read = np.arange(40) // 2 != 15
    np.testing.assert_allclose(told[is_read], place[is_read], atol=1e-12)
    assert np.isnan(told[30:32]).all()
    np.testing.assert_allclose(error[10:14], NOISE / 0.8)
    np.testing.assert_allclose(error[20:24], NOISE / 0.6)
    np.testing.assert_allclose(error[:10], NOISE)


def test_positions_tell_how_far_a_door_is_turned():
    num, arm = 60, np.array([0.3, -0.2])
    time = 0.05 * np.arange(num)
    true = 0.8 * np.sin(2.0 * time)
    rate = 1.6 * np.cos(2.0 * time)
    cos, sin = np.cos(true), np.sin(true)
    lever = np.stack([cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]], -1)
    positions = np.array([0.4, 0.1]) + lever
    velocities = rate[:, None] * np.stack([-lever[:, 1], lever[:, 0]], -1)
    angle, spin = true.copy(), rate.copy()
    angle[7::8] = spin[5::8] = np.nan
    positions[15, 0] = np.nan
    run = np.zeros(num, int)
    (told, error), arms = about_pin(angle, positions, run, time, NOISE)
    np.testing.assert_allclose(told, true, atol=1e-4)
    assert np.isfinite(error).all()
    np.testing.assert_allclose(arms, lever, atol=1e-4)
    told, error = spin_about_pin(spin, velocities, arms, NOISE)
    np.testing.assert_allclose(told, rate, atol=1e-3)
    assert np.isfinite(error).all()


def way_of(place, speed, force, dt: float, noise: float) -> Way:
    num = len(place)
    return Way(
        place=place,
        speed=speed,
        place_error=np.full(num, noise),
        speed_error=np.full(num, noise),
        noise=noise,
        run=np.zeros(num, int),
        time=dt * np.arange(num),
        force=force,
        name="it",
    )


def pushed(num: int, dt: float, kick: float):
    """Under forces that are held over steps, and a kick half-way: closed form."""
    rng = np.random.default_rng(1)
    force = np.repeat(rng.normal(size=num // 5), 5)
    steps = 0.25 * force * dt
    steps[num // 2] += kick
    speed = np.cumsum(steps) - steps
    # The kick is as the step begins.
    begins = speed + np.where(np.arange(num) == num // 2, kick, 0.0)
    ways = begins * dt + 0.125 * force * dt**2
    return np.cumsum(ways) - ways, speed, np.column_stack([force, np.ones(num)])


@pytest.mark.parametrize("missing", ["nothing", "speeds", "places", "some"])
def test_a_kick_and_a_mass_are_told_by_whatever_was_read(missing):
    num, dt, kick = 60, 0.02, -0.5
    place, speed, force = pushed(num, dt, kick)
    way = way_of(place, speed, force, dt, 1e-9)
    readings = readings_of(way, place)
    use = np.ones((2, num))
    if missing in ("speeds", "places"):
        use[1 if missing == "speeds" else 0] = 0.0
    if missing == "some":
        use = (np.random.default_rng(2).random((2, num)) < 0.6).astype(float)
    readings = readings._replace(weight=readings.weight * use)
    is_inner = np.abs(np.arange(num) - num // 2) > 2
    fit = fit_of(readings, cut(is_inner, way.run, 9))
    assert fit is not None
    np.testing.assert_allclose(fit.found, [0.25, 0.0], atol=1e-6)
    at = np.array([num // 2])
    found = np.append(np.append(0.0, fit.found), [0.0, 0.0])
    changes = changes_of(
        readings, Stretches(at - 8, at + 8), Stretches(at, at), np.ones(2)
    )
    left = changes.change - changes.reasons @ found
    # A kick is not quite what changes speed evenly over a step.
    np.testing.assert_allclose(left, kick, rtol=0.1)
    at = np.array([12])
    calm = changes_of(
        readings, Stretches(at - 8, at + 8), Stretches(at, at), np.ones(2)
    )
    np.testing.assert_allclose(calm.change - calm.reasons @ found, 0.0, atol=1e-5)


def test_gaps_are_not_taken_for_noise():
    """A thing that goes to and fro; every third reading or so is missing."""
    rng = np.random.default_rng(3)
    time = 0.02 * np.arange(400)
    place = 0.2 * np.sin(2.0 * time)
    values = (place + NOISE * rng.standard_normal(400))[:, None]
    values[rng.random(400) < 0.3] = np.nan
    run = np.zeros(400, int)
    told = scatter(values, run, time=time)
    assert told == pytest.approx(NOISE, rel=0.2)
    evenly = scatter(values, run)
    assert evenly is not None
    assert evenly > 1.5 * NOISE
