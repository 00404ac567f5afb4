"""Rows that do not follow one another: where a posterior names them."""

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.doubts.run_breaks import run_break_reasons
from tests.inference.recordings import NOISE, box_scene, free_box


def glued(seed: int, **changes):
    """Three runs of a free box that count as one."""
    rng = np.random.default_rng(seed)
    history = free_box(rng, 60, num_episodes=3, **changes)
    return make_history(history.state, history.action, history.next_state, history.dt)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("is_chained", [True, False])
def test_rows_at_which_runs_were_put_together_are_named(seed, is_chained):
    (reason,) = run_break_reasons(box_scene(), glued(seed, is_chained=is_chained))
    assert reason.startswith("box: in rows 20, 40 it starts up to ")
    assert "expected another 'episode' where another run begins" in reason


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("is_chained", [True, False])
def test_runs_that_are_told_apart_are_in_order(seed, is_chained):
    rng = np.random.default_rng(seed)
    history = free_box(rng, 60, num_episodes=3, is_chained=is_chained)
    assert run_break_reasons(box_scene(), history) == []


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("is_chained", [True, False])
def test_noise_and_gross_errors_are_no_gaps(seed, is_chained):
    """Of a body at rest, of which nothing but noise is seen."""
    rng = np.random.default_rng(seed)
    first = NOISE * rng.standard_normal((60, 6))
    last = NOISE * rng.standard_normal((60, 6))
    # One after the other they would be a gap.
    first[rng.choice(15, size=2, replace=False) * 4, :3] += 1.0
    last[rng.choice(15, size=2, replace=False) * 4 + 2, :3] += 1.0
    if is_chained:
        first[1:] = last[:-1]
    history = make_history(first[:, None], np.zeros((60, 1, 3)), last[:, None], 0.02)
    assert run_break_reasons(box_scene(), history) == []


def test_what_was_not_read_is_no_gap():
    history = glued(0)
    state = np.array(history.state)
    state[:, :, :3] = np.nan
    partly = make_history(state, history.action, history.next_state, history.dt)
    assert run_break_reasons(box_scene(), partly) == []


def with_rows_lost(seed: int, *, is_chained: bool, is_told: bool):
    """A free box that is pushed, of whose rows a tenth was lost, and which were."""
    rng = np.random.default_rng(seed)
    whole = free_box(rng, 60, is_chained=is_chained)
    lost = np.sort(rng.choice(np.arange(5, 55, 2), size=6, replace=False))
    kept = np.delete(np.arange(60), lost)
    episode = np.cumsum(np.diff(kept, prepend=0) > 1) if is_told else None
    parts = (whole.state, whole.action, whole.next_state)
    state, action, last = (np.asarray(part)[kept] for part in parts)
    return make_history(state, action, last, 0.02, episode=episode), kept


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("is_chained", [True, False])
def test_rows_that_were_lost_on_the_way_are_noticed(seed, is_chained):
    history, kept = with_rows_lost(seed, is_chained=is_chained, is_told=False)
    (reason,) = run_break_reasons(box_scene(), history)
    assert "as if rows between them were missing; expected rows that follow" in reason
    named = reason.split("in rows ")[1].split(" it starts")[0].split(" and ")[0]
    after = np.flatnonzero(np.diff(kept) > 1) + 1
    assert set(map(int, named.split(", "))) <= set(after.tolist())


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("is_chained", [True, False])
def test_runs_that_begin_anew_after_each_gap_are_in_order(seed, is_chained):
    history, _ = with_rows_lost(seed, is_chained=is_chained, is_told=True)
    assert run_break_reasons(box_scene(), history) == []


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("what", ["rounded", "read twice now and then", "gross errors"])
def test_what_is_no_gap_is_not_taken_for_lost_rows(seed, what):
    rng = np.random.default_rng(seed)
    history = free_box(rng, 60, is_chained=False)
    state, last = np.array(history.state), np.array(history.next_state)
    if what == "rounded":
        digit = np.array([5e-3, 5e-3, np.pi / 180, 0.02, 0.02, 0.02])
        state, last = (digit * np.round(part / digit) for part in (state, last))
    elif what == "read twice now and then":
        state = np.zeros_like(state) + NOISE * rng.standard_normal(state.shape)
        last = NOISE * rng.standard_normal(state.shape)
        same = rng.random(59) < 0.7
        state[1:][same] = last[:-1][same]
    else:
        # Both readings of one row would be a run of their own.
        rows = 3 * rng.choice(20, size=2, replace=False)
        for part, row in zip((state, last), rows, strict=True):
            part[row, 0, :2] += 0.3
    history = make_history(state, history.action, last, 0.02)
    assert run_break_reasons(box_scene(), history) == []
