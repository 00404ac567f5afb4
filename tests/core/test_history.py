"""Histories: padding, masks and chains of readings."""

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
    rows["state"][4] += 1e-12
    history = make_history(**rows, episode=np.array([0, 0, 1, 1, 1]))
    np.testing.assert_array_equal(history.is_chained, [False, True, False, True, False])


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
        ({"capacity": 4}, "capacity: expected at least 5 rows, got 4"),
    ],
)
def test_bad_rows_are_refused(changes: dict, message: str):
    with pytest.raises(ValueError, match=message):
        make_history(**{**_rows(), **changes})
