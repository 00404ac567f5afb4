"""The NumPyro model: its prior, its joint density, handlers, names, refusals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
import scipy.integrate
import scipy.stats
from numpyro.handlers import condition, seed, substitute, trace
from numpyro.infer import SVI, Predictive, Trace_ELBO, log_likelihood
from numpyro.infer.autoguide import AutoNormal
from numpyro.infer.initialization import init_to_median
from numpyro.infer.util import log_density

from boomdp_jax.core import make_history
from boomdp_jax.inference.blocks.fixed_structure import (
    fix_structure,
    scene_layout,
    structure_blocks,
)
from boomdp_jax.inference.blocks.model_sites import coordinate_names
from boomdp_jax.inference.likelihoods.one_step import OneStepLikelihood
from boomdp_jax.inference.under_numpyro.numpyro_model import make_model
from boomdp_jax.physics import empty_params, rollout, scene_spec_from_dict

THREE = {"table": ["revolute", "wheel", "ground"]}


def make_spec(*, names=("table",), **fields):
    """Boxes of 0.4 m by 0.2 m on a floor."""
    body = {"shape": {"type": "box", "half_extents": [0.2, 0.1]}, "pose": [0, 0, 0]}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [{"name": name, **body} for name in names],
            "unknown": {"revolute": 1, "wheel": 1, "ground": 1, "distance": 1},
            **fields,
        }
    )


def pushed(spec, num_rows=20, seed=0):
    """Free boxes of 2.4 kg under random pushes, read with noise."""
    rng = np.random.default_rng(seed)
    num = spec.num_bodies
    wrench = rng.normal(size=(num_rows, num, 3)) * [8.0, 8.0, 1.0]
    params = empty_params(num, density=30.0)
    start = spec.initial_state()
    states, _ = rollout(spec.scene, params, start, jnp.asarray(wrench))
    truth = np.concatenate([start.array[None], states.array])
    noise = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
    reading = truth[1:] + noise * rng.normal(size=truth[1:].shape)
    return make_history(truth[:-1], wrench, reading, 0.02)


def test_coordinates_have_the_names_of_their_sites():
    unknown = dict.fromkeys(("revolute", "wheel", "weld", "prismatic"), 1)
    unknown |= {"center_of_mass": True, "actuator": ["gain", "bias"]}
    spec = make_spec(unknown=unknown)
    structure = {"table": ["revolute", "wheel"]}
    model = make_model(spec, pushed(make_spec()), structure)
    names = coordinate_names(("table",), model.blocks[0].layout)
    assert sum(len(site.coordinates) for site in model.sites[0]) == len(names)
    for site in model.sites[0]:
        for place, coordinate in enumerate(site.coordinates):
            ending = f"[{place}]" if len(site.coordinates) > 1 else ""
            assert names[coordinate] == site.name + ending


@pytest.fixture(scope="module")
def spec():
    return make_spec()


@pytest.fixture(scope="module")
def model(spec):
    return make_model(spec, pushed(spec), THREE)


def numbers(model, key, values=None):
    """Every number that the model samples or records, next states left out."""
    tr = trace(seed(substitute(model, values or {}), key)).get_trace()
    kept = {name for name, site in tr.items() if site["type"] != "plate"}
    return {name: tr[name]["value"] for name in kept - {"next_state"}}


@pytest.fixture(scope="module")
def prior(model):
    return drawn(model, 4000)


def drawn(model, num):
    """Draws from the prior."""
    # Compiled, so that the physics, which is not asked for, is left out.
    keys = jax.random.split(jax.random.key(0), num)
    return jax.jit(jax.vmap(lambda key: numbers(model, key)))(keys)


def passes(draws, distribution):
    """Kolmogorov and Smirnov's test; a false alarm once in ten thousand."""
    return scipy.stats.kstest(np.asarray(draws), distribution.cdf).pvalue > 1e-4


def lognormal(median, spread):
    return scipy.stats.lognorm(spread, scale=median)


