"""A robot that gets through the door: with nothing in it, and with one thing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.agents import Character, NamoPlanner, namo_agent, run_namo
from boomdp_jax.agents.manipulation import (
    GAP,
    actions_of,
    attempt,
    grasp_sites,
    ground_of,
    loaded,
)
from boomdp_jax.envs import FreeSpace, drive, grasped, make_world, pose_table, pushing
from boomdp_jax.envs.free_space import distance_to
from boomdp_jax.envs.namo import REACH
from boomdp_jax.envs.namo_room import thing_scene
from boomdp_jax.models import FixedRoom, ThingModel
from boomdp_jax.models.thing_belief import NUM_HYPOTHESES, lone_state
from boomdp_jax.physics import State
from boomdp_jax.physics.quantities import mass_and_inertia
from boomdp_jax.planning import Belief
from tests.envs.namo_rooms import DOOR, GOAL, START, lone_params, poses_of, room, thing

IN_THE_DOOR = (*DOOR, 0.0)
KEY = jax.random.key(0)
KNOWS = Character("knows", learns=False)
STAYS = Character("navigates only", learns=False, moves_things=False)


def knowing(one):
    """One who knows what the room's only thing is."""
    return FixedRoom(one, [lone_params(one.things[0], NUM_HYPOTHESES)])


def chosen(one, believer):
    """What is best from the start, with things where they were."""
    state = make_world(one)[1].physics
    planner = NamoPlanner(one, KNOWS, believer)
    return planner.choose(KEY, state, np.array(one.start))


@pytest.mark.slow
def test_nothing_is_pushed_where_nothing_is_in_the_way():
    one = room()
    record = run_namo(KEY, one, KNOWS, knowing(one))
    assert record.is_solved
    assert record.tries == ()
    assert record.num_pushes == 0
    # No faster than it drives, and not much slower.
    least = np.linalg.norm(np.subtract(GOAL, START)) / one.robot.speed
    assert least < record.seconds < 2.0 * least
    assert np.linalg.norm(record.poses[-1, 1, :2] - np.array(GOAL)) < 0.15
    assert record.most_overlap < 1e-3


@pytest.mark.slow
def test_a_light_box_in_the_door_is_moved_by_who_may_move_it():
    one = room(thing(pose=IN_THE_DOOR))
    record = run_namo(KEY, one, KNOWS, knowing(one))
    assert record.is_solved
    assert record.tries[-1].opened
    assert record.num_wasted == 0
    assert 0.0 < record.most_force <= one.robot.grip
    stays = run_namo(KEY, one, STAYS, knowing(one))
    assert not stays.is_solved
    assert stays.tries == ()


@pytest.mark.slow
def test_hope_is_the_weight_of_hypotheses_under_which_the_thing_can_be_moved():
    one = room(thing(pose=IN_THE_DOOR))
    light, stuck = (
        lone_params(thing(pose=IN_THE_DOOR, friction=friction), NUM_HYPOTHESES)
        for friction in (0.3, 300.0)
    )
    is_stuck = np.arange(NUM_HYPOTHESES) < 8
    both = jax.tree.map(
        lambda p, q: jnp.where(is_stuck.reshape(-1, *[1] * (p.ndim - 1)), p, q),
        stuck,
        light,
    )
    found = [chosen(one, FixedRoom(one, [one_of])) for one_of in (light, both, stuck)]
    # The mean of a share of which so many of all were drawn, and nothing else is known
    # (Jeffreys's prior): what cannot be moved is tried last, but for want of better.
    num = NUM_HYPOTHESES
    for choice, num_able in zip(found, (num, num - 8, 0), strict=True):
        expected = max((num_able + 0.5) / (num + 1.0), 0.01)
        assert choice.trial.probability == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_hope_falls_after_a_push_that_moved_nothing():
    one = room(thing(pose=IN_THE_DOOR, kind="fixed"))
    model = ThingModel(thing_scene(one.things[0]))
    learnt = model.init(KEY)
    choice = chosen(one, FixedRoom(one, [learnt.draws]))
    world, state = make_world(one)
    pose = state.physics.pose.at[1, :2].set(choice.place)
    state = dataclasses.replace(state, physics=State(pose, jnp.zeros_like(pose)))
    state = jax.jit(grasped)(world, state, 0)
    assert state.held == 0
    reading = drive(KEY, world, state, pushing(jnp.array([250.0, 0.0, 0.0])))[1].reading
    belief = learnt.belief
    for index in range(len(reading.held)):
        before, after, wrench = jax.tree.map(
            lambda leaf, index=index: leaf[index],
            (reading.before, reading.after, reading.wrench),
        )
        belief, _ = model.online.step(
            belief,
            lone_state(before, 0),
            wrench[None],
            lone_state(after, 0),
            starts_episode=index == 0,
        )
    draws = model.online.sample_params(KEY, belief, NUM_HYPOTHESES)
    after = chosen(one, FixedRoom(one, [draws])).trial
    assert choice.trial.probability > 0.5
    assert after is None or after.probability < 0.5 * choice.trial.probability


