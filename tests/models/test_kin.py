"""What is expected of things that look like others that were tried."""

import dataclasses

import jax
import numpy as np
import pytest

from boomdp_jax.core.arrays import on_device
from boomdp_jax.models.kin import CONCENTRATION, kin_draws, kin_odds
from boomdp_jax.physics import scene_spec_from_dict
from boomdp_jax.physics.params import empty_params


def thing(label, half_extents):
    body = {
        "name": "thing",
        "label": label,
        "shape": {"type": "box", "half_extents": half_extents},
    }
    return scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": 0.1, "bodies": [body]}
    )


def draws(density, pinned):
    num = len(density)
    one = empty_params(1, num_revolute=1)
    many = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], num, 0), one)
    many = jax.tree.map(lambda leaf: on_device(leaf, leaf.dtype), many)
    pins = dataclasses.replace(
        many.revolute, active=on_device(np.full((num, 1), pinned), bool)
    )
    return dataclasses.replace(
        many, density=on_device(np.asarray(density)[:, None]), revolute=pins
    )


def test_the_more_alike_things_look_the_likelier_they_are_of_a_kind():
    chair = thing("chair", [0.25, 0.25])
    same, other = thing("chair", [0.26, 0.25]), thing("couch", [0.26, 0.25])
    large, blank = thing("chair", [1.0, 0.4]), thing(None, [0.26, 0.25])
    odds = kin_odds(chair, [same, blank, other, large], num_labels=3)
    assert odds[0] > odds[1] > odds[2]
    assert odds[0] > odds[3]
    # By the label alone, a Dirichlet's predictive with one draw seen, over the mean.
    assert odds[0] / odds[1] == pytest.approx(3 * 1.1 / 1.3)
    assert odds[2] / odds[1] == pytest.approx(3 * 0.1 / 1.3)


def test_shares_of_draws_are_those_of_the_odds():
    prior, tried = draws(np.full(64, 10.0), False), draws(np.full(64, 40.0), True)
    odds = np.array([3.0 * CONCENTRATION])
    found = kin_draws(np.random.default_rng(0), prior, [tried], odds)
    is_kin = np.asarray(found.revolute.active).reshape(-1)
    assert is_kin.mean() == pytest.approx(0.75, abs=1 / 64)
    density = np.asarray(found.density).reshape(-1)
    assert np.all(density[~is_kin] == 10.0)
    # About what was found of the other, and not all the same.
    assert np.log(density[is_kin]).mean() == pytest.approx(np.log(40.0), abs=0.08)
    assert 0.05 < np.log(density[is_kin]).std() < 0.3
