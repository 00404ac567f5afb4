"""Which bodies are one block where readings say little of ties, by geometry alone."""

import itertools

import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.online.belief import OnlineBelief
from boomdp_jax.inference.readings.components import independent_blocks, why_joined
from boomdp_jax.inference.readings.tie_misfit import rotations
from boomdp_jax.inference.readings.touching import Touching
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from tests.inference.recordings import NOISE

DT, NUM = 0.05, 48
NAMES = ("chair", "sofa", "table", "lamp")
ALONE = [(0,), (1,), (2,), (3,)]
OPEN = {"revolute": 1, "wheel": 1, "ground": 1}
REST = "never moved, so that a tie between them cannot be told from two bodies that "


def scene(num: int = 4, unknown: dict | None = None, **fields) -> SceneSpec:
    shape = {"type": "box", "half_extents": [0.2, 0.15]}
    bodies = [{"name": name, "shape": shape} for name in NAMES[:num]]
    content = {"schema": "planar-scene-1", "dt": DT, "gravity": [0.0, 0.0]}
    content |= {"bodies": bodies, "unknown": OPEN if unknown is None else unknown}
    return scene_spec_from_dict(content | fields, source="test")


def places(num: int = 4, apart: float = 3.0) -> np.ndarray:
    """Bodies in a row that stay where they are, `[reading, body, 6]`."""
    state = np.zeros((NUM + 1, num, 6))
    state[..., 0] = apart * np.arange(num)
    state[..., 2] = 0.1
    return state


