"""Commands that are not what acted, or not when: late, early, cut off, drifting."""

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from tests.inference import residual_worlds as worlds
from tests.inference.recordings import DT
from tests.inference.residual_checks import assert_names, check


@pytest.mark.slow
def test_commands_that_come_late_are_a_delay():
    """By 8 ms of steps of 20 ms: part of each wrench is the one before."""
    table = worlds.box_table(np.random.default_rng(11), 100)
    state, acted, next_state = table
    share, given = 0.4, np.zeros_like(acted)
    # What acted is the mean over the step of what was given then and before.
    for row in range(len(acted)):
        past = given[row - 1] if row else np.zeros(3)
        given[row] = (acted[row] - share * past) / (1.0 - share)
    history = make_history(state[:, None], given[:, None], next_state[:, None], DT)
    (found,) = check([history])
    assert_names(found, "delay", [share * DT])


@pytest.mark.slow
def test_commands_that_are_recorded_late_are_an_advance():
    """By 8 ms of steps of 20 ms: part of each wrench is the one after, in two runs."""
    table = worlds.box_table(np.random.default_rng(13), 100)
    state, acted, next_state = table
    share, given = 0.4, np.zeros_like(acted)
    episode = np.arange(100) // 50
    for row in reversed(range(len(acted))):
        has_next = row + 1 < len(acted) and episode[row + 1] == episode[row]
        later = given[row + 1] if has_next else acted[row]
        given[row] = (acted[row] - share * later) / (1.0 - share)
    rows = (part[:, None] for part in (state, given, next_state))
    (found,) = check([make_history(*rows, DT, episode=episode)])
    assert_names(found, "advance", [share * DT])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["axis_limit", "torque_limit", "force_limit"])
def test_commands_that_are_cut_off_are_a_limit(name):
    """At 1.2 of their sd; what a mass would explain is taken into account."""
    state, acted, next_state = worlds.box_table(np.random.default_rng(14), 100)
    usual = np.array([20.0, 20.0, 3.0])
    given = acted.copy()
    # What acts is within limits already, as the command beyond it does nothing more.
    rng = np.random.default_rng(15)
    bold = rng.uniform(1.0, 3.0, size=len(given))
    if name == "axis_limit":
        over = np.abs(acted[:, :2]) > 1.2 * usual[:2]
        given[:, :2] *= np.where(over, bold[:, None], 1.0)
    elif name == "torque_limit":
        given[:, 2] *= np.where(np.abs(acted[:, 2]) > 1.2 * usual[2], bold, 1.0)
    else:
        over = np.hypot(*acted[:, :2].T) > 1.2 * usual[0]
        given[:, :2] *= np.where(over, bold, 1.0)[:, None]
    # The mass is known here, so gains would show first: commands are as large as what
    # acted, by least squares.
    for part in range(3):
        both = given[:, part] @ acted[:, part] / (given[:, part] @ given[:, part])
        given[:, part] *= both
    rows = (part[:, None] for part in (state, given, next_state))
    (found,) = check([make_history(*rows, DT)])
    assert found.laws[0].law.name == name
    assert found.laws[0].fit.log_bayes_factor > 10.0
    assert found.laws[0].fit.coefficient > 0.0


@pytest.mark.slow
def test_a_mass_that_grows_while_it_is_pushed_is_a_drift():
    """Commands do a tenth more at the begin than the model says, later less."""
    table = worlds.box_table(np.random.default_rng(12), 100)
    state, acted, next_state = table
    progress = (np.arange(100) + 0.5) / 100 - 0.5
    given = acted / (1.0 - 0.2 * progress)[:, None]
    rows = (part[:, None] for part in (state, given, next_state))
    # Room that is not in use is no part of the recording.
    history = make_history(*rows, DT, capacity=160)
    (found,) = check([history])
    assert_names(found, "drift", [-0.2, -0.2])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["begin_2", "end_2"])
def test_commands_of_which_little_acts_at_the_ends_of_runs_are_named(name):
    """Half of them does, in two rows of each of five runs."""
    state, acted, next_state = worlds.box_table(np.random.default_rng(16), 100)
    place = np.arange(100) % 20
    is_edge = place < 2 if name == "begin_2" else place >= 18
    given = np.where(is_edge[:, None], 2.0, 1.0) * acted
    rows = (part[:, None] for part in (state, given, next_state))
    # Room that is not in use is no part of the last run.
    history = make_history(*rows, DT, episode=np.arange(100) // 20, capacity=160)
    (found,) = check([history])
    assert_names(found, name, [-0.5])
