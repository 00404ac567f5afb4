"""Bodies without a single reading: what is said of them, and what is refused."""

import jax
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference import infer
from boomdp_jax.inference.likelihoods import choose_likelihood
from boomdp_jax.inference.unread import unread_bodies, unread_notes
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