def moved(state: np.ndarray, body: int, seed: int = 0) -> np.ndarray:
    """The same with one body on a way of its own, pushed now and then."""
    rng = np.random.default_rng(seed)
    push = np.repeat(rng.normal(0.0, [2.0, 2.0, 12.0], (-(-NUM // 8), 3)), 8, axis=0)
    rate = np.zeros((NUM + 1, 3))
    for t in range(NUM):
        rate[t + 1] = 0.9 * rate[t] + DT * push[t]
    out = np.array(state)
    out[:, body, 3:] = rate
    out[:, body, :3] += DT * np.cumsum(rate, axis=0)
    return out


def all_moved(num: int = 4, apart: float = 3.0) -> np.ndarray:
    state = places(num, apart)
    for body in range(num):
        state = moved(state, body, seed=body)
    return state


def pinned_pair(seed: int) -> np.ndarray:
    """Two bodies on ways of their own but for a point that they share."""
    state = moved(moved(places(2, 0.7), 0, seed), 1, seed + 100)
    arms = (
        rotations(state[:, 0, 2]) @ [0.35, 0.1],
        rotations(state[:, 1, 2]) @ [-0.3, 0.0],
    )
    state[:, 1, :2] = state[:, 0, :2] + arms[0] - arms[1]
    state[..., 3:] = np.nan
    return state


def recorded(
    state: np.ndarray, *, action=None, episode=None, seed: int = 1, noise: float = 1.0
) -> History:
    """Readings with noise of what lasts from one row to the next."""
    rng = np.random.default_rng(seed)
    read = state + noise * NOISE * rng.standard_normal(state.shape)
    if action is None:
        action = np.zeros((NUM, state.shape[1], 3))
    return make_history(read[:-1], action, read[1:], DT, episode=episode)


def test_bodies_that_never_moved_are_apart_and_named():
    blocks, notes = independent_blocks(scene(), recorded(moved(places(), 0)))
    assert blocks == ALONE
    assert f"sofa, table, lamp: {REST}stay where they are; none is asked for" in notes
    # As many structures as of three constraints each.
    found = make_block(scene(), (1,), recorded(places()))
    assert found.target.structures.shape == (8, 3)


@pytest.mark.parametrize("noise", [0.0, 1.0, 5.0])
@pytest.mark.parametrize("apart", [0.4, 3.0])
def test_rest_is_told_however_good_the_readings(noise, apart):
    """And however close the bodies stand."""
    for seed in range(5):
        history = recorded(places(apart=apart), seed=seed, noise=noise)
        assert independent_blocks(scene(), history)[0] == ALONE


def test_gross_errors_are_no_motion():
    state = places(2)
    state[[5, 20, 33], 0, :2] += [0.4, -0.3]
    assert independent_blocks(scene(2), recorded(state))[0] == [(0,), (1,)]


@pytest.mark.parametrize("way", ["slowly", "there and back"])
def test_what_moves_a_little_is_not_at_rest(way):
    """A tie of the two would show: they are asked about it as before."""
    time = np.linspace(0.0, 1.0, NUM + 1)
    state = places(2, 0.5)
    state[:, 0, 0] += 0.02 * (time if way == "slowly" else np.sin(np.pi * time))
    state[..., 3:] = np.nan
    blocks, notes = independent_blocks(scene(2), recorded(state))
    assert blocks == [(0, 1)]
    assert notes == []


def test_bodies_carried_between_runs_were_not_at_rest():
    """About a point in common, which they would not share by chance."""
    state = places(2, 0.6)
    half = NUM // 2
    state[half:, :, 2] += [0.4, 0.9]
    arms = [
        rotations(state[:, i, 2]) @ [sign * 0.3, 0.0] for i, sign in ((0, 1), (1, -1))
    ]
    state[:, 1, :2] = state[:, 0, :2] + arms[0] - arms[1]
    episode = (np.arange(NUM) >= half).astype(int)
    history = recorded(state, episode=episode)
    assert independent_blocks(scene(2), history)[0] == [(0, 1)]


def test_what_was_pushed_in_vain_needs_a_floor_to_be_at_rest():
    action = np.zeros((NUM, 2, 3))
    action[4:9, 0, 0] = 3.0
    history = recorded(places(2, 0.5), action=action)
    assert independent_blocks(scene(2), history)[0] == [(0,), (1,)]
    # Without friction something holds it, and that may be the other one.
    frictionless = scene(2, {"revolute": 1})
    assert independent_blocks(frictionless, history)[0] == [(0, 1)]
    assert independent_blocks(frictionless, recorded(places(2, 0.5)))[0] == [(0,), (1,)]


def test_on_a_slope_rest_tells_of_ties():
    spec = scene(2, gravity=[0.0, -1.0])
    assert independent_blocks(spec, recorded(places(2, 0.5)))[0] == [(0, 1)]


def test_a_body_that_was_not_read_joins_nothing():
    state = all_moved()
    state[:, 2] = np.nan
    blocks, notes = independent_blocks(scene(), recorded(state))
    assert blocks == ALONE
    expected = "table: nothing was read of it, so that a tie to chair, sofa, lamp "
    assert f"{expected}cannot be told; none is asked for" in notes
    # A joint that the scene gives stays.
    joint = {"type": "revolute", "a": "table", "b": "lamp"}
    known = scene(constraints=[joint | {"anchor_a": [0, 0], "anchor_b": [0, 0]}])
    blocks, notes = independent_blocks(known, recorded(state))
    assert blocks == [(0,), (1,), (2, 3)]
    assert "a tie to chair, sofa cannot be told" in notes[-1]


def test_bodies_read_in_different_runs_are_apart():
    state = moved(moved(places(2), 0), 1, seed=2)
    half = NUM // 2
    state[: half + 1, 0], state[half:, 1] = np.nan, np.nan
    episode = (np.arange(NUM) >= half).astype(int)
    blocks, notes = independent_blocks(scene(2), recorded(state, episode=episode))
    assert blocks == [(0,), (1,)]
    assert notes == [
        "chair-sofa: never read in one run, so that a tie between them cannot be told; "
        "none is asked for"
    ]
    # In one run the one may move the other while nobody looks at it.
    assert independent_blocks(scene(2), recorded(state))[0] == [(0, 1)]


def test_a_door_is_not_hinged_to_what_stands_at_the_other_end_of_the_room():
    """Its hinge could be fixed in anything that stays still."""
    state = places()
    turn = 0.8 * np.sin(0.2 * np.arange(NUM + 1))
    state[:, 0, 2] = turn
    state[:, 0, :2] = rotations(turn) @ [0.2, 0.0] - [0.2, 0.0]
    state[..., 3:] = np.nan
    blocks, notes = independent_blocks(scene(), recorded(state))
    assert blocks == ALONE
    assert "so far from a centre is the best pin): chair-sofa (3.2 m)" in notes[0]
    near = places(2, 0.6)
    near[:, 0, :3] = state[:, 0, :3]
    near[..., 3:] = np.nan
    assert independent_blocks(scene(2), recorded(near))[0] == [(0, 1)]


@pytest.mark.parametrize("seed", range(5))
def test_a_pin_of_bodies_that_hardly_turn_is_looked_for_near_them(seed):
    """Where it is their readings do not tell: noise would put it anywhere."""
    rng = np.random.default_rng(seed)
    state = places(2, 0.5)
    way = np.cumsum(rng.normal(0.0, 0.02, (NUM + 1, 2)), axis=0)
    state[:, :, :2] += way[:, None]
    state[..., 3:] = np.nan
    assert independent_blocks(scene(2), recorded(state, seed=seed))[0] == [(0, 1)]


def test_of_two_that_move_a_far_tie_that_fits_is_kept():
    """Two discs welded a metre apart, of which the one is five centimetres wide."""
    shape = {"type": "circle", "radius": 0.05}
    content = scene(2, {"revolute": 1, "weld": 1}).to_dict()
    for body in content["bodies"]:
        body["shape"] = shape
    spec = scene_spec_from_dict(content)
    state = places(2, 0.0)
    state[:, 0, :3] = 0.05 * np.sin(
        np.outer(np.arange(NUM + 1), [0.3, 0.2, 0.25]) + np.arange(3.0)[None]
    )
    state[:, 1, 2] = state[:, 0, 2]
    state[:, 1, :2] = state[:, 0, :2] + rotations(state[:, 0, 2]) @ [1.0, 0.0]
    state[..., 3:] = np.nan
    assert independent_blocks(spec, recorded(state))[0] == [(0, 1)]


def test_what_the_scene_ties_is_not_said_to_be_apart():
    joint = {"type": "revolute", "a": "chair", "b": "sofa"}
    known = scene(2, constraints=[joint | {"anchor_a": [0, 0], "anchor_b": [0, 0]}])
    assert independent_blocks(known, recorded(all_moved(2))) == ([(0, 1)], [])


def test_without_rows_the_prior_keeps_its_ties():
    none = np.zeros((0, 2, 6))
    empty = make_history(none, none[..., :3], none, DT, capacity=4)
    assert independent_blocks(scene(2), empty) == ([(0, 1)], [])


def test_more_readings_may_tell_a_filter_of_bodies_at_rest():
    screen = recorded(places(2, 0.5))
    assert independent_blocks(scene(2), screen, is_complete=False)[0] == [(0, 1)]
    online = OnlineBelief(scene(2), capacity=16, num_particles=16, screen=screen)
    assert online.blocks == [("chair", "sofa")]


def in_turn(state: np.ndarray, way: str, seed: int = 0) -> np.ndarray:
    """The same with readings missing."""
    out, time = np.array(state), np.arange(len(state))
    num = state.shape[1]
    if way == "channels":
        out[0::2, :, 2], out[1::2, :, :2] = np.nan, np.nan
    for body in range(num):
        if way == "bodies":
            out[time % num != body, body] = np.nan
        if way == "at random":
            rng = np.random.default_rng([seed, body])
            out[rng.uniform(size=len(out)) > 0.5, body] = np.nan
    return out


@pytest.mark.parametrize("way", ["channels", "bodies", "at random"])
def test_bodies_read_in_turn_are_parted_by_how_they_move(way):
    blocks, notes = independent_blocks(scene(), recorded(in_turn(all_moved(), way)))
    assert blocks == ALONE
    assert "best pin misses by" in notes[0]


@pytest.mark.parametrize("way", ["channels", "bodies", "at random"])
def test_a_pin_is_not_lost_between_readings(way):
    for seed in range(10):
        state = in_turn(pinned_pair(seed), way, seed)
        assert independent_blocks(scene(2), recorded(state))[0] == [(0, 1)]


def test_a_long_gap_parts_no_pair():
    """What it hides is not on a line."""
    state = pinned_pair(0)
    state[2:-2, 0] = np.nan
    state[[0, 1, -2, -1], 1] = np.nan
    assert independent_blocks(scene(2), recorded(state))[0] == [(0, 1)]


def test_bodies_without_angles_are_parted_by_their_distance():
    state = all_moved(apart=3.0)
    state[..., 2:] = np.nan
    blocks, notes = independent_blocks(scene(), recorded(state))
    assert blocks == ALONE
    assert "an angle was never read, centres are over 2 times as far apart" in notes[0]
    assert "chair-sofa" in notes[0]
    near = pinned_pair(3)
    near[..., 2:] = np.nan
    assert independent_blocks(scene(2), recorded(near))[0] == [(0, 1)]
    # Of a drawer nothing can be said without the angle of what it is in.
    drawers = scene(2, {"prismatic": 1})
    assert independent_blocks(drawers, recorded(state[:, :2]))[0] == [(0, 1)]


def row_of_pins() -> np.ndarray:
    """Bodies that move as one: anything may tie them."""
    state = moved(places(), 0)
    for body in (1, 2, 3):
        state[:, body, 2:] = state[:, 0, 2:]
        turned = rotations(state[:, 0, 2]) @ [0.5 * body, 0.0]
        state[:, body, :2] = state[:, 0, :2] + turned
    state[..., 3:] = np.nan
    return state


def test_a_prior_without_ties_joins_nothing():
    history = recorded(row_of_pins())
    assert independent_blocks(scene(), history)[0] == [(0, 1, 2, 3)]
    spec = scene(prior={"probability": {"tie": 0.0}})
    assert independent_blocks(spec, history) == (ALONE, [])


def test_a_block_that_is_too_large_says_why_it_is_one():
    history = recorded(row_of_pins())
    with pytest.raises(ValueError, match="test: unknown: 262144 struct") as caught:
        make_block(scene(), (0, 1, 2, 3), history)
    text = str(caught.value)
    assert "lower the caps in 'unknown'; the block is chair, sofa, table, lamp" in text
    assert "chair-sofa, chair-table, chair-lamp, sofa-table" in text
    assert "may be tied by all that was read" in text
    assert '"prior": {"probability": {"tie": 0}}' in text


def test_what_the_scene_ties_has_no_other_ties_where_the_prior_has_none():
    """Four that are one block for certain, which ties would make too large."""
    joint = {"type": "revolute", "anchor_a": [0, 0], "anchor_b": [0, 0]}
    pairs = itertools.pairwise(NAMES)
    joints = [joint | {"a": a, "b": b} for a, b in pairs]
    unknown, history = {"revolute": 1, "wheel": 1}, recorded(places())
    spec = scene(unknown=unknown, constraints=joints)
    assert independent_blocks(spec, history)[0] == [(0, 1, 2, 3)]
    with pytest.raises(ValueError, match="chair-sofa, sofa-table, table-lamp are tied"):
        make_block(spec, (0, 1, 2, 3), history)
    prior = {"probability": {"tie": 0.0}}
    spec = scene(unknown=unknown, constraints=joints, prior=prior)
    block = make_block(spec, (0, 1, 2, 3), history)
    assert not any(slot.body_b >= 0 for slot in block.layout.slots)


def test_what_touches_is_named_as_such():
    pairs = np.zeros((4, 4), bool)
    pairs[1, 2] = pairs[2, 1] = True
    number = np.array([True, True, False, False])
    touching = Touching(pairs, {"friction": number, "restitution": number})
    history = recorded(moved(places(), 0))
    assert independent_blocks(scene(), history, touching)[0] == [(0,), (1, 2), (3,)]
    text = why_joined(scene(), (1, 2), history, touching)
    assert (
        "the block is sofa, table; sofa-table may have touched; sofa-table sh" in text
    )
    notes = independent_blocks(scene(), history, touching)[1]
    assert any(note.startswith(f"sofa+table, lamp: {REST}") for note in notes)
