"""Bodies at rest that nothing pushes: when a posterior says so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.doubts.still import (
    bodies_let_be,
    let_be_note,
    still_notes,
    still_reasons,
)
from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.infer import infer_batch
from boomdp_jax.inference.readings.touching import Touching
from boomdp_jax.physics import empty_params
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.made_posteriors import draws_like, make_posterior
from tests.inference.recordings import DT, NOISE, SIZE, box_scene

NUM = 30
OPEN = box_scene({"revolute": 1, "wheel": 1, "ground": 1})


def recorded(
    speed=(0.0, 0.0, 0.0), force: float = 0.0, seed: int = 0, angle: float = 0.3
) -> History:
    """Two runs of a free box that keeps its twist, read with noise."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(NUM + 1)[:, None]
    pose = np.array([0.4, -0.2, angle]) + time * np.array(speed)
    true = np.concatenate([pose, np.tile(speed, (NUM + 1, 1))], axis=1)
    runs = [true + NOISE * rng.standard_normal(true.shape) for _ in range(2)]
    for run in runs:
        run[:, 2] = np.mod(run[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    action = np.zeros((2 * NUM, 1, 3))
    action[3, 0, 0] = force
    return make_history(
        np.concatenate([run[:-1] for run in runs])[:, None],
        action,
        np.concatenate([run[1:] for run in runs])[:, None],
        DT,
        episode=np.repeat([0, 1], NUM),
    )


@pytest.mark.parametrize("angle", [0.3, np.pi])
@pytest.mark.parametrize("seed", range(5))
def test_a_body_at_rest_is_named(seed, angle):
    (note,) = still_notes(box_scene(), recorded(seed=seed, angle=angle))
    assert "nothing pushed it and it did not move" in note


@pytest.mark.parametrize(
    "changes",
    [
        {"speed": (0.02, 0.0, 0.0)},
        {"speed": (0.0, 0.0, -0.05)},
        {"force": 0.1},
    ],
    ids=["slides", "turns", "pushed"],
)
def test_one_that_moves_or_is_pushed_is_not(changes):
    assert still_notes(box_scene(), recorded(**changes)) == []


@pytest.mark.parametrize("begins", [0, NUM // 2])
def test_one_that_flies_past_a_camera_is_not(begins):
    """Which reads no velocities; it may begin to move halfway."""
    time = np.maximum(np.arange(NUM + 1) - begins, 0) * DT
    run = np.column_stack([time, 0.0 * time, 0.0 * time])
    run = run + NOISE[:3] * np.random.default_rng(0).standard_normal(run.shape)
    run = np.column_stack([run, np.full((NUM + 1, 3), np.nan)])[:, None]
    history = make_history(run[:-1], np.zeros((NUM, 1, 3)), run[1:], DT)
    assert still_notes(box_scene(), history) == []


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate", [2.0, 7.0, 20.0, 60.0])
def test_one_that_swings_to_and_fro_is_not(rate, seed):
    """About a pin that one camera sees from above; halves of the run look alike."""
    rng = np.random.default_rng(seed)
    turn = rate * DT * np.arange(NUM + 1) + rng.uniform(0.0, 2.0 * np.pi)
    angle, spin = 0.3 * np.sin(turn), 0.3 * rate * np.cos(turn)
    rest = np.zeros_like(angle)
    run = np.column_stack([rest, rest, angle, rest, rest, spin])
    run = (run + NOISE * rng.standard_normal(run.shape))[:, None]
    history = make_history(run[:-1], np.zeros((NUM, 1, 3)), run[1:], DT)
    assert still_notes(box_scene(), history) == []


@pytest.mark.parametrize("what", ["goes at last", "goes and comes back"])
@pytest.mark.parametrize("seed", range(5))
def test_one_that_moves_for_a_reading_or_two_is_not(what, seed):
    """Seen by a camera, which reads no velocities."""
    run = np.zeros((NUM + 1, 6))
    run[..., 3:] = np.nan
    if what == "goes at last":
        run[-1, 0] += 0.5
    else:
        run[12:14, 0] += 0.02
    run += NOISE * np.random.default_rng(seed).standard_normal(run.shape)
    state = run[:, None]
    history = make_history(state[:-1], np.zeros((NUM, 1, 3)), state[1:], DT)
    assert still_notes(box_scene(), history) == []


def test_on_a_slope_rest_does_tell_something():
    shape = {"type": "box", "half_extents": SIZE}
    content = {"schema": "planar-scene-1", "dt": DT, "gravity": [0.0, -1.0]}
    content["bodies"] = [{"name": "box", "shape": shape}]
    assert still_notes(scene_spec_from_dict(content), recorded()) == []


def test_a_few_rows_are_too_few_to_say_so():
    history = recorded()
    few = make_history(
        history.state[:3], history.action[:3], history.next_state[:3], DT
    )
    assert still_notes(box_scene(), few) == []


@pytest.mark.slow
def test_what_is_let_be_is_left_out():
    """Whose readings tell where it is, and nothing of what it is."""
    assert bodies_let_be(OPEN, recorded(), None) == (0,)
    assert bodies_let_be(OPEN, recorded(force=0.1), None) == ()
    told, untold = (
        make_block(OPEN, (0,), recorded(), is_told=is_told).target
        for is_told in (True, False)
    )
    z = jnp.full(told.dim, 0.3)
    structure = jnp.asarray(told.num_structures - 1)
    expected = untold.log_prior_density(structure, z)
    np.testing.assert_allclose(untold.log_density(structure, z), expected, rtol=1e-6)
    assert abs(float(told.log_density(structure, z) - expected)) > 1.0
    places = [t.log_likelihood.coordinates.surroundings for t in (told, untold)]
    for one, other in zip(*map(jax.tree.leaves, places), strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_may_have_been_touched_is_not_let_be():
    touching = Touching(np.ones((1, 1), bool), {})
    assert bodies_let_be(OPEN, recorded(), touching) == ()


def test_what_may_be_pulled_at_all_times_is_not_let_be():
    content = OPEN.to_dict()
    content["unknown"]["actuator"] = ["bias"]
    pulled = scene_spec_from_dict(content)
    assert bodies_let_be(pulled, recorded(), None) == ()


def test_a_body_whose_readings_are_left_out_is_named_once():
    note = let_be_note(box_scene(), 0)
    assert "box: nothing pushed it and it did not move" in note
    assert "its readings are left out" in note
    assert still_notes(box_scene(), recorded(), [note]) == []


@pytest.mark.slow
def test_of_what_is_let_be_the_prior_is_believed():
    """Where readings count, pins have 0.00 to 0.26 and friction has 0.95 and more."""
    histories = [recorded(seed=seed) for seed in range(6)]
    found = infer_batch(jax.random.key(0), [OPEN] * 6, histories)
    expected = read_prior(OPEN.prior, OPEN.source).probability
    for posterior in found:
        assert posterior.diagnostics["ok"], posterior.diagnostics["reasons"]
        for kind in ("revolute", "wheel", "ground"):
            slots = np.asarray(getattr(posterior.params, kind).active)
            has_one = slots.reshape(len(slots), -1).any(axis=1)
            share = float(np.asarray(posterior.weights) @ has_one)
            # Five standard errors of a quarter as many independent draws.
            error = np.sqrt(0.25 * 4 / posterior.num_draws)
            assert share == pytest.approx(expected[kind], abs=5 * error)


def reasons_of(probability: float, scene=None, **changes) -> list[str]:
    """Of a box that was pushed, and of ten draws of which so many have a pin."""
    spec = OPEN if scene is None else scene
    empty = empty_params(1, num_revolute=1, num_wheel=1, num_ground=1)
    has_pin = (np.arange(10) < round(10 * probability))[:, None]
    params = draws_like(empty, 10, revolute_active=has_pin)
    posterior = make_posterior(spec, params, params)
    return still_reasons(spec, recorded(**{"force": 0.1, **changes}), posterior)


@pytest.mark.parametrize("probability", [0.0, 0.5, 1.0])
def test_nothing_tells_whether_what_no_push_moves_is_pinned(probability):
    (reason,) = reasons_of(probability)
    assert "no push has moved it, so that nothing tells whether it is pin" in reason
    assert f"its probability of {probability:.2f} is not to be relied on" in reason


def test_the_prior_may_be_relied_on():
    assert reasons_of(0.2) == []
    content = OPEN.to_dict()
    content["prior"] = {"probability": {"revolute": 0.9}}
    assert reasons_of(1.0, scene_spec_from_dict(content)) == []
    assert len(reasons_of(0.2, scene_spec_from_dict(content))) == 1


@pytest.mark.parametrize(
    "changes",
    [{"speed": (0.02, 0.0, 0.0)}, {"speed": (0.0, 0.0, -0.05)}, {"force": 0.0}],
    ids=["slides", "turns", "let be"],
)
def test_pins_of_what_moves_or_is_let_be_are_not_doubted(changes):
    assert reasons_of(1.0, **changes) == []


def test_what_may_be_fixed_is_not_doubted():
    content = OPEN.to_dict()
    content["unknown"]["weld"] = 1
    assert reasons_of(0.0, scene_spec_from_dict(content)) == []
