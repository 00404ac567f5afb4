"""Drawers and doors of MuJoCo's that come against stops, and such that do not."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.batch_blocks import blocks_of_batch
from boomdp_jax.inference.between_stops import again_between_stops
from boomdp_jax.inference.doubts.end_stops import end_stop_reasons, without_stops
from boomdp_jax.inference.infer import infer, infer_batch
from boomdp_jax.inference.likelihoods.choice import choose_likelihood
from boomdp_jax.physics import empty_params, scene_spec_from_dict
from boomdp_jax.physics.params import Actuator
from tests.inference.made_posteriors import draws_like, make_posterior

DT, NUM_ROWS, ROWS_OF_RUN, ROWS_OF_PUSH = 0.05, 100, 25, 8
HALF, MASS = (0.25, 0.15), 4.0
AXIS, PIN = np.array([0.8, 0.6]), (-0.25, 0.15)
NOISE = np.array([1e-3, 1e-3, 5e-3, 5e-3, 5e-3, 0.02])
JOINTS = {
    "drawer": f'type="slide" axis="{AXIS[0]} {AXIS[1]} 0"',
    "door": f'type="hinge" axis="0 0 1" pos="{PIN[0]} {PIN[1]} 0"',
}
SHAPE = {"type": "box", "half_extents": list(HALF)}
SPEC = scene_spec_from_dict(
    {
        "schema": "planar-scene-1",
        "dt": DT,
        "bodies": [{"name": "it", "shape": SHAPE}],
        "unknown": {"revolute": 1, "prismatic": 1, "weld": 1, "ground": 1},
    }
)


Table = tuple[np.ndarray, np.ndarray, np.ndarray]
"""States, wrenches and next states."""


def recording(
    kind: str, seed: int, *, end: float | None, poses_only: bool = False, **law: float
) -> History:
    """A thing pushed at random in four runs, from rest between its ends."""
    state, wrench, next_state = (part.copy() for part in _table(kind, seed, end, **law))
    if poses_only:
        state[..., 3:] = next_state[..., 3:] = np.nan
    episode = np.arange(NUM_ROWS) // ROWS_OF_RUN
    return make_history(state, wrench, next_state, DT, episode=episode)


@functools.cache
def _table(kind: str, seed: int, end: float | None, **law: float) -> Table:
    """What is read of all channels; 10,000 steps of MuJoCo's that many tests take."""
    limit = "" if end is None else f'limited="true" range="{-end} {end}"'
    more = " ".join(f'{name}="{value}"' for name, value in law.items())
    model: Any = mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler angle="radian"/><option timestep="0.0005" gravity="0 0 0"
        integrator="implicitfast"/><worldbody><body name="it">
        <joint {JOINTS[kind]} {limit} solreflimit="0.004 1" {more}/>
        <geom type="box" size="{HALF[0]} {HALF[1]} 0.1" mass="{MASS}"/>
        </body></worldbody></mujoco>"""
    )
    data: Any = mujoco.MjData(model)
    rng = np.random.default_rng([seed, 9])
    num = -(-NUM_ROWS // ROWS_OF_PUSH)
    push = rng.normal(0.0, (4.0, 4.0, 0.3), (num, 3))
    wrench = np.repeat(push, ROWS_OF_PUSH, axis=0)[:NUM_ROWS, None]

    def read():
        mujoco.mj_forward(model, data)
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, twist, 0)
        turn = data.xmat[1]
        angle = np.arctan2(turn[3], turn[0])
        return np.array([*data.xpos[1][:2], angle, *twist[3:5], twist[2]])

    state, next_state = np.zeros((2, NUM_ROWS, 1, 6))
    for row in range(NUM_ROWS):
        if row % ROWS_OF_RUN == 0:
            mujoco.mj_resetData(model, data)
            data.qpos[0] = 0.0 if end is None else 0.5 * rng.uniform(-end, end)
            reading = read() + NOISE * rng.standard_normal(6)
        state[row, 0] = reading
        data.xfrc_applied[1, [0, 1, 5]] = wrench[row, 0]
        mujoco.mj_step(model, data, round(DT / model.opt.timestep))
        reading = read() + NOISE * rng.standard_normal(6)
        next_state[row, 0] = reading
    state[..., 2] = _continued(state[..., 2], next_state[..., 2])
    return state, wrench, next_state


def _continued(angle, next_angle):
    """Angles without jumps, in place of the second; doors turn by over half a turn."""
    for row in range(len(angle)):
        if row % ROWS_OF_RUN:
            angle[row] = next_angle[row - 1]
        step = next_angle[row] - angle[row]
        next_angle[row] -= 2 * np.pi * np.round(step / (2 * np.pi))
    return angle


def posterior_of(kind: str):
    """One that is sure of the pin of a door."""
    slots = {"num_revolute": 1, "num_prismatic": 1, "num_weld": 1, "num_ground": 1}
    params = draws_like(empty_params(1, density=20.0, **slots), 4)
    if kind == "door":
        pin = params.revolute
        pin = eqx.tree_at(
            lambda p: (p.active, p.anchor_a),
            pin,
            (jnp.ones_like(pin.active), jnp.broadcast_to(jnp.array(PIN), (4, 1, 2))),
        )
        params = eqx.tree_at(lambda p: p.revolute, params, pin)
    inferred = {
        name: np.ones(getattr(params, name).active.shape[1:], bool)
        for name in ("revolute", "distance", "prismatic", "weld", "wheel", "ground")
        if getattr(params, name) is not None
    }
    return make_posterior(SPEC, params, params, inferred=inferred)


_kept_posterior = functools.cache(posterior_of)


def reasons(kind: str, history: History) -> list[str]:
    return end_stop_reasons(SPEC, history, _kept_posterior(kind))


@pytest.mark.parametrize("poses_only", [False, True])
@pytest.mark.parametrize(("kind", "end"), [("drawer", 0.1), ("door", 0.3)])
def test_what_comes_against_its_ends_is_named(kind, end, poses_only):
    name = {"drawer": "the line that it goes along", "door": "its turn about its pin"}
    found = [
        reasons(kind, recording(kind, seed, end=end, poses_only=poses_only))
        for seed in range(6)
    ]
    told = [each[0] for each in found if each]
    assert len(told) >= 5
    ways = set(name.values()) if kind == "door" else {name[kind]}
    for line in told:
        assert line.startswith("it: is held back at the ends of ")
        assert any(way in line for way in ways)


@pytest.mark.parametrize("poses_only", [False, True])
@pytest.mark.parametrize("kind", ["drawer", "door"])
@pytest.mark.parametrize("law", [{}, {"frictionloss": 0.5}, {"damping": 3.0}])
def test_what_turns_back_because_it_is_pushed_is_not(kind, law, poses_only):
    for seed in range(4):
        history = recording(kind, seed, end=None, poses_only=poses_only, **law)
        assert reasons(kind, history) == []


def test_friction_that_holds_anywhere_is_no_stop():
    for seed in range(4):
        history = recording("door", seed, end=None, frictionloss=1.5)
        assert reasons("door", history) == []


@pytest.mark.parametrize("poses_only", [False, True])
@pytest.mark.parametrize("num", [1, 3, 5])
def test_readings_that_are_far_off_are_no_stop(num, poses_only):
    for seed in range(4):
        history = recording("drawer", seed, end=None, poses_only=poses_only)
        rng = np.random.default_rng(seed)
        rows = 2 * rng.choice(np.arange(1, NUM_ROWS // 2 - 1), num, replace=False)
        off = jnp.asarray(rng.choice([-0.5, 0.5], num)[:, None] * AXIS)
        next_state = history.next_state.at[rows, 0, :2].add(off)
        # The next row of the same run starts from the same reading.
        goes_on = (rows + 1) % ROWS_OF_RUN != 0
        state = history.state.at[rows[goes_on] + 1].set(next_state[rows[goes_on]])
        history = dataclasses.replace(history, state=state, next_state=next_state)
        assert reasons("drawer", history) == []


def test_what_a_torque_swings_to_and_fro_comes_against_nothing():
    """A pinned box over a small angle, its middle nearly on a line, in closed form."""
    rng = np.random.default_rng(0)
    inertia = MASS * ((HALF[0] ** 2 + HALF[1] ** 2) / 3.0 + np.dot(PIN, PIN))
    # Begins and ends at rest, with as much torque one way as the other.
    one = np.repeat([1.0, -1.0, -1.0, 1.0], 6)
    torque = np.concatenate([rng.uniform(0.5, 1.5) * one for _ in range(6)])
    rate = np.concatenate([[0.0], np.cumsum(torque * DT / inertia)])
    angle = np.concatenate([[0.0], np.cumsum(DT * 0.5 * (rate[1:] + rate[:-1]))])
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = -np.array(PIN)
    arm = np.column_stack([cos * x - sin * y, sin * x + cos * y])
    states = np.column_stack(
        [arm + PIN, angle, -rate * arm[:, 1], rate * arm[:, 0], rate]
    )
    states = (states + NOISE * rng.standard_normal(states.shape))[:, None]
    wrench = np.zeros((len(torque), 1, 3))
    wrench[:, 0, 2] = torque
    history = make_history(states[:-1], wrench, states[1:], DT)
    assert reasons("door", history) == []
    assert reasons("drawer", history) == []


def test_commands_that_are_still_in_effect_stay_in_the_table():
    """Those of before a gap, as far back as the longest delay, their readings not."""
    history, late = recording("drawer", 1, end=0.1), posterior_of("drawer")
    delay = jnp.full((4, 1), 1.5 * DT)
    actuator = Actuator(gain=None, bias=None, delay=delay)
    params = eqx.tree_at(
        lambda p: p.actuator, late.params, actuator, is_leaf=lambda leaf: leaf is None
    )
    late = eqx.tree_at(lambda p: p.params, late, params)
    (now, _), (free, _) = (
        without_stops(posterior, history)
        for posterior in (posterior_of("drawer"), late)
    )
    action = np.asarray(history.action)[:, 0]
    num_read = 0
    for run in np.unique(np.asarray(free.episode)[np.asarray(free.mask)]):
        rows = np.flatnonzero(np.asarray(free.mask) & (np.asarray(free.episode) == run))
        is_read = np.asarray(free.next_state_mask)[rows, 0, 0]
        # The last of those before it ends at the piece's first reading.
        num_before = int(np.argmax(is_read)) + int(not is_read[0])
        num_read += len(rows) - num_before
        assert num_before <= 2
        own = np.asarray(free.action)[rows, 0]
        starts = [
            i
            for i in range(NUM_ROWS - len(rows) + 1)
            if np.array_equal(action[i : i + len(rows)], own)
        ]
        assert starts
        assert (
            num_before == 2
            or any(i % ROWS_OF_RUN == 0 for i in starts)
            or (num_before == 1 and any(i % ROWS_OF_RUN == 1 for i in starts))
        )
    assert num_read >= int(now.num_transitions)


def test_rows_at_the_ends_are_left_out():
    history = recording("drawer", 1, end=0.1)
    free, notes = without_stops(posterior_of("drawer"), history)
    num = int(free.num_transitions)
    assert notes == [
        f"it: {NUM_ROWS - num} of {NUM_ROWS} rows are left out, in which it may have "
        "come against a stop at the ends of the line that it goes along"
    ]
    assert free.capacity == NUM_ROWS
    assert 40 < num < 90
    # Three sd of noise, and a fiftieth of the way, from either end.
    along = np.asarray(free.state)[:num, 0, :2] @ AXIS
    assert np.abs(along).max() < 0.1 + 2e-3
    place = np.asarray(history.state)[:, 0, :2] @ AXIS
    is_inside = np.abs(place) < 0.07
    assert num > 0.6 * is_inside.sum()
    # A run begins wherever a row does not go on from the one before.
    known = {tuple(row): i for i, row in enumerate(np.asarray(history.state)[:, 0])}
    rows = np.array([known[tuple(row)] for row in np.asarray(free.state)[:num, 0]])
    goes_on = (np.diff(rows) == 1) & (rows[1:] % ROWS_OF_RUN != 0)
    same = np.diff(np.asarray(free.episode)[:num]) == 0
    np.testing.assert_array_equal(goes_on, same)


def test_nothing_is_left_out_where_nothing_is_held_back():
    history = recording("drawer", 1, end=None)
    free, notes = without_stops(posterior_of("drawer"), history)
    assert free is history
    assert notes == []


def with_velocities_at_ends(history: History) -> History:
    """The same, of which nothing is read in full but where it comes against a stop."""
    state, next_state = np.array(history.state), np.array(history.next_state)
    for values in (state, next_state):
        values[np.abs(values[:, 0, :2] @ AXIS) < 0.095, :, 3:] = np.nan
    episode = np.asarray(history.episode)
    return make_history(
        state, np.asarray(history.action), next_state, DT, episode=episode
    )


def test_what_is_refused_between_stops_keeps_its_posterior():
    """Which is told by its number in the batch, not by that among those with stops."""
    stopped = recording("drawer", 3, end=0.1)
    histories = [recording("drawer", 3, end=None), with_velocities_at_ends(stopped)]
    histories.append(stopped)
    chosen = choose_likelihood("open-loop", None, method="map", outliers="none")
    again = posterior_of("drawer")

    def run(key, specs, histories):
        blocks_of_batch(specs, histories, chosen, None)
        return [again] * len(specs)

    before = [posterior_of("drawer") for _ in histories]
    found = list(before)
    kept = again_between_stops(run, jax.random.key(0), [SPEC] * 3, histories, found)
    assert found[0] is before[0]
    assert kept[:2] == histories[:2]
    assert int(kept[2].num_transitions) == 62
    (note,) = found[1].diagnostics["notes"]
    assert note == (
        "no rows are left out at stops, since those between are refused: scene: it: "
        "likelihood 'open-loop': expected rows that start from a reading of every "
        "pose, velocity and spin; got none; likelihood 'filtered' does without"
    )
    assert "38 of 100 rows are left out" in found[2].diagnostics["notes"][0]
    assert reasons("drawer", kept[1])


@pytest.mark.slow
def test_where_nothing_between_stops_can_be_predicted_all_rows_are_taken():
    """One member's lack is no fault of others; its posterior stays, and is doubted."""
    stopped = recording("drawer", 3, end=0.1)
    histories = [recording("drawer", 3, end=None), stopped]
    histories.append(with_velocities_at_ends(stopped))
    found = infer_batch(
        jax.random.key(0),
        [SPEC] * 3,
        histories,
        method="map",
        likelihood="open-loop",
        num_samples=10,
    )
    doubts = ["\n".join(posterior.diagnostics["reasons"]) for posterior in found]
    notes = ["\n".join(posterior.diagnostics["notes"]) for posterior in found]
    left_out = "38 of 100 rows are left out, in which it may have come"
    refused = "expected rows that start from a reading of every pose"
    assert [left_out in each for each in notes] == [False, True, False]
    assert [refused in each for each in notes] == [False, False, True]
    held = "it: is held back at the ends of the line that it goes along, as by a stop"
    assert [held in each for each in doubts] == [False, False, True]
    assert not found[2].diagnostics["ok"]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "poses_only"), [(1, False), (5, True)])
def test_a_drawer_with_stops_is_weighed_between_them(seed, poses_only):
    """With all rows its 4 kg were 11.1 (8.1 to 15.4), and 45 (7.5 to 137)."""
    history = recording("drawer", seed, end=0.1, poses_only=poses_only)
    posterior = infer(jax.random.key(seed), SPEC, history)
    assert posterior.diagnostics["ok"], posterior.diagnostics["reasons"]
    notes = posterior.diagnostics["notes"]
    assert any("rows are left out, in which it may have come" in note for note in notes)
    assert posterior.structure_probabilities()["slide"] > 0.95
    mass = posterior.to_json()["bodies"]["it"]["mass"]
    assert mass["q50"] == pytest.approx(MASS, rel=0.06)
    assert abs(mass["q50"] - MASS) < 3.0 * mass["sd"]
