"""Histories: padding, masks and chains of readings."""

import jax
import numpy as np
import pytest

from boomdp_jax.core.history import make_history


def _rows(num_rows: int = 5) -> dict[str, np.ndarray]:
    readings = np.random.default_rng(0).normal(size=(num_rows + 1, 1, 6))
    return {
        "state": readings[:-1].copy(),
        "action": np.ones((num_rows, 1, 3)),
        "next_state": readings[1:].copy(),
        "dt": np.full(num_rows, 0.02),
    }


def test_padding_is_masked_and_harmless():
    history = make_history(**_rows(), capacity=8)
    assert history.capacity == 8
    assert history.num_transitions == 5
    np.testing.assert_array_equal(history.mask, np.arange(8) < 5)
    np.testing.assert_array_equal(history.state[5:], np.zeros((3, 1, 6)))
    assert bool(np.all(history.dt > 0))


def test_padding_later_is_padding_at_once():
    later = make_history(**_rows()).padded(8)
    for name, expected in vars(make_history(**_rows(), capacity=8)).items():
        np.testing.assert_array_equal(getattr(later, name), expected, err_msg=name)
    assert later.padded(8) is later


def test_padding_to_fewer_rows_is_refused():
    with pytest.raises(ValueError, match="capacity: expected at least 5 rows, got 4"):
        make_history(**_rows()).padded(4)


def test_a_missing_reading_is_masked_and_zero():
    rows = _rows()
    rows["state"][2, 0, 4] = np.nan
    history = make_history(**rows)
    assert history.state[2, 0, 4] == 0
    assert np.sum(~history.state_mask) == 1
    assert not history.state_mask[2, 0, 4]


def test_readings_chain_within_an_episode_only():
    rows = _rows()
    rows["state"][4] += 1e-5
    history = make_history(**rows, episode=np.array([0, 0, 1, 1, 1]))
    np.testing.assert_array_equal(history.is_chained, [False, True, False, True, False])


def test_channels_that_one_end_of_an_instant_lacks_do_not_part_the_others():
    """Of bodies of their own; a row that has nothing in common follows as well."""
    rng = np.random.default_rng(1)
    reading = rng.normal(size=(5, 2, 6))
    state, last = reading[:-1].copy(), reading[1:].copy()
    last[0, 0, 3:], state[1, 1, 1] = np.nan, np.nan
    # Poses alone are read a second time, but for an angle that agrees by chance.
    last[1, 0, [0, 1]] += 1e-3
    last[2, 1], state[3, 0] = np.nan, np.nan
    history = make_history(state, np.zeros((4, 2, 3)), last, 0.1)
    np.testing.assert_array_equal(history.is_chained, [False, True, False, True])
    is_new = np.zeros((4, 2, 6), bool)
    is_new[0] = True
    is_new[1, 0, 3:] = is_new[2, 0, :3] = is_new[3, 1] = True
    np.testing.assert_array_equal(history.is_start_new([0, 1]), is_new)
    apart = make_history(state, np.zeros((4, 2, 3)), last, 0.1, episode=np.arange(4))
    np.testing.assert_array_equal(apart.is_start_new([0, 1]), apart.state_mask)


@pytest.mark.parametrize("places", [None, 6], ids=["single precision", "six decimals"])
def test_a_reading_that_was_rounded_on_its_way_is_one_reading(places):
    """Two would agree far better than any sensor, which then seems to have no noise."""
    rows = _rows()
    first, second = rows["state"], rows["next_state"]
    rows["next_state"] = (
        second.astype(np.float32) if places is None else np.round(second, places)
    )
    history = make_history(**rows)
    assert not np.array_equal(rows["next_state"][:-1], first[1:])
    np.testing.assert_array_equal(history.is_chained, [False, True, True, True, True])


def test_an_empty_history_is_allowed():
    history = make_history(**_rows(0), capacity=3)
    assert history.num_transitions == 0
    assert history.num_bodies == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state": np.zeros((5, 6))}, r"state: expected shape \[time, body, 6\]"),
        ({"action": np.zeros((5, 2, 3))}, r"action: expected shape \(5, 1, 3\)"),
        ({"action": np.full((5, 1, 3), np.nan)}, "action: expected finite wrenches"),
        ({"state": np.full((5, 1, 6), np.inf)}, "state: expected finite readings"),
        ({"dt": np.zeros(5)}, "dt: expected positive seconds"),
        ({"dt": np.ones(3)}, r"dt: expected one number or shape \(5,\), got .*\(3,\)"),
        ({"dt": np.ones((5, 1))}, r"dt: expected one number or shape \(5,\)"),
        ({"dt": np.full(5, "a")}, "dt: expected real numbers, got an array of <U1"),
        ({"action": np.full((5, 1, 3), 1j)}, "action: expected real .* complex128"),
        ({"state": np.full((5, 1, 6), "a")}, "state: expected real numbers, .* <U1"),
        ({"capacity": 4}, "capacity: expected at least 5 rows, got 4"),
        ({"capacity": True}, "capacity: expected a whole number, at least 0, got True"),
        ({"point_frame": "bodyy"}, "^point_frame: expected world or body, got 'bodyy'"),
        ({"episode": np.arange(5) + 0.5}, "episode: expected whole .*, got 0.5"),
        ({"episode": np.full(5, np.nan)}, "episode: expected whole .*, got nan"),
        ({"episode": np.arange(5) * 2**33}, "whole numbers of 32 bit, got 8589934592"),
        ({"episode": np.full(5, "a")}, "episode: expected whole .* array of <U1"),
        ({"episode": np.zeros(4)}, r"episode: expected shape \(5,\), got \(4,\)"),
        ({"episode": np.array([0, 1, 0, 1, 0])}, "episode: .* taken up again"),
    ],
)
def test_bad_rows_are_refused(changes: dict, message: str):
    with pytest.raises(ValueError, match=message):
        make_history(**{**_rows(), **changes})


def test_episodes_of_whole_floats_are_kept():
    history = make_history(**_rows(), episode=np.array([3.0, 3.0, 1.0, 1.0, 7.0]))
    np.testing.assert_array_equal(history.episode, [3, 3, 1, 1, 7])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"state": np.full((5, 1, 6), 1e300)}, "state: .* fit float32, got .* row 0"),
        ({"action": np.full((5, 1, 3), 1e39)}, "action: .* fit float32, got .* body 0"),
        ({"dt": np.full(5, 1e39)}, "dt: expected positive seconds, got 1e"),
        (
            {"dt": np.full(5, 1e-60)},
            "dt: expected positive seconds, got 1e-60 in row 0",
        ),
    ],
)
def test_what_overflows_in_the_cast_is_refused(changes: dict, message: str):
    with jax.enable_x64(False), pytest.raises(ValueError, match=message):
        make_history(**{**_rows(), **changes})
