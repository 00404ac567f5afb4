"""Bodies without a single reading: what is said of them, and what is refused."""

import equinox as eqx
import jax
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference import infer
from boomdp_jax.inference.doubts.unread_angles import angle_reasons
from boomdp_jax.inference.likelihoods.choice import choose_likelihood
from boomdp_jax.inference.readings.track_data import track_data
from boomdp_jax.inference.readings.unread import unread_bodies, unread_notes
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from tests.inference.recordings import DT, SIZE, box_scene, free_box

KEY = jax.random.key(0)


def without(history: History, *bodies: int) -> History:
    """The same, with all readings of some bodies missing."""
    state, after = np.array(history.state), np.array(history.next_state)
    state[:, bodies], after[:, bodies] = np.nan, np.nan
    return make_history(state, history.action, after, DT)


def boxes(rng: np.random.Generator, num_rows: int = 8) -> tuple[SceneSpec, History]:
    """A wall, which nobody reads, and boxes a and b."""
    shape = {"type": "box", "half_extents": SIZE}
    bodies = [{"name": name, "shape": shape} for name in ("a", "b")]
    wall = {"name": "wall", "shape": shape, "static": True}
    content = {"schema": "planar-scene-1", "dt": DT, "gravity": [0.0, 0.0]}
    content["bodies"] = [wall | {"pose": [5.0, 0.0, 0.0]}, *bodies]
    each = [free_box(rng, num_rows) for _ in range(3)]
    names = ("state", "action", "next_state")
    arrays = [np.concatenate([getattr(h, n) for h in each], axis=1) for n in names]
    spec = scene_spec_from_dict(content, source="test")
    return spec, without(make_history(*arrays, DT), 0)


def test_bodies_without_readings_are_named_and_static_ones_are_not():
    spec, history = boxes(np.random.default_rng(0))
    assert unread_notes(spec, history) == []
    assert unread_notes(spec, without(history, 2)) == [
        "b: nothing was read of it in any of 8 rows"
    ]
    assert unread_bodies(spec, without(history, 1, 2)) == ["a", "b"]
    # Rows to come are no rows, and none at all ask for the prior.
    nothing = np.zeros((0, 3, 6))
    empty = make_history(nothing, nothing[..., :3], nothing, DT, capacity=4)
    assert unread_bodies(spec, empty) == []


def test_one_reading_of_either_end_is_something():
    history = free_box(np.random.default_rng(1), 4)
    lost = np.full((4, 1, 6), np.nan)
    one = lost.copy()
    one[2, 0, 5] = 0.1
    for state, after, expected in (
        (lost, lost, ["box"]),
        (one, lost, []),
        (lost, one, []),
    ):
        table = make_history(state, history.action, after, DT)
        assert unread_bodies(box_scene(), table) == expected


def test_exact_starts_need_a_reading_of_some_body():
    spec, history = boxes(np.random.default_rng(2))
    chosen = choose_likelihood("one-step", None, method="rj", outliers="none")
    for unseen in ((), (1,), (2,)):
        for body in (1, 2):
            assert chosen.notes_on_rows(spec, (body,), without(history, *unseen)) == []
    with pytest.raises(
        ValueError, match="test: a: likelihood 'one-step': expected row"
    ):
        chosen.notes_on_rows(spec, (1,), without(history, 1, 2))
    for method in ("rj", "nuts"):
        with pytest.raises(ValueError, match="expected rows that start from a reading"):
            infer(
                KEY, spec, without(history, 1, 2), method=method, likelihood="one-step"
            )


@pytest.mark.slow
def test_the_posterior_says_of_whom_nothing_was_read():
    """The other body's density is found all the same."""
    spec, history = boxes(np.random.default_rng(3))
    for options in ({"likelihood": "one-step"}, {"outliers": "student-t"}):
        found = infer(KEY, spec, without(history, 2), method="laplace", **options)
        notes = found.diagnostics["notes"]
        assert "b: nothing was read of it in any of 8 rows" in notes
        assert not any(note.startswith("a: nothing") for note in notes)
        bodies = found.to_json()["bodies"]
        assert bodies["a"]["identified"]
        assert not bodies["b"]["identified"]
        assert "nothing was read" in found.summary()


def turning_box(num_rows: int = 12) -> dict[str, np.ndarray]:
    """Readings of a body that turns by a tenth of a radian a step, from 1.3 on."""
    time = np.arange(num_rows + 1)
    reading = np.zeros((num_rows + 1, 1, 6))
    reading[:, 0, 0], reading[:, 0, 2], reading[:, 0, 5] = 0.01 * time, 1.3, 5.0
    reading[:, 0, 2] += 0.1 * time
    action = np.zeros((num_rows, 1, 3))
    return {
        "state": reading[:-1].copy(),
        "action": action,
        "next_state": reading[1:].copy(),
    }


def test_a_track_whose_first_angle_is_missing_starts_near_the_next_one():
    rows = turning_box()
    episode = np.repeat([0, 1], 6)
    # The second run lacks its first two instants, the first one a single channel.
    rows["state"][0, 0, 2] = np.nan
    rows["state"][6:8], rows["next_state"][6] = np.nan, np.nan
    history = make_history(**rows, dt=DT, episode=episode)
    track = track_data(history, (0,), True)
    assert np.asarray(track.is_start)[[0, 6]].all()
    start = np.asarray(track.start)[:, 0]
    np.testing.assert_allclose(start[0, :3], [0.0, 0.0, 1.4], atol=1e-6)
    np.testing.assert_allclose(start[6, :3], [0.08, 0.0, 2.1], atol=1e-6)
    # What was not read counts as little as before.
    assert not np.any(np.asarray(track.first_mask)[6])


@pytest.mark.slow
def test_where_no_angle_was_read_joints_and_wheels_are_doubted():
    """A pin and a wheel may move a dot alike."""
    spec = box_scene({"revolute": 1})
    history = free_box(np.random.default_rng(0), 12)
    read = np.array(history.state), np.array(history.next_state)
    found = infer(KEY, spec, history, method="laplace")
    assert angle_reasons(spec, history, found) == []
    for array in read:
        array[..., [2, 5]] = np.nan
    blind = make_history(read[0], history.action, read[1], DT)
    active = np.ones_like(found.params.revolute.active)
    pinned = eqx.tree_at(lambda p: p.params.revolute.active, found, active)
    reasons = angle_reasons(spec, blind, pinned)
    assert len(reasons) == 1
    assert "its angle was never read" in reasons[0]
    assert "probability 1.00" in reasons[0]
    # What is found free may be a pinned body all the same, unless it is known not to.
    free = eqx.tree_at(lambda p: p.params.revolute.active, found, ~active)
    assert "probability 0.00" in angle_reasons(spec, blind, free)[0]
    assert angle_reasons(box_scene({"ground": 1}), blind, free) == []