@pytest.mark.slow
def test_a_thing_is_tested_once_at_most(monkeypatch):
    # One who learns nothing, and to whom a test always seems to pay.
    monkeypatch.setattr(namo_agent, "worth_of_test", lambda *_: 1.0)
    one = room(thing(pose=IN_THE_DOOR, kind="fixed"))
    believes = lone_params(thing(pose=IN_THE_DOOR), NUM_HYPOTHESES)
    tests = Character("tests", learns=False, has_tests=True)
    record = run_namo(KEY, one, tests, FixedRoom(one, [believes]))
    assert not record.is_solved
    assert [one.is_test for one in record.tries[:2]] == [True, False]
    assert sum(one.is_test for one in record.tries) == 1


def test_grasps_are_round_the_thing_and_just_out_of_its_way():
    for outline in ((0.3, 0.25), (0.4,)):
        one = room(thing(outline=outline))
        pose = np.array([2.0, 1.5, 0.7])
        sites = grasp_sites(FreeSpace(one), 0, pose)
        assert len(sites) == 12
        gap = distance_to(sites, outline, pose) - one.robot.radius
        np.testing.assert_allclose(gap, GAP)
        assert GAP < REACH
        # From all sides, each from its own.
        away = np.exp(1j * np.arctan2(*(sites - pose[:2]).T[::-1]))
        assert abs(away.sum()) < 1e-9
        assert len(np.unique(away.round(6))) == 12


def test_pushes_go_round_the_circle_and_none_is_more_than_the_robot_has():
    actions = actions_of(250.0)
    size = np.linalg.norm(actions[:, :2], axis=1)
    assert np.isclose(size, 250.0).sum() == 8
    assert np.isclose(size, 125.0).sum() == 4
    assert len(actions) == 12
    assert not actions[:, 2].any()
    np.testing.assert_allclose(actions.sum(axis=0), 0.0, atol=1e-9)


def test_what_is_held_weighs_more_and_rubs_no_more():
    one = thing()
    scene = thing_scene(one).scene
    params = jax.tree.map(lambda leaf: leaf[0], lone_params(one))
    held = loaded(params, scene, jnp.asarray(60.0))
    mass, _ = mass_and_inertia(scene, params)
    total, _ = mass_and_inertia(scene, held)
    np.testing.assert_allclose(total, mass + 60.0)
    rubs = held.ground.dry * total[0]
    np.testing.assert_allclose(rubs, params.ground.dry * mass[0])
    np.testing.assert_array_equal(held.ground.viscous, params.ground.viscous)
    np.testing.assert_array_equal(held.wheel.dry, params.wheel.dry)


def test_no_grasp_is_refused():
    one = room()
    space, poses = FreeSpace(one), poses_of(one)
    free = space.free(poses)
    belief = Belief(lone_params(one.things[0]), jnp.zeros(1))
    with pytest.raises(ValueError, match="places: expected one grasp at least, got no"):
        attempt(
            KEY,
            thing_scene(one.things[0]).scene,
            ground_of(space, pose_table(space, 0, poses, free, free), free),
            belief,
            lone_state(make_world(one)[1].physics, 0),
            np.zeros((0, 2)),
            one.robot,
            np.zeros(0),
        )
