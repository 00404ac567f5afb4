"""Late poses beside what was felt in the same steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.agents.namo_hand import Hand
from boomdp_jax.envs import NamoReading, drive, make_world, pushing, with_delay
from boomdp_jax.envs.namo import NOBODY
from boomdp_jax.envs.namo_drive import NUM_STEPS, Driven
from boomdp_jax.envs.namo_rooms import story_room
from boomdp_jax.experiments import namo_episode
from boomdp_jax.physics import State
from tests.envs.namo_rooms import room, thing
from tests.envs.test_namo import holding

NUM_COMMANDS = 3
WORLD, START = make_world(room())


def state_at(step: int) -> State:
    """The thing turns by a tenth of a radian a step, far from all others."""
    pose = START.physics.pose.at[0].set(jnp.array([1.5, 1.0, 0.1 * step]))
    return State(pose, jnp.zeros_like(pose))


def command(first: int, delay: int, held: list[int]) -> Driven:
    """Readings of the steps from a first one on, told so many steps late."""
    each = [
        NamoReading(
            before=state_at(max(step - delay, 0)),
            after=state_at(max(step - delay, 0) + 1),
            wrench=jnp.array([0.0, 0.0, step]),
            held=jnp.asarray(one),
        )
        for step, one in zip(range(first, first + NUM_STEPS), held, strict=True)
    ]
    reading = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)
    zero = jnp.zeros(())
    return Driven(reading, reading.after.pose, zero, zero > 0, zero, zero)


def told(row) -> tuple[int, int]:
    """Step of the poses and step of what was felt."""
    return round(float(row.before.pose[0, 2]) / 0.1), round(float(row.wrench[0, 2]))


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 1, 3, 4, 6])
def test_what_was_felt_meets_the_poses_of_its_own_step(delay):
    hand = Hand(WORLD, delay)
    held = [[NOBODY, 0, 0, 0], [0, 0, 0, 0], [0, 0, NOBODY, NOBODY]]
    driven = [
        hand.paired(command(NUM_STEPS * i, delay, held[i])) for i in range(NUM_COMMANDS)
    ]
    rows = hand.rows(0, driven)
    last = min(9, NUM_STEPS * NUM_COMMANDS - 1 - delay)
    assert [told(row) for row in rows] == [(s, s) for s in range(1, last + 1)]
    # One motion, told in one go.
    assert [row.begins for row in rows] == [True] + [False] * (last - 1)
    assert not hand.rows(1, driven)


def test_a_row_goes_on_from_the_one_before_only_where_no_step_is_left_out():
    hand = Hand(WORLD, 2)
    every = [0] * NUM_STEPS
    first = hand.rows(0, [hand.paired(command(0, 2, every))])
    assert [told(row)[0] for row in first] == [0, 1]
    # The next command's come right after, though they are asked for apart.
    second = hand.rows(0, [hand.paired(command(4, 2, every))])
    assert [(told(row)[0], row.begins) for row in second] == [
        (2, False),
        (3, False),
        (4, False),
        (5, False),
    ]
    # One is not learnt from: what follows begins anew.
    hand.paired(command(8, 2, every))
    third = hand.rows(0, [hand.paired(command(12, 2, every))])
    assert [(told(row)[0], row.begins) for row in third][:2] == [
        (10, True),
        (11, False),
    ]


@pytest.mark.slow
def test_rows_of_late_sensors_are_those_of_prompt_ones():
    world, state = holding(friction=0.3)
    found = []
    for delay in (0, 3):
        hand, now, driven = Hand(world, delay), with_delay(state, delay), []
        for force in (-150.0, 60.0, 0.0):
            push = pushing(np.array([force, 20.0, 0.0]))
            now, one = drive(jax.random.key(0), world, now, push)
            driven.append(hand.paired(one))
        found.append(hand.rows(0, driven))
    prompt, late = found
    assert len(late) == len(prompt) - 3
    for one, other in zip(prompt, late, strict=False):
        np.testing.assert_allclose(other.before.pose, one.before.pose, atol=1e-12)
        np.testing.assert_allclose(other.after.twist, one.after.twist, atol=1e-12)
        np.testing.assert_allclose(other.wrench, one.wrench, atol=1e-12)
        assert other.begins == one.begins
    # Not where the delay is left out of account.
    assert np.abs(late[1].wrench - prompt[4].wrench).max() > 1.0


@pytest.mark.slow
def test_a_robot_whose_eyes_are_late_finds_the_pin_all_the_same():
    record, _ = namo_episode("physics", story_room(0), 0, delay=3)
    assert record.is_solved
    table = next(
        i for i, one in enumerate(story_room(0).things) if one.kind == "revolute"
    )
    tried = [one for one in record.tries if one.thing == table]
    assert tried
    assert tried[0].shares[-1]["revolute"] > 0.9


def test_negative_delays_are_refused():
    with pytest.raises(ValueError, match="delay: expected at least 0 steps, got -1"):
        namo_episode("navigation", room(thing()), 0, delay=-1)
