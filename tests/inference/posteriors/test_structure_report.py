"""Structures of draws, with symmetric and relabelled ones merged."""

import jax
import numpy as np
import pytest

from boomdp_jax.physics import WORLD, empty_params
from tests.inference.made_posteriors import (
    draws_like,
    make_posterior,
    room_spec,
    table_posterior,
    table_prior,
    table_spec,
)

NUM = 60


def wheel_posterior(heading, viscous, position=(0.1, 0.05)):
    """A table with one wheel in every draw."""
    params = draws_like(
        empty_params(1, num_revolute=1, num_wheel=1, num_ground=1),
        len(heading),
        wheel_active=True,
        wheel_position=np.array(position),
        wheel_heading=np.asarray(heading)[:, None, None],
        wheel_viscous=np.asarray(viscous)[:, None, None],
        wheel_dry=np.inf,
    )
    return make_posterior(table_spec(), params, table_prior())


def first_constraint(posterior):
    return posterior.to_json()["structure"][0]["constraints"][0]


def test_structures_are_the_shares_of_the_draws():
    posterior = table_posterior(num_draws=80)
    assert posterior.structure_probabilities() == pytest.approx(
        {"pin": 0.75, "pin + wheel": 0.25}
    )
    structure = posterior.to_json()["structure"]
    assert [entry["probability"] for entry in structure] == pytest.approx([0.75, 0.25])
    kinds = [[each["type"] for each in entry["constraints"]] for entry in structure]
    assert kinds == [["revolute"], ["revolute", "wheel"]]


def test_weights_count_in_the_probabilities():
    weights = np.where(np.arange(80) % 4 == 0, 9.0, 1.0)
    posterior = table_posterior(num_draws=80, weights=weights)
    assert posterior.structure_probabilities() == pytest.approx(
        {"pin + wheel": 0.75, "pin": 0.25}
    )
    assert next(iter(posterior.structure_probabilities())) == "pin + wheel"


def test_no_constraint_is_called_free():
    params = draws_like(empty_params(1, num_revolute=1, num_wheel=1, num_ground=1), NUM)
    posterior = make_posterior(table_spec(), params, table_prior())
    assert posterior.structure_probabilities() == {"free": pytest.approx(1.0)}
    assert posterior.to_json()["structure"] == [
        {"probability": pytest.approx(1.0), "constraints": []}
    ]


def test_a_wheel_turned_by_pi_is_the_same_wheel():
    heading = np.where(np.arange(NUM) % 2 == 0, 1.4, 1.4 - np.pi)
    pose = first_constraint(wheel_posterior(heading, np.tile([1.0, 20.0], (NUM, 1))))
    assert pose["pose"]["mean"][2] == pytest.approx(1.4, abs=1e-6)
    assert pose["pose"]["sd"][2] == pytest.approx(0.0, abs=1e-6)


def test_a_wheel_turned_by_half_pi_with_swapped_friction_is_the_same_wheel():
    is_turned = np.arange(NUM) % 2 == 0
    heading = np.where(is_turned, 0.3 + 0.5 * np.pi, 0.3)
    viscous = np.where(is_turned[:, None], [20.0, 1.0], [1.0, 20.0])
    wheel = first_constraint(wheel_posterior(heading, viscous))
    assert wheel["pose"]["mean"][2] == pytest.approx(0.3, abs=1e-6)
    assert wheel["viscous"]["mean"][1] == pytest.approx(20.0)


def test_along_and_across_say_what_is_known_of_an_axle_line():
    posterior = table_posterior(num_draws=2000)
    wheel = posterior.to_json()["structure"][1]["constraints"][1]
    assert wheel["across_axle"]["identified"] is True
    assert wheel["across_axle"]["q50"] == pytest.approx(0.05, abs=0.001)
    assert wheel["along_axle"]["identified"] is False
    params = jax.tree.map(np.asarray, posterior.prior_params)
    assert wheel["along_axle"]["sd"] == pytest.approx(
        params.wheel.position.std(), rel=0.1
    )


def test_slots_of_a_body_may_be_swapped_from_draw_to_draw():
    generator = np.random.default_rng(0)
    places = np.array([[-0.2, 0.0], [0.2, 0.1]])
    position = places + 0.01 * generator.normal(size=(NUM, 2, 2))
    order = np.where(np.arange(NUM)[:, None] % 2 == 0, [0, 1], [1, 0])
    shuffled = position[np.arange(NUM)[:, None], order]
    slots = np.zeros((NUM, 3, 2, 2))
    slots[:, 1] = shuffled
    active = np.array([[False] * 2, [True] * 2, [False] * 2])
    empty = empty_params(3, num_revolute=2, num_wheel=2)
    friction = {"wheel_viscous": np.array([1.0, 20.0]), "wheel_dry": np.inf}
    params = draws_like(
        empty, NUM, wheel_active=active, wheel_position=slots, **friction
    )
    prior = draws_like(
        empty,
        500,
        wheel_active=True,
        wheel_position=generator.normal(size=(500, 3, 2, 2)),
        **friction,
    )
    structure = make_posterior(room_spec(), params, prior).to_json()["structure"]
    assert len(structure) == 1
    means = np.array([each["pose"]["mean"][:2] for each in structure[0]["constraints"]])
    means = means[np.argsort(means[:, 0])]
    np.testing.assert_allclose(means, position.mean(axis=0), atol=1e-6)


