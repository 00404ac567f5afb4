"""Simulation-based calibration, all stages from fits to noise, and a planted mistake.

Boxes are drawn from the prior: density, wheel, friction of the floor, and which of them
exist; noise, too. Readings are of single steps from states that are known exactly,
which is what likelihood `one-step` says, so that the posterior should be exact. Then
the rank of any function of the truth among posterior draws is uniform. Parameters and
structure alone are blind to a posterior that ignores the data: it is planted, passes
all of those, and must fail by the rank of the log-likelihood. Talts et al. (2018),
Validating Bayesian inference algorithms with simulation-based calibration; Modrák et
al. (2023), Simulation-based calibration checking for Bayesian computation.
"""

import functools
from typing import NamedTuple

import jax
import numpy as np
import pytest
from jaxtyping import Array

from boomdp_jax.inference.likelihoods.exact_starts import ExactStarts
from boomdp_jax.inference.sample import sample_blocks
from boomdp_jax.inference.samplers import enumerate_structures
from boomdp_jax.inference.samplers.adapt_mixture import adapt_mixtures
from boomdp_jax.inference.samplers.structure_draws import SampleSettings
from boomdp_jax.physics import Params, State, step
from tests.inference.prior_objects import PriorObjects, draw_objects
from tests.reference.ranks import NUM_DRAWS, rank, thin, uniformity

pytestmark = pytest.mark.slow

NUM_OBJECTS, NUM_ROWS = 320, 10
FALSE_ALARM = 1e-3
"""Chance that a sampler without fault fails any of its ranks."""

CAUGHT = 1e-6
"""A planted mistake counts as caught where chance would do as much this rarely."""


SETTINGS = SampleSettings(num_chains=1, num_samples=96, num_importance=512)


class Draws(NamedTuple):
    """Of all objects, leading axes `object` and `draw`."""

    params: Params
    noise_scale: np.ndarray


@pytest.fixture(scope="module")
def objects() -> PriorObjects:
    return draw_objects(np.random.default_rng(41), NUM_OBJECTS, NUM_ROWS)


@jax.jit
def _decode(coordinates, z: Array, active: Array) -> Params:
    """Params of hypotheses `[object, draw]`."""
    over_draws = jax.vmap(lambda c, z, active: c(z, active), (None, 0, 0))
    return jax.vmap(over_draws)(coordinates, z, active)


def decoded(objects: PriorObjects, structure, z, noise_scale) -> Draws:
    """Hypotheses with leading axes `object` and `draw`."""
    coordinates = objects.targets.log_likelihood.coordinates
    active = np.asarray(objects.targets.structures[0])[structure]
    return Draws(_decode(coordinates, z, active), noise_scale)


@pytest.fixture(scope="module")
def truths(objects) -> Draws:
    """One draw of each object."""
    return decoded(
        objects,
        objects.structure[:, None],
        objects.z[:, None],
        objects.noise_scale[:, None, None],
    )


@pytest.fixture(scope="module")
def posteriors(objects) -> Draws:
    """As many of each as ranks need, by all stages from fits to noise."""
    with pytest.MonkeyPatch.context() as patch:
        # Rounds of adaptation make weights more even and nothing more exact; six
        # of them would take most of the test's time.
        few = functools.partial(adapt_mixtures, max_rounds=1)
        patch.setattr(enumerate_structures, "adapt_mixtures", few)
        found = sample_blocks(
            jax.random.key(42),
            objects.targets,
            SETTINGS,
            method="enumerate",
            starts=ExactStarts(1),
        )
    rng = np.random.default_rng(44)
    rows = np.stack([thin(rng, found.structure.shape[1]) for _ in found.structure])
    each = np.arange(len(rows))[:, None]
    return decoded(
        objects,
        found.structure[each, rows],
        found.z[each, rows],
        found.noise_scale[each, rows],
    )