@pytest.mark.slow
def test_prior_draws_follow_the_stated_distributions(prior):
    mass = prior["table.mass"]
    np.testing.assert_allclose(mass, prior["table.density"] * 0.08)
    closed_forms = {
        "table.density": lognormal(30.0, 1.5),
        "table.revolute.viscous_rate": lognormal(0.1, 2.0),
        "table.wheel.lateral_limit": lognormal(0.5, 0.7),
        "table.wheel.half_track": lognormal(0.2 * np.hypot(0.2, 0.1), 0.7),
        "table.ground.dry": lognormal(0.3, 0.8),
    }
    for name, distribution in closed_forms.items():
        assert passes(prior[name], distribution), name
    half_turn = scipy.stats.uniform(-np.pi / 2, np.pi)
    assert passes(prior["table.wheel.heading"], half_turn)
    assert passes(prior["table.wheel.position"][:, 0], scipy.stats.norm(0, 0.7 * 0.2))
    assert passes(prior["table.wheel.position"][:, 1], scipy.stats.norm(0, 0.7 * 0.1))
    # Viscous wheel friction over mass, lateral, then rolling over lateral.
    lateral, ratio = (
        prior["table.wheel.viscous"][:, 1] / mass,
        prior["table.wheel.viscous"][:, 0] / prior["table.wheel.viscous"][:, 1],
    )
    assert passes(lateral, lognormal(60.0, 1.2))
    assert passes(np.log(ratio / (1 - ratio)), scipy.stats.norm(-2.5, 1.25))
    knee = prior["table.ground.dry"] * mass * 9.81 / prior["table.ground.viscous"]
    assert passes(knee, lognormal(0.02, 1.2))
    for group, scale in (("position", 1e-3), ("spin", 4e-3)):
        variance = scipy.stats.invgamma(1.0, scale=scale**2)
        assert passes(prior[f"noise.{group}"][:, 0] ** 2, variance)


@pytest.mark.slow
def test_pins_are_where_the_readings_have_their_anchors(spec, prior):
    history = pushed(spec)
    poses = np.concatenate([history.state, history.next_state])[:, 0, :3]
    spread = np.sqrt(((poses[:, :2] - poses[:, :2].mean(0)) ** 2).sum(-1).mean())
    radius = np.hypot(0.2, 0.1)
    anchor_a = np.asarray(prior["table.revolute.anchor_a"])
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    turn = np.moveaxis(np.array([[cos, -sin], [sin, cos]]), -1, 0)
    met = np.mean(poses[:, None, :2] + anchor_a @ turn.swapaxes(1, 2), axis=0)
    off = np.asarray(prior["table.revolute.anchor_b"]) - met
    np.testing.assert_allclose(off, prior["table.revolute.offset"], atol=1e-9)
    for axis in range(2):
        assert passes(anchor_a[:, axis], scipy.stats.norm(0, radius + spread))
        assert passes(off[:, axis], scipy.stats.johnsonsu(0, 1, scale=0.01 * radius))
    rod = drawn(make_model(spec, history, {"table": ["distance"]}), 2000)
    end = np.asarray(rod["table.distance.anchor_a"]) @ turn[0].T + poses[0, :2]
    gap = np.hypot(*np.transpose(end - rod["table.distance.anchor_b"]))
    assert passes(rod["table.distance.length"] / gap, lognormal(1.0, 0.1))


@pytest.mark.slow
def test_sites_and_coordinates_give_the_same_hypothesis(model):
    (block,) = model.blocks
    coordinates = block.target.log_likelihood.coordinates
    z = 0.4 * jax.random.normal(jax.random.key(1), (block.layout.dim,))
    values = {site.name: site.from_coordinates(z) for site in model.sites[0]}
    found = jax.jit(lambda key: numbers(model, key, values))(jax.random.key(0))
    params = eqx.filter_jit(coordinates)(z, jnp.ones(3, bool))
    for name, expected in {
        "table.mass": params.density[0] * 0.08,
        "table.revolute.anchor_b": params.revolute.anchor_b[0],
        "table.revolute.viscous": params.revolute.viscous[0],
        "table.revolute.dry": params.revolute.dry[0],
        "table.wheel.position": params.wheel.position[0, 0],
        "table.wheel.viscous": params.wheel.viscous[0, 0],
        "table.wheel.dry": params.wheel.dry[0, 0],
        "table.ground.viscous": params.ground.viscous[0, 0],
        "table.ground.load_shift": params.ground.load_shift[0, 0],
    }.items():
        np.testing.assert_allclose(found[name], expected, rtol=1e-12)


def with_noise(values, noise):
    groups = ("position", "angle", "velocity", "spin")
    scales = {f"noise.{g}": s[None] for g, s in zip(groups, noise, strict=True)}
    return {**values, **scales}


@pytest.mark.slow
def test_integrated_over_the_noise_the_joint_density_is_the_targets(spec):
    """Groups are independent, so four integrals in one dimension do it."""
    model = make_model(spec, pushed(spec), {"table": ["revolute"]})
    (block,) = model.blocks
    sites = model.sites[0]

    def joint(z, noise):
        values = {site.name: site.from_coordinates(z) for site in sites}
        return log_density(model, (), {}, with_noise(values, noise))[0]

    def log_volume(z):
        """From coordinates to physical numbers."""

        def numbers(z):
            return jnp.concatenate([s.from_coordinates(z).ravel() for s in sites])

        return jnp.linalg.slogdet(jax.jacfwd(numbers)(z))[1]

    logs = np.linspace(-14.0, 8.0, 3001)
    base = np.full(4, 0.05)
    noise = np.tile(base, (4, logs.size, 1))
    noise[np.arange(4), :, np.arange(4)] = np.exp(logs)
    noise = jnp.asarray(np.concatenate([base[None], noise.reshape(-1, 4)]))
    densities = jax.jit(jax.vmap(joint, (None, 0)))
    for key in jax.random.split(jax.random.key(2), 3):
        z = 0.3 * jax.random.normal(key, (block.layout.dim,))
        value = np.asarray(densities(z, noise))
        total = value[0] + float(log_volume(z))
        for change in value[1:].reshape(4, -1) - value[0]:
            integrand = change + logs
            top = integrand.max()
            total += top + np.log(
                scipy.integrate.simpson(np.exp(integrand - top), x=logs)
            )
        expected = float(eqx.filter_jit(block.target.log_density)(jnp.asarray(0), z))
        assert total == pytest.approx(expected, rel=1e-8)


