"""Noise of bodies whose kinds were sampled, and laws that they lack: each its own."""

from typing import Any, NamedTuple

import numpy as np

from boomdp_jax.inference.doubts.residual import ResidualCheck, check_residuals
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit, prior_noise
from boomdp_jax.inference.kinds.objects import ObjectsAlone
from boomdp_jax.inference.likelihoods.evaluate import log_prior_density
from boomdp_jax.inference.noise.correction import noise_about_peaks
from boomdp_jax.inference.samplers.block_draws import BlockDraws


class OwnOfBody(NamedTuple):
    """What a body shares with nothing of its kind."""

    noise: NoiseFit
    """Leading axis `draw`."""
    residual: ResidualCheck | None
    """None: nobody saw it in motion."""


def own_of_bodies(
    rng: np.random.Generator,
    objects: ObjectsAlone,
    structure: np.ndarray,
    z: np.ndarray,
    log_likelihood: np.ndarray,
) -> list[OwnOfBody]:
    """Noise of readings and of the motion for every draw, and a check of residuals.

    Noise of a body that nobody saw in motion is from the prior: kinds share none.

    Args:
        rng: source of randomness.
        objects: bodies sampled alone.
        structure: of each draw, `[draw, body]`.
        z: coordinates, `[draw, body, dim]`.
        log_likelihood: of each, `[draw, body]`.

    Returns:
        One entry for each body.
    """
    num_draws = len(structure)
    out: list[OwnOfBody] = []
    for body in objects.bodies:
        likelihood: Any = body.block.target.log_likelihood
        scale = np.asarray(likelihood.coordinates.scales.noise, float)
        out.append(OwnOfBody(NoiseFit(*prior_noise(rng, scale, (num_draws, 1))), None))
    for batch, targets in enumerate(objects.targets):
        members = [i for i, body in enumerate(objects.bodies) if body.batch == batch]
        members.sort(key=lambda i: objects.bodies[i].place)
        which, place = structure[:, members].T, np.swapaxes(z[:, members], 0, 1)
        index = np.repeat(np.arange(len(members)), num_draws)
        points = (index, which.reshape(-1), place.reshape(len(index), -1))
        height = log_prior_density(targets, *points).reshape(which.shape)
        height = height + log_likelihood[:, members].T
        found = noise_about_peaks(
            rng, targets, objects.noise[batch], which, place, height, is_drawn=True
        )
        shape = (len(members), num_draws, 1)
        draws = BlockDraws(
            structure=which,
            z=place,
            log_density=height,
            noise_scale=found.reading.reshape(*shape, 4),
            impulse_scale=found.impulse.reshape(*shape, 2),
            log_evidence=np.full(len(members), np.nan),
            evidence=None,
            diagnostics=[],
            chain_index=np.zeros(1, int),
        )
        checks = check_residuals(targets, draws)
        for number, i in enumerate(members):
            out[i] = OwnOfBody(found.take(index == number), checks[number])
    return out
