"""Inference from collisions: blocks, likelihood against closed form, reports."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.blocks.model_sites import block_sites
from boomdp_jax.inference.likelihoods.filter_density import filter_density
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel
from boomdp_jax.inference.posteriors.contact_numbers import with_contact_numbers
from boomdp_jax.inference.posteriors.posterior import load_posterior
from boomdp_jax.inference.readings.components import independent_blocks
from boomdp_jax.inference.readings.touching import find_touching
from boomdp_jax.physics import Surface, empty_params, scene_spec_from_dict
from tests.inference.made_posteriors import make_posterior
from tests.inference.two_discs import (
    DT,
    NOISE,
    RADIUS,
    approaching,
    discs_spec,
    log_marginal,
    record,
)

OPEN = {"friction": None, "restitution": None}
GIVEN = {"friction": 0.4, "restitution": 0.3}


def room(*, ball=OPEN, wall=OPEN, group=None):
    """Three discs in a row and a wall to the right of the third."""
    mine = ball if group is None else {**ball, "group": group}
    bodies = [
        {"name": name, "shape": {"type": "circle", "radius": 0.1}, "contact": mine}
        for name in "abc"
    ]
    bodies.append(
        {
            "name": "wall",
            "shape": {"type": "box", "half_extents": [0.1, 1.0]},
            "pose": [2.1, 0.0, 0.0],
            "static": True,
            "contact": wall,
        }
    )
    return scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": DT, "bodies": bodies}, source="test"
    )


def standing(x, *, moves=(), num=8, noise=0.0):
    """Poses without rates; bodies of the first axis move to the right by so much."""
    rng = np.random.default_rng(0)
    pose = np.zeros((num, 4, 3))
    pose[:, :3, 0] = x
    pose[:, 3, 0] = 2.1
    for body, way in moves:
        pose[:, body, 0] += np.linspace(0.0, way, num)
    pose[:, :3] += noise * rng.standard_normal((num, 3, 3))
    state = np.full((num, 4, 6), np.nan)
    state[..., :3] = pose
    return make_history(state[:-1], np.zeros((num - 1, 4, 3)), state[1:], DT)


def blocks_of(spec, history):
    return independent_blocks(spec, history, find_touching(spec, history))[0]


def test_bodies_that_never_come_near_each_other_are_apart():
    history = standing([0.0, 0.5, 1.0], moves=[(0, 0.2)])
    assert blocks_of(room(), history) == [(0,), (1,), (2,)]


def test_bodies_that_may_have_touched_are_one_block():
    history = standing([0.0, 0.5, 1.0], moves=[(0, 0.3)])
    assert blocks_of(room(ball=GIVEN), history) == [(0, 1), (2,)]


def test_a_touch_between_two_readings_is_not_missed():
    """They are 0.1 m apart at both ends of a step in which one passed the other."""
    history = standing([0.0, 0.5, 1.4], moves=[(0, 1.0)], num=2)
    assert blocks_of(room(ball=GIVEN), history) == [(0, 1), (2,)]


def test_noise_of_readings_widens_what_may_have_touched():
    far = standing([0.0, 0.22, 1.0])
    assert blocks_of(room(ball=GIVEN), far) == [(0,), (1,), (2,)]
    noisy = standing([0.0, 0.22, 1.0], noise=5e-3, num=30)
    assert blocks_of(room(ball=GIVEN), noisy) == [(0, 1), (2,)]


def test_bodies_of_a_group_are_apart():
    history = standing([0.0, 0.2, 1.0])
    assert blocks_of(room(group="team"), history) == [(0,), (1,), (2,)]


def test_open_numbers_join_all_that_they_are_about():
    """a and b meet, c meets the wall: one friction and one restitution for all."""
    history = standing([0.0, 0.2, 1.9])
    assert blocks_of(room(), history) == [(0, 1, 2)]
    assert blocks_of(room(ball=GIVEN, wall=GIVEN), history) == [(0, 1), (2,)]


def test_without_readings_nothing_has_touched():
    empty = np.zeros((0, 4, 6))
    history = make_history(empty, empty[..., :3], empty, DT, capacity=4)
    assert blocks_of(room(), history) == [(0,), (1,), (2,)]


def test_a_scene_without_contact_has_nothing_that_touches():
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "bodies": [
                {"name": name, "shape": {"type": "circle", "radius": 0.1}}
                for name in "ab"
            ],
        }
    )
    empty = np.zeros((0, 2, 6))
    assert find_touching(spec, make_history(empty, empty[..., :3], empty, DT)) is None


def block_of(spec, history, bodies):
    return make_block(spec, bodies, history, touching=find_touching(spec, history))


def test_an_open_number_is_one_for_all_surfaces_of_a_block():
    spec = room(wall={"friction": None, "restitution": 0.9})
    block = block_of(spec, standing([0.0, 0.2, 1.9]), (0, 1, 2))
    assert block.layout.contact == ("friction", "restitution")
    assert block.layout.dim == 5
    likelihood: Any = block.target.log_likelihood
    z = jnp.array([0.0, 0.0, 0.0, 1.0, -0.5])
    surface = likelihood.coordinates(z, jnp.zeros(0, bool)).surface
    friction = 0.3 * np.exp(0.8)
    restitution = 1.0 / (1.0 + np.exp(0.5 * 1.5))
    np.testing.assert_allclose(surface.friction, [friction] * 4, rtol=1e-6)
    np.testing.assert_allclose(
        surface.restitution, [restitution] * 3 + [0.9], rtol=1e-6
    )


def test_known_numbers_of_contact_have_no_coordinates():
    spec = room(ball=GIVEN, wall=GIVEN)
    block = block_of(spec, standing([0.0, 0.2, 1.0]), (0, 1))
    assert block.layout.contact == ()
    likelihood: Any = block.target.log_likelihood
    surface = likelihood.coordinates(jnp.zeros(2), jnp.zeros(0, bool)).surface
    np.testing.assert_allclose(surface.friction, [0.4, 0.4])


def test_numbers_of_contact_are_sites_of_the_model():
    spec = room()
    block = block_of(spec, standing([0.0, 0.2, 1.0]), (0, 1))
    sites = {site.name: site for site in block_sites(block, ("a", "b"))}
    assert sites["contact.friction"].link == "log"
    assert sites["contact.restitution"].link == "logit"
    z = jnp.array([0.0, 0.0, 0.7, -0.3])
    for name, place in (("contact.friction", 2), ("contact.restitution", 3)):
        value = sites[name].from_coordinates(z)
        found = sites[name].to_coordinates(value)
        np.testing.assert_allclose(found, [z[place]], atol=1e-6)


# Where in a step they meet decides what a filter makes of it.
@pytest.mark.parametrize("share", [0.04, 0.5, 0.97])
def test_likelihood_is_that_of_the_closed_form(share):
    rng = np.random.default_rng(7)
    truth = (1.5, 0.8, 0.7, 0.05)
    start = approaching(rng, (12.0 + share) * DT, closing=(0.8, 0.9))
    history = record(rng, start, truth, 26)
    spec = discs_spec()
    block = block_of(spec, history, (0, 1))
    likelihood: Any = block.target.log_likelihood
    coordinates = likelihood.coordinates
    reading = jnp.array([NOISE[0], NOISE[2], 4e-3, 4e-3])
    noise = NoiseLevel(jnp.tile(reading, (2, 1)), jnp.full((2, 2), 1e-6))
    area = np.pi * RADIUS**2

    @jax.jit
    def of(z):
        params = coordinates(z, jnp.zeros(0, bool))
        return filter_density(coordinates.world, params, likelihood.data, noise)

    exact, ours = [], []
    # By about one and two sds of each number from the truth.
    for ratio, bounce in ((0, 0), (0.01, 0), (-0.01, 0.005), (0.01, -0.01)):
        m, n = truth[0] * np.exp(ratio), truth[1]
        restitution = truth[2] + bounce
        exact.append(log_marginal(history, start, (m, n, restitution, truth[3])))
        density = np.log(np.array([m, n]) / area / 30.0) / 1.5
        rub = np.log(truth[3] / 0.3) / 0.8
        logit = np.log(restitution / (1.0 - restitution)) / 1.5
        ours.append(float(of(jnp.array([*density, rub, logit]))))
    # Differences of tenths to several nats; what Laplace's method and a linear filter
    # leave out is of third order.
    assert np.ptp(exact) > 0.5
    np.testing.assert_allclose(
        np.subtract(ours, ours[0]), np.subtract(exact, exact[0]), atol=0.15
    )


def test_rows_in_which_nothing_is_near_are_worked_out_without_contact():
    """They meet in row 12 of 26; readings say the same as with contact in all."""
    rng = np.random.default_rng(5)
    start = approaching(rng, 12.5 * DT, closing=(0.8, 0.9))
    history = record(rng, start, (1.5, 0.8, 0.7, 0.05), 26).padded(32)
    block = block_of(discs_spec(), history, (0, 1))
    likelihood: Any = block.target.log_likelihood
    near = np.asarray(likelihood.data.may_touch)
    assert near[11:14].all()
    assert near.sum() < 9
    coordinates, data = likelihood.coordinates, likelihood.data
    reading = jnp.array([NOISE[0], NOISE[2], 4e-3, 4e-3])
    noise = NoiseLevel(jnp.tile(reading, (2, 1)), jnp.full((2, 2), 1e-6))

    @jax.jit
    def of(z, data):
        params = coordinates(z, jnp.zeros(0, bool))
        return filter_density(coordinates.world, params, data, noise)

    everywhere = dataclasses.replace(data, may_touch=jnp.ones_like(data.may_touch))
    nowhere = dataclasses.replace(data, may_touch=jnp.zeros_like(data.may_touch))
    for z in 0.3 * rng.standard_normal((4, 4)):
        told = float(of(jnp.asarray(z), data))
        assert told == pytest.approx(float(of(jnp.asarray(z), everywhere)), abs=1e-5)
        # The test can fail: without contact where they meet nothing is explained.
        assert told > float(of(jnp.asarray(z), nowhere)) + 100.0


def test_what_no_block_says_comes_from_the_prior():
    spec = discs_spec(prior={"contact.friction": {"center": 0.2, "spread": 0.5}})
    params = empty_params(2)
    params = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (20000, *leaf.shape)), params
    )
    rng = np.random.default_rng(0)
    surface = with_contact_numbers(rng, spec, [], [], params).surface
    assert surface is not None
    np.testing.assert_array_equal(surface.friction[:, 0], surface.friction[:, 1])
    log_friction = np.log(np.asarray(surface.friction[:, 0]))
    logit = np.asarray(surface.restitution[:, 0])
    logit = np.log(logit) - np.log1p(-logit)
    # Five standard errors of means and sds of 20,000 draws.
    assert log_friction.mean() == pytest.approx(np.log(0.2), abs=5 * 0.5 / 141)
    assert log_friction.std() == pytest.approx(0.5, rel=5 / 200)
    assert logit.mean() == pytest.approx(0.0, abs=5 * 1.5 / 141)
    assert logit.std() == pytest.approx(1.5, rel=5 / 200)


def test_params_stay_as_they_are_where_nothing_of_contact_is_open():
    params = empty_params(2)
    spec = discs_spec(contact=GIVEN)
    rng = np.random.default_rng(0)
    assert with_contact_numbers(rng, spec, [], [], params) is params


def known_contact():
    """A posterior that knows restitution, and nothing of friction."""
    rng = np.random.default_rng(3)

    def many(num, restitution):
        params = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), empty_params(2)
        )
        friction = np.exp(np.log(0.3) + 0.8 * rng.standard_normal(num))
        both = [np.tile(x[:, None], (1, 2)) for x in (friction, restitution)]
        surface = Surface(*map(jnp.asarray, both))
        return dataclasses.replace(params, surface=surface)

    told = 0.6 + 0.01 * rng.standard_normal(400)
    logit = 1.5 * rng.standard_normal(1000)
    return make_posterior(
        discs_spec(), many(400, told), many(1000, 1.0 / (1.0 + np.exp(-logit)))
    )


def test_reports_say_what_is_known_of_contact():
    posterior = known_contact()
    contact = posterior.to_json()["contact"]
    assert contact["restitution"]["bodies"] == ["a", "b"]
    assert contact["restitution"]["identified"]
    assert contact["restitution"]["mean"] == pytest.approx(0.6, abs=0.003)
    assert not contact["friction"]["identified"]
    lines = posterior.summary().splitlines()
    place = lines.index("contact")
    assert "friction" in lines[place + 1]
    assert "(prior) (a, b)" in lines[place + 1]
    assert "0.60" in lines[place + 2]
    assert "(prior)" not in lines[place + 2]


def test_a_ratio_of_masses_is_known_where_the_masses_are_not():
    """Masses by a common unknown factor: their ratio is 2 to one part in a hundred."""
    rng = np.random.default_rng(4)
    spec = discs_spec(contact=GIVEN)
    area = [body.area for body in spec.bodies]

    def with_masses(first, second):
        params = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (len(first), *leaf.shape)),
            empty_params(2),
        )
        density = np.stack([first / area[0], second / area[1]], axis=1)
        return dataclasses.replace(params, density=jnp.asarray(density))

    factor = np.exp(1.5 * rng.standard_normal(500))
    ratio = 2.0 * np.exp(0.01 * rng.standard_normal(500))
    prior = np.exp(1.5 * rng.standard_normal((2, 1000)))
    posterior = make_posterior(
        spec, with_masses(ratio * factor, factor), with_masses(*prior)
    )
    (found,) = posterior.to_json()["mass_ratios"]
    assert found["bodies"] == ["a", "b"]
    assert found["identified"]
    assert found["q50"] == pytest.approx(2.0, rel=2e-3)
    assert found["sd"] == pytest.approx(0.02, rel=0.15)
    lines = posterior.summary().splitlines()
    assert lines[lines.index("ratios of masses") + 1].startswith("  a / b")
    known = dataclasses.replace(
        posterior, spec=discs_spec(contact=GIVEN, density=(1.0, 2.0))
    )
    assert "mass_ratios" not in known.to_json()


def test_reports_of_scenes_without_open_contact_say_nothing_of_it():
    posterior = known_contact()
    posterior = dataclasses.replace(posterior, spec=discs_spec(contact=GIVEN))
    assert "contact" not in posterior.to_json()


def test_contact_survives_a_file(tmp_path):
    posterior = known_contact()
    posterior.save(tmp_path / "post.npz")
    loaded = load_posterior(tmp_path / "post.npz")
    for name in ("params", "prior_params"):
        before, after = getattr(posterior, name), getattr(loaded, name)
        np.testing.assert_array_equal(
            before.surface.restitution, after.surface.restitution
        )
        np.testing.assert_array_equal(before.surface.friction, after.surface.friction)
    assert loaded.to_json()["contact"] == posterior.to_json()["contact"]


def test_a_file_with_half_a_surface_is_refused(tmp_path):
    path = tmp_path / "post.npz"
    known_contact().save(path)
    with np.load(path) as file:
        arrays = dict(file)
    del arrays["prior_params.surface.friction"]
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=r"surface\.friction: the array is missing"):
        load_posterior(path)


def test_arviz_has_contact():
    pytest.importorskip("arviz")
    data: Any = known_contact().to_arviz()
    values = np.asarray(data["posterior"]["contact_restitution"])
    assert values.shape[-1] == 2
    assert values.mean() == pytest.approx(0.6, abs=0.003)
