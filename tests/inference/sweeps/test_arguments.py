"""Arguments of a sweep: scenes, recordings, shards, rows and structures."""

import numpy as np
import pytest

from boomdp_jax.inference.sweeps.arguments import (
    checked_num_rows,
    checked_shard,
    listed,
    structure_for_file,
)
from tests.inference.made_posteriors import table_spec


@pytest.mark.parametrize(
    ("specs", "histories", "message"),
    [
        (
            "room.json",
            ["a.npz"],
            "specs: expected a SceneSpec or a list of them; .*str",
        ),
        ({"a": 1}, ["a.npz"], "specs: expected a SceneSpec or a list of them; .*dict"),
        ([{"a": 1}], ["a.npz"], "specs: object 0: expected a SceneSpec, .*; got dict"),
        (None, [np.zeros(3)], "histories: object 0: expected a History or .* ndarray"),
        (None, ["a.npz", None], "histories: object 1: expected a History or .* None"),
        (None, np.zeros(3), "histories: expected a History or .*; got ndarray"),
        (None, iter(["a.npz"]), "histories: expected a History or .* a list of them"),
    ],
)
def test_scenes_and_recordings_that_are_none_are_refused(specs, histories, message):
    with pytest.raises(TypeError, match=message):
        listed(table_spec() if specs is None else specs, histories)


@pytest.mark.parametrize("shard", [3, (0.0, 1.0), (0, 1, 2), "01", (False, 1), None])
def test_a_shard_that_is_no_pair_of_whole_numbers_is_refused(shard):
    with pytest.raises(ValueError, match=r"shard: expected \(i, n\) with 0 <= i < n"):
        checked_shard(shard)


def test_rows_and_structures_are_read_as_what_they_should_be():
    assert checked_num_rows(np.int64(3), ["a.npz"]) == 3
    with pytest.raises(ValueError, match=r"num_rows: expected a whole number, .* 2\.5"):
        checked_num_rows(2.5, ["a.npz"])
    with pytest.raises(TypeError, match=r"structure: expected a mapping .*; got str"):
        structure_for_file("wheel")