@pytest.mark.slow
def test_scalar_noise_is_one_normal_likelihood_over_all_that_was_read(spec):
    history = pushed(spec)
    free = make_model(spec, history, noise="scalar")
    values = {"table.density": jnp.asarray(25.0), "noise": jnp.asarray(0.02)}
    (block,) = free.blocks
    z = free.sites[0][0].to_coordinates(values["table.density"])
    tracked = block.target.log_likelihood
    plain = OneStepLikelihood(tracked.coordinates, tracked.data.steps)
    residuals = plain.residuals(z, jnp.zeros(0, bool))
    found, _ = log_density(free, (), {}, values)
    middle = 2e-3  # The geometric mean of 1, 1, 4, 4 mm and so on.
    variance = scipy.stats.invgamma(1.0, scale=middle**2)
    expected = (
        scipy.stats.norm(0, 0.02).logpdf(residuals).sum()
        + lognormal(30.0, 1.5).logpdf(25.0)
        + variance.logpdf(0.02**2)
        + np.log(2 * 0.02)
    )
    assert float(found) == pytest.approx(expected, rel=1e-10)


@pytest.mark.slow
def test_missing_channels_do_not_count_and_angles_take_the_shorter_turn(spec):
    history = pushed(spec)
    read = np.array(history.next_state)
    values = with_noise({"table.density": jnp.asarray(25.0)}, jnp.full(4, 0.01))

    def density(next_state):
        table = make_history(history.state, history.action, next_state, 0.02)
        return float(log_density(make_model(spec, table), (), {}, values)[0])

    turned = read.copy()
    turned[3, 0, 2] += 4.0 * np.pi
    assert density(turned) == pytest.approx(density(read), rel=1e-10)
    missing, wrong = read.copy(), read.copy()
    missing[5, 0, 4], wrong[5, 0, 4] = np.nan, read[5, 0, 4] + 0.03
    likelihood = density(wrong) - density(missing)
    predicted = history.state[5, 0, 4] + history.action[5, 0, 1] * 0.02 / (25 * 0.08)
    expected = scipy.stats.norm(predicted, 0.01).logpdf(wrong[5, 0, 4])
    assert likelihood == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_prior_predictions_are_the_steps_of_the_drawn_hypothesis(spec):
    history = pushed(spec, num_rows=6)
    free = make_model(spec, history)
    draws = Predictive(free, num_samples=2000)(jax.random.key(3), is_observed=False)
    assert draws["next_state"].shape == (2000, 6, 1, 6)
    mass = draws["table.mass"]
    push = history.action[2, 0, 0] * 0.02 / mass
    error = draws["next_state"][:, 2, 0, 3] - history.state[2, 0, 3] - push
    scaled = error / draws["noise.velocity"][:, 0]
    assert passes(scaled, scipy.stats.norm)


@pytest.mark.slow
def test_other_rows_are_predicted_from_their_own_states(spec):
    free = make_model(spec, pushed(spec))
    later = pushed(spec, num_rows=9, seed=1)
    values = {"table.density": jnp.asarray([30.0])}
    values |= {f"noise.{g}": jnp.full((1, 1), 1e-9) for g in ("position", "angle")}
    values |= {f"noise.{g}": jnp.full((1, 1), 1e-9) for g in ("velocity", "spin")}
    draws = Predictive(free, values)(jax.random.key(0), later, is_observed=False)
    found = draws["next_state"][0, :, 0]
    # Noise of what was read is up to five standard deviations of 5 mm/s.
    np.testing.assert_allclose(found, later.next_state[:, 0], atol=0.025)
    observed = log_likelihood(free, values, later)["next_state"]
    assert observed.shape == (1, 9, 1)


