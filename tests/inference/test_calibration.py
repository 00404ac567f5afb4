"""Simulation-based calibration of `infer`, and that it would notice what it should.

Boxes are drawn from the prior: density, wheel, friction of the floor, and which of them
exist; noise, too. Readings are of single steps from states that are known exactly,
which is what likelihood `one-step` says, so that the posterior should be exact. Then
the rank of any function of the truth among posterior draws is uniform. Parameters and
structure alone are blind to a posterior that ignores the data: it is planted, passes
all of those, and must fail by the rank of the log-likelihood. Talts et al. (2018),
Validating Bayesian inference algorithms with simulation-based calibration; Modrák et
al. (2023), Simulation-based calibration checking for Bayesian computation.
"""

from typing import NamedTuple

import jax
import numpy as np
import pytest
from jaxtyping import Array

import boomdp_jax
from boomdp_jax.core.history import make_history
from boomdp_jax.inference import Posterior
from boomdp_jax.physics import Params, State, step
from tests.inference.prior_objects import DT, PriorObjects, box_scene, draw_objects
from tests.reference.ranks import NUM_DRAWS, rank, thin, uniformity

pytestmark = pytest.mark.slow

NUM_OBJECTS, NUM_ROWS = 320, 10
FALSE_ALARM = 1e-3
"""Chance that a sampler without fault fails any of its ranks."""

CAUGHT = 1e-6
"""A planted mistake counts as caught where chance would do as much this rarely."""


class Draws(NamedTuple):
    """Of one object, leading axis `draw`."""

    params: Params
    noise_scale: np.ndarray


@pytest.fixture(scope="module")
def objects() -> PriorObjects:
    return draw_objects(np.random.default_rng(41), NUM_OBJECTS, NUM_ROWS)


@pytest.fixture(scope="module")
def truths(objects) -> Draws:
    """Leading axis `object`."""
    coordinates = objects.targets.log_likelihood.coordinates
    active = np.asarray(objects.targets.structures[0])[objects.structure]
    decode = jax.jit(jax.vmap(lambda c, z, active: c(z, active)))
    params = decode(coordinates, objects.z, active)
    return Draws(params, objects.noise_scale[:, None])


@pytest.fixture(scope="module")
def posteriors(objects) -> list[Posterior]:
    return boomdp_jax.infer_batch(
        jax.random.key(42),
        [box_scene()] * NUM_OBJECTS,
        objects.histories,
        method="enumerate",
        likelihood="one-step",
        num_chains=1,
        num_samples=256,
    )


@pytest.fixture(scope="module")
def prior() -> Posterior:
    """A posterior without data; of as many draws as all objects need."""
    blank = np.zeros((0, 1, 6))
    history = make_history(blank, blank[..., :3], blank, DT, capacity=4)
    return boomdp_jax.infer(
        jax.random.key(43),
        box_scene(),
        history,
        method="enumerate",
        likelihood="one-step",
        num_samples=1000,
    )


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


def chances(
    objects: PriorObjects, truths: Draws, posteriors: list[Posterior]
) -> dict[str, float]:
    """Chance of ranks as uneven as those of the truths among draws of posteriors."""
    rng = np.random.default_rng(44)
    kept = []
    for posterior in posteriors:
        rows = thin(rng, posterior.num_draws)
        drawn = Draws(posterior.params, np.asarray(posterior.noise_scale))
        kept.append(jax.tree.map(lambda leaf, r=rows: np.asarray(leaf)[r], drawn))
    draws = jax.tree.map(lambda *leaves: np.stack(leaves), *kept)
    others = statistics(objects, draws)
    truths = jax.tree.map(lambda leaf: np.asarray(leaf)[:, None], truths)
    found = {}
    for name, true in statistics(objects, truths).items():
        ranks = [
            rank(rng, mine[0], theirs)
            for mine, theirs in zip(true, others[name], strict=True)
        ]
        found[name] = uniformity(np.array(ranks))
    return found


def test_ranks_of_the_truth_are_uniform(objects, truths, posteriors):
    assert all(posterior.num_draws >= NUM_DRAWS for posterior in posteriors)
    found = chances(objects, truths, posteriors)
    assert min(found.values()) > FALSE_ALARM / len(found), found


def test_returning_the_prior_is_caught_by_the_log_likelihood_alone(
    objects, truths, prior
):
    found = chances(objects, truths, [prior] * NUM_OBJECTS)
    assert found.pop("log-likelihood") < CAUGHT
    assert min(found.values()) > FALSE_ALARM / len(found), found


def test_posteriors_have_learnt(truths, posteriors):
    """Else they would be the prior, and uniform ranks no news."""
    sd = [np.log(np.asarray(p.params.density)[:, 0]).std() for p in posteriors]
    # The prior's is 1.5.
    assert np.median(sd) < 0.15
