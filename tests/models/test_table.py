import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models.table import (
    add_row,
    check_at_least,
    empty_table,
    has_grown,
    scaling_of,
    spread_place,
    squared_distances,
)


def filled(rows, capacity, seen=None):
    seen = np.ones(len(rows), bool) if seen is None else seen

    def take(table, row):
        value, is_seen = row
        return add_row(table, value, 2.0 * value[:1], is_seen), None

    first = empty_table(capacity, rows.shape[1], 1)
    return jax.lax.scan(take, first, (jnp.asarray(rows), jnp.asarray(seen)))[0]


def test_newest_rows_take_the_place_of_the_oldest():
    rows = np.arange(14.0).reshape(7, 2)
    table = filled(rows, 4)
    np.testing.assert_array_equal(table.inputs, rows[[4, 5, 6, 3]])
    np.testing.assert_array_equal(table.targets[:, 0], 2 * rows[[4, 5, 6, 3], 0])
    assert int(table.num_rows) == 4
    assert int(table.num_seen) == 7


def test_rows_that_were_not_seen_leave_no_trace():
    rows = np.arange(14.0).reshape(7, 2)
    seen = np.array([1, 0, 1, 1, 0, 0, 1], bool)
    table = filled(rows, 5, seen)
    np.testing.assert_array_equal(table.inputs[:4], rows[seen])
    np.testing.assert_array_equal(table.mask, [1, 1, 1, 1, 0])


def test_scaling_is_that_of_numpy_and_spares_constants():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(20, 3)) * np.array([1.0, 100.0, 0.0]) + 1e4
    table = filled(rows, 30)
    scaling = scaling_of(table.inputs, table.mask)
    np.testing.assert_allclose(scaling.mean, rows.mean(0))
    np.testing.assert_allclose(scaling.spread, [*rows.std(0)[:2], 1.0])
    np.testing.assert_allclose(
        scaling(jnp.asarray(rows)), (rows - rows.mean(0)) / np.array(scaling.spread)
    )
    nothing = scaling_of(jnp.ones((3, 2)), jnp.zeros(3, bool))
    np.testing.assert_array_equal(nothing.spread, 1.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_what_a_turn_leaves_of_a_force_along_an_axis_is_no_variation(dtype):
    turns = np.pi * np.array([0, 1, 0, 2, 1]).astype(dtype)
    push = np.array([10.0, 12.0, 9.0, 10.0, 11.0], dtype)
    rows = np.stack([push * np.cos(turns), push * np.sin(turns)], axis=1)
    assert np.ptp(rows[:, 1]) > 0
    scaling = scaling_of(jnp.asarray(rows), jnp.ones(5, bool))
    np.testing.assert_allclose(scaling.spread, [rows[:, 0].std(), 1.0], rtol=1e-6)
    # Small beside others is not nothing.
    rows[:, 1] = 1e-4 * np.arange(5)
    scaling = scaling_of(jnp.asarray(rows), jnp.ones(5, bool))
    np.testing.assert_allclose(scaling.spread[1], rows[:, 1].std(), rtol=1e-4)


def test_squared_distances_are_those_between_points():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(5, 3)), rng.normal(size=(7, 3))
    slow = [[np.sum((x - y) ** 2) for y in b] for x in a]
    fast = squared_distances(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(fast, slow, atol=1e-12)


def test_a_full_table_keeps_to_all_that_was_seen():
    rng = np.random.default_rng(0)
    lively, dull = rng.normal(size=(20, 2)), 1e-3 * rng.normal(size=(300, 2))

    def take(table, row):
        return add_row(table, row, row, at=spread_place(table, row)), None

    rows = jnp.asarray(np.concatenate([lively, dull]))
    table = jax.lax.scan(take, empty_table(30, 2, 2), rows)[0]
    for row in lively:
        gap = np.min(np.linalg.norm(np.asarray(table.inputs) - row, axis=1))
        assert gap < 0.5
    kept = [np.any(np.all(np.asarray(table.inputs) == row, axis=1)) for row in lively]
    assert np.mean(kept) > 0.8


def test_settings_are_chosen_anew_when_rows_have_grown_by_half():
    table = empty_table(10, 1, 1)
    tuned, when = jnp.zeros((), jnp.int32), []
    for count in range(1, 30):
        table = add_row(table, jnp.ones(1), jnp.ones(1))
        if has_grown(table, tuned):
            tuned = table.num_seen
            when.append(count)
    assert when == [4, 6, 9, 14, 21]


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="capacity: expected at least 1 row, got 0"):
        empty_table(0, 1, 1)
    with pytest.raises(ValueError, match="depth: expected at least 2, got 1"):
        check_at_least("depth", 1, 2)