@pytest.mark.slow
def test_handlers_and_svi_work(spec):
    free = make_model(spec, pushed(spec))
    fixed = condition(free, {"table.density": 12.0})
    tr = trace(seed(fixed, 0)).get_trace()
    assert float(tr["table.mass"]["value"]) == pytest.approx(12.0 * 0.08)
    assert tr["table.density"]["is_observed"]
    guide = AutoNormal(free, init_loc_fn=init_to_median)
    svi = SVI(free, guide, numpyro.optim.Adam(0.01), Trace_ELBO())
    state = svi.init(jax.random.key(0))
    before = svi.get_params(state)
    state, loss = svi.update(state)
    assert np.isfinite(loss)
    moved = svi.get_params(state)["table.density_auto_loc"]
    assert moved != before["table.density_auto_loc"]


@pytest.mark.slow
def test_numbers_that_the_scene_gives_have_no_site():
    pin = {
        "type": "revolute",
        "a": "table",
        "b": "world",
        "anchor_a": [0.1, None],
        "anchor_b": [1.0, 2.0],
        "viscous": 0.0,
    }
    spec = make_spec(constraints=[pin], unknown={"wheel": 1})
    tr = trace(seed(make_model(spec, pushed(spec)), 0)).get_trace()
    sampled = {name for name, site in tr.items() if site["type"] == "sample"}
    noise = {f"noise.{g}" for g in ("position", "angle", "velocity", "spin")}
    expected = {"table.density", "table.revolute.anchor_a[1]", "next_state"}
    assert sampled - noise == expected
    anchor = tr["table.revolute.anchor_a"]["value"]
    np.testing.assert_allclose(anchor[0], 0.1)
    np.testing.assert_allclose(anchor[1], tr["table.revolute.anchor_a[1]"]["value"])
    assert "table.revolute.anchor_b" not in tr


@pytest.mark.slow
def test_bodies_that_a_structure_does_not_tie_are_separate_blocks():
    spec = make_spec(names=("cart", "pole", "box"))
    history = pushed(spec)
    structure = {"pole": [("revolute", "cart")], "box": ["wheel"]}
    blocks = structure_blocks(spec, history, structure)
    assert [block.bodies for block in blocks] == [(0, 1), (2,)]
    model = make_model(spec, history, structure)
    names = [site.name for sites in model.sites for site in sites]
    assert "cart.revolute_to_pole.offset" in names
    assert "box.wheel.heading" in names
    assert model.bodies == (0, 1, 2)
    drawn = jax.eval_shape(lambda key: numbers(model, key), jax.random.key(0))
    assert drawn["noise.angle"].shape == (3,)
    assert drawn["cart.revolute_to_pole.viscous"].shape == ()


def test_a_choice_of_slots_is_the_same_as_its_names(spec):
    slots = scene_layout(spec).slots
    mask = np.array([slot.kind in ("revolute", "ground") for slot in slots])
    by_mask = fix_structure(spec, mask)
    by_name = fix_structure(spec, {"table": ["revolute", "ground"]})
    assert [c.kind for c in by_mask.constraints] == ["revolute", "ground"]
    assert [c.kind for c in by_name.constraints] == ["revolute", "ground"]
    assert not any(by_mask.unknown.values())


@pytest.mark.parametrize(
    ("structure", "message"),
    [
        ({"tabel": ["wheel"]}, r"a body that can move \(table, chair\), got 'tabel'"),
        ({"table": ["hinge"]}, "table: expected one of revolute, .*; got 'hinge'"),
        ({"table": "wheel"}, "table: expected a list of kinds .*, got 'wheel'"),
        ({"table": [3]}, "table: expected one of .*; got 3"),
        ({"table": ["wheel", "wheel"]}, "table: wheel: expected at most 1 .*, got 2"),
        ({"table": [("revolute", "lamp")]}, "partner chair; got 'lamp'"),
        ({"table": [("wheel", "chair")]}, "partner the world; got 'chair'"),
        (np.array([True]), "or 10 booleans .*; got bool of shape"),
    ],
)
def test_structures_that_the_scene_does_not_have_are_refused(structure, message):
    spec = make_spec(names=("table", "chair"))
    with pytest.raises(ValueError, match=message):
        fix_structure(spec, structure)


def test_other_bad_input_is_refused(spec):
    history = pushed(spec)
    with pytest.raises(ValueError, match="noise: expected groups or scalar, got 'no'"):
        make_model(spec, history, noise="no")
    with pytest.raises(ValueError, match="history: expected 2 bodies, got 1"):
        make_model(make_spec(names=("table", "chair")), history)
    hung = make_spec(gravity=[0.0, -9.81], normal_gravity=0.0)
    with pytest.raises(ValueError, match=r"at most 0 \(nothing presses"):
        fix_structure(hung, {"table": ["ground"]})
    wall = {"name": "wall", "shape": {"type": "circle", "radius": 1.0}, "static": True}
    wall = scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": 0.1, "bodies": [wall | {"pose": [0, 0, 0]}]}
    )
    with pytest.raises(ValueError, match="expected a body that can move, got none"):
        make_model(wall, history)