@pytest.fixture(scope="module")
def priors(objects) -> Draws:
    """Draws that ignore the data, of hypotheses and noise."""
    rng = np.random.default_rng(43)
    targets, shape = objects.targets, (NUM_OBJECTS, NUM_DRAWS)
    probability = np.exp(np.asarray(targets.log_prior[0], float))
    structure = rng.choice(len(probability), size=shape, p=probability)
    period = np.asarray(targets.period[0])
    turn = period * (rng.random((*shape, len(period))) - 0.5)
    z = np.where(period > 0, turn, rng.standard_normal(turn.shape))
    scale = np.asarray(targets.log_likelihood.coordinates.scales.noise)[0]
    variance = scale**2 / rng.gamma(1.0, size=(*shape, 1, 4))
    return decoded(objects, structure, z, np.sqrt(variance))


@jax.jit
def _log_likelihoods(
    scene, params: Params, noise_scale: Array, state: Array, action: Array, last: Array
) -> Array:
    """Of readings of single steps, `[object, draw]`."""

    def one_row(params, state, action):
        return step(scene, params, State(state[:, :3], state[:, 3:]), action)[0].array

    def one_draw(params, noise_scale, state, action, last):
        predicted = jax.vmap(one_row, (None, 0, 0))(params, state, action)
        error = last - predicted
        # Angles of steps this short do not go round.
        sd = noise_scale[:, np.array([0, 0, 1, 2, 2, 3])]
        return jax.scipy.stats.norm.logpdf(error, 0.0, sd[None]).sum()

    over_draws = jax.vmap(one_draw, (0, 0, None, None, None))
    return jax.vmap(over_draws)(params, noise_scale, state, action, last)


def statistics(objects: PriorObjects, draws: Draws) -> dict[str, np.ndarray]:
    """Functions of hypotheses and readings, `[object, draw]`.

    Args:
        objects: with their readings.
        draws: hypotheses of each, leading axes `object` and `draw`.
    """
    coordinates = objects.targets.log_likelihood.coordinates
    scene = jax.tree.map(lambda leaf: leaf[0], coordinates.scene)
    readings = (
        np.stack([np.asarray(getattr(history, name)) for history in objects.histories])
        for name in ("state", "action", "next_state")
    )
    wheel, ground = draws.params.wheel, draws.params.ground
    has_wheel = np.asarray(wheel.active)[..., 0, 0]
    has_ground = np.asarray(ground.active)[..., 0, 0]
    return {
        "density": np.asarray(draws.params.density)[..., 0],
        "a wheel exists": has_wheel.astype(float),
        "friction exists": has_ground.astype(float),
        # Zero where there is none; ties are broken at random.
        "lateral coefficient": has_wheel * np.asarray(wheel.viscous)[..., 0, 0, 1],
        "friction": has_ground * np.asarray(ground.dry)[..., 0, 0],
        "noise of velocity": draws.noise_scale[..., 0, 2],
        "log-likelihood": np.asarray(
            _log_likelihoods(scene, draws.params, draws.noise_scale, *readings)
        ),
    }


def chances(objects: PriorObjects, truths: Draws, draws: Draws) -> dict[str, float]:
    """Chance of ranks as uneven as those of the truths among draws."""
    rng = np.random.default_rng(45)
    others, found = statistics(objects, draws), {}
    for name, true in statistics(objects, truths).items():
        ranks = [
            rank(rng, mine[0], theirs)
            for mine, theirs in zip(true, others[name], strict=True)
        ]
        found[name] = uniformity(np.array(ranks))
    return found


def test_ranks_of_the_truth_are_uniform(objects, truths, posteriors):
    found = chances(objects, truths, posteriors)
    assert min(found.values()) > FALSE_ALARM / len(found), found


def test_returning_the_prior_is_caught_by_the_log_likelihood_alone(
    objects, truths, priors
):
    found = chances(objects, truths, priors)
    assert found.pop("log-likelihood") < CAUGHT
    assert min(found.values()) > FALSE_ALARM / len(found), found


def test_posteriors_have_learnt(posteriors):
    """Else they would be the prior, and uniform ranks no news."""
    sd = np.log(np.asarray(posteriors.params.density)[..., 0]).std(axis=1)
    # The prior's is 1.5.
    assert np.median(sd) < 0.15