def test_a_second_wheel_that_was_not_learnt_is_not_identified():
    generator = np.random.default_rng(1)
    empty = empty_params(3, num_revolute=2, num_wheel=2)

    def draw(num):
        active = np.array([[False] * 2, [True] * 2, [False] * 2])
        return draws_like(
            empty,
            num,
            wheel_active=active,
            wheel_position=generator.normal(size=(num, 3, 2, 2)),
            wheel_heading=generator.uniform(-np.pi, np.pi, (num, 3, 2)),
            wheel_viscous=np.array([1.0, 20.0]),
            wheel_dry=np.inf,
        )

    structure = make_posterior(room_spec(), draw(400), draw(400)).to_json()["structure"]
    for wheel in structure[0]["constraints"]:
        assert wheel["pose"]["identified"] == [False, False, False]


def test_the_ends_of_a_joint_may_be_swapped():
    is_swapped = np.arange(NUM) % 2 == 0
    near, far = np.array([0.1, 0.2]), np.array([-0.3, 0.05])
    empty = empty_params(3, num_revolute=2, num_wheel=2)

    def either(first, second):
        value = np.where(is_swapped[:, None], first, second)
        return np.stack([value, np.zeros_like(value)], axis=1)

    params = draws_like(
        empty,
        NUM,
        revolute_active=np.array([True, False]),
        revolute_body_a=np.stack([np.where(is_swapped, 2, 1), np.zeros(NUM)], -1),
        revolute_body_b=np.stack([np.where(is_swapped, 1, 2), np.zeros(NUM)], -1),
        revolute_anchor_a=either(far, near),
        revolute_anchor_b=either(near, far),
        revolute_dry=np.inf,
    )
    posterior = make_posterior(room_spec(), params, params)
    assert posterior.structure_probabilities() == {
        "table–chair pin": pytest.approx(1.0)
    }
    joint = first_constraint(posterior)
    assert (joint["a"], joint["b"]) == ("table", "chair")
    np.testing.assert_allclose(joint["anchor_a"]["mean"], near, atol=1e-6)
    np.testing.assert_allclose(joint["anchor_b"]["mean"], far, atol=1e-6)


def test_the_world_is_always_b():
    params = draws_like(
        empty_params(3, num_revolute=2, num_wheel=2),
        NUM,
        revolute_active=np.array([False, True]),
        revolute_body_a=np.array([0, WORLD]),
        revolute_body_b=np.array([WORLD, 2]),
        revolute_anchor_a=np.array([2.0, 3.0]),
        revolute_anchor_b=np.array([0.1, 0.0]),
        revolute_dry=np.inf,
    )
    joint = first_constraint(make_posterior(room_spec(), params, params))
    assert (joint["a"], joint["b"]) == ("chair", "world")
    np.testing.assert_allclose(joint["anchor_b"]["mean"], [2.0, 3.0], atol=1e-6)


def test_known_constraints_are_no_part_of_the_structure():
    posterior = table_posterior(num_draws=80)
    inferred = {**posterior.inferred, "revolute": np.zeros(1, bool)}
    known = make_posterior(
        posterior.spec, posterior.params, posterior.prior_params, inferred=inferred
    )
    assert known.structure_probabilities() == pytest.approx(
        {"free": 0.75, "wheel": 0.25}
    )
    (pin,) = known.to_json()["known_constraints"]
    anchors = np.asarray(posterior.params.revolute.anchor_a)[:, 0]
    np.testing.assert_allclose(pin["anchor_a"]["mean"], anchors.mean(axis=0))


def test_anchors_are_reported_where_the_outline_was_drawn():
    corners = [[0.0, 0.0], [0.6, 0.0], [0.6, 0.4], [0.0, 0.4]]
    spec = table_spec(shape={"type": "polygon", "vertices": corners})
    centred, moved = table_posterior(80), table_posterior(80, spec=spec)
    for index, key in ((0, "anchor_a"), (1, "pose")):
        here, there = (
            each.to_json()["structure"][1]["constraints"][index][key]
            for each in (centred, moved)
        )
        identified = np.array(here["identified"])[:2]
        offset = np.subtract(there["mean"][:2], here["mean"][:2])
        np.testing.assert_allclose(offset, [0.3, 0.2], atol=1e-6)
        assert identified[0]
    world = moved.to_json()["structure"][1]["constraints"][0]["anchor_b"]["mean"]
    same = centred.to_json()["structure"][1]["constraints"][0]["anchor_b"]["mean"]
    np.testing.assert_allclose(world, same)
