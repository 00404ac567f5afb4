"""What is wrong with one member of a batch says which member it is."""

import pickle

import jax
import numpy as np
import pytest

from boomdp_jax.core import make_history
from boomdp_jax.inference import infer, infer_batch
from boomdp_jax.inference.members import MemberError, Refusals, naming
from boomdp_jax.physics import scene_spec_from_dict

KEY = jax.random.key(0)


def disc(unknown):
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [{"name": "disc", "shape": {"type": "circle", "radius": 0.2}}],
            "unknown": unknown,
        }
    )


GOOD, TOO_MANY = disc({"revolute": 1}), disc({"revolute": 20, "wheel": 20})


def rows(num_bodies=1, velocity=0.0):
    state = np.zeros((3, num_bodies, 6))
    state[..., 3:] = velocity
    return make_history(state, np.zeros((3, num_bodies, 3)), state, 0.02)


def test_one_alone_is_not_numbered():
    refusals = Refusals(1)
    with refusals.of(0):
        raise ValueError("too long")
    with pytest.raises(MemberError, match=r"^too long$") as caught:
        refusals.check()
    assert caught.value.messages == {0: "too long"}


def test_of_many_the_first_is_quoted_and_others_are_numbered():
    refusals = Refusals(20)
    for index in range(3, 16):
        with refusals.of(index):
            raise ValueError(f"too long by {index}")
    with refusals.of(16):
        pass
    with pytest.raises(MemberError) as caught:
        refusals.check()
    assert str(caught.value) == (
        "object 3: too long by 3; refused as well: objects 4, 5, 6, 7, 8, 9, 10, 11, "
        "12, 13 and 2 more"
    )
    assert caught.value.messages[15] == "too long by 15"
    sent = pickle.loads(pickle.dumps(caught.value))
    assert (str(sent), sent.messages) == (str(caught.value), caught.value.messages)


def test_nothing_wrong_is_nothing_raised():
    Refusals(2).check()


@pytest.mark.parametrize("kind", [TypeError, ValueError])
def test_a_number_is_put_in_front_where_there_are_several(kind):
    with pytest.raises(kind, match=r"^object 2: no$"), naming(2, 3):
        raise kind("no")
    with pytest.raises(kind, match=r"^no$"), naming(0, 1):
        raise kind("no")


@pytest.mark.parametrize("method", ["rj", "nuts"])
def test_a_scene_of_too_many_structures_is_numbered(method):
    wrong = r"scene: unknown: 40 constraints of a block of 1 bodies; expected"
    with pytest.raises(ValueError, match=rf"^{wrong}"):
        infer(KEY, TOO_MANY, rows(), method=method)
    with pytest.raises(ValueError, match=rf"^object 1: {wrong}[^:]*$"):
        infer_batch(KEY, [GOOD, TOO_MANY], [rows(), rows()], method=method)
    with pytest.raises(ValueError, match=r"^object 0: .*; refused as well: object 2$"):
        infer_batch(KEY, [TOO_MANY, GOOD, TOO_MANY], [rows()] * 3, method=method)


def test_a_recording_that_does_not_fit_is_numbered():
    wrong = "history: expected 1 bodies, got 2"
    with pytest.raises(ValueError, match=rf"^object 1: .*{wrong}"):
        infer_batch(KEY, [GOOD, GOOD], [rows(), rows(2)])
    with pytest.raises(ValueError, match=rf"^(?!object).*{wrong}"):
        infer_batch(KEY, [GOOD], [rows(2)])
    with pytest.raises(ValueError, match=r"^object 1: .*rows that start from a read"):
        infer_batch(
            KEY, [GOOD, GOOD], [rows(), rows(velocity=np.nan)], likelihood="one-step"
        )


def test_a_structure_that_one_scene_does_not_allow_is_numbered():
    scenes, structure = [GOOD, disc({"wheel": 1})], {"disc": ["revolute"]}
    with pytest.raises(ValueError, match=r"^object 1: .*revolute"):
        infer_batch(KEY, scenes, [rows()] * 2, method="nuts", structure=structure)
    with pytest.raises(ValueError, match=r"^(?!object).*revolute"):
        infer_batch(
            KEY, scenes[1:] * 2, [rows()] * 2, method="nuts", structure=structure
        )


def test_nuts_without_warm_up_is_refused_at_once():
    with pytest.raises(ValueError, match="num_warmup: expected at least 1, got 0"):
        infer_batch(KEY, [], [], method="nuts", num_warmup=0)
