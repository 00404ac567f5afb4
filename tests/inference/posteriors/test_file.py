"""Files of posteriors: the same to the bit, and no trust in what is read."""

import json
import pickle

import jax
import numpy as np
import pytest

from boomdp_jax.inference.posteriors.posterior import load_posterior
from tests.inference.made_posteriors import table_posterior


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "post.npz"
    table_posterior(40).save(path)
    return path


def rewrite(path, **changes):
    """Write the file again with some arrays replaced, or left out where None."""
    with np.load(path) as file:
        arrays = {**dict(file), **changes}
    kept = {name: array for name, array in arrays.items() if array is not None}
    with open(path, "wb") as file:
        np.savez(file, **kept)


def edit_header(path, **changes):
    with np.load(path) as file:
        header = json.loads(file["header"].tobytes().decode())
    text = json.dumps({**header, **changes}).encode()
    rewrite(path, header=np.frombuffer(text, np.uint8))


def refusal(path) -> str:
    with pytest.raises(ValueError) as caught:
        load_posterior(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_what_is_saved_comes_back_to_the_bit(tmp_path, precision):
    posterior = table_posterior(40)
    posterior.save(tmp_path / "post.npz")
    loaded = load_posterior(tmp_path / "post.npz")
    ours, theirs = (jax.tree.leaves(each) for each in (posterior, loaded))
    assert len(ours) == len(theirs)
    for mine, its in zip(ours, theirs, strict=True):
        assert mine.dtype == its.dtype
        np.testing.assert_array_equal(mine, its)
    assert loaded.params.density.dtype.itemsize * 8 == precision.bits
    assert loaded.seed == 3
    assert loaded.versions == posterior.versions or (
        dict(loaded.versions) == dict(posterior.versions)
    )
    assert loaded.to_json() == posterior.to_json()
    assert loaded.summary() == posterior.summary()


def test_a_name_without_ending_is_kept(tmp_path):
    table_posterior(10).save(tmp_path / "post")
    assert [entry.name for entry in tmp_path.iterdir()] == ["post"]


def test_a_truncated_file_is_refused(saved):
    content = saved.read_bytes()
    saved.write_bytes(content[: len(content) // 2])
    refusal(saved)


@pytest.mark.parametrize("place", [0.2, 0.5, 0.8])
def test_a_flipped_byte_is_refused_or_harmless(saved, place):
    content = bytearray(saved.read_bytes())
    content[int(place * len(content))] ^= 0xFF
    saved.write_bytes(bytes(content))
    refusal(saved)


def test_text_is_refused(saved):
    saved.write_text("not an archive")
    assert "expected an NPZ file" in refusal(saved)


def test_a_pickle_is_refused(saved):
    saved.write_bytes(pickle.dumps({"header": 1}))
    refusal(saved)


def test_an_array_of_objects_is_refused(saved):
    rewrite(saved, log_weight=np.array([{}, 1], dtype=object))
    assert "log_weight" in refusal(saved)


def test_another_schema_is_refused(saved):
    edit_header(saved, schema="boomdp-posterior-99")
    assert "expected 'boomdp-posterior-1', got 'boomdp-posterior-99'" in refusal(saved)


def test_a_header_that_is_not_json_is_refused(saved):
    rewrite(saved, header=np.frombuffer(b"{", np.uint8))
    assert "expected JSON" in refusal(saved)


def test_no_header_is_refused(saved):
    rewrite(saved, header=None)
    assert "header" in refusal(saved)


def test_a_header_without_a_scene_is_refused(saved):
    edit_header(saved, scene=None)
    assert "'scene'" in refusal(saved)


def test_a_missing_array_is_named(saved):
    rewrite(saved, **{"params.wheel.heading": None})
    assert "params.wheel.heading: the array is missing" in refusal(saved)


def test_a_foreign_array_is_named(saved):
    rewrite(saved, surprise=np.zeros(3))
    assert "surprise: the array is not known" in refusal(saved)


def test_a_wrong_shape_is_named(saved):
    rewrite(saved, chain=np.zeros(39, np.int32))
    assert "chain: expected shape ['draw']" in refusal(saved)


def test_a_wrong_kind_is_named(saved):
    rewrite(saved, log_density=np.zeros(40, np.int32))
    assert "log_density: expected kind 'f'" in refusal(saved)


def test_no_draws_are_refused(saved):
    with np.load(saved) as file:
        empty = {
            name: array[:0]
            for name, array in file.items()
            if name.startswith("params.")
            or name in ("noise_scale", "log_weight", "log_density", "chain")
        }
    rewrite(saved, **empty)
    assert "at least one draw" in refusal(saved)


def test_another_number_of_bodies_is_refused(saved):
    with np.load(saved) as file:
        header = json.loads(file["header"].tobytes().decode())
    scene = header["scene"]
    scene["bodies"].append({**scene["bodies"][0], "name": "chair"})
    edit_header(saved, scene=scene)
    assert "expected draws of 2 bodies as in the scene, got 1" in refusal(saved)


def test_a_folder_that_is_missing_is_named_by_the_file_given(tmp_path):
    path = tmp_path / "missing" / "post.npz"
    with pytest.raises(FileNotFoundError) as caught:
        table_posterior(4).save(path)
    assert caught.value.filename == str(path)
