"""Is the whole of `infer` calibrated on noisy tracks, their noise included?

Objects, noise of their readings and noise of their motion are drawn from the prior, and
one track of each from the model with latent states. Every method over structures goes
through all its stages: fits, gains, sampling with fixed gains, inferred noise. The
truth's rank among the draws must be uniform: for the log-density, for whether a wheel
and friction exist, for noise of readings and motion, and for the log-likelihood of the
extended filter. Noise drawn from its prior is the planted mistake. (The filter
linearises, and a track with huge noise is not linear: what that costs is part of the
answer.) Ranks hardly notice a few objects whose best optimum nobody found: those are
counted whose true hypothesis, noise and all, is more probable than every draw.
"""

from typing import NamedTuple

import _repository  # noqa: F401
import jax
import numpy as np
from _report import Reporter, parser_of

from boomdp_jax.inference.hypotheses.noise_level import (
    NoiseFit,
    log_noise_prior,
    prior_noise,
)
from boomdp_jax.inference.likelihoods.evaluate import log_prior_density
from boomdp_jax.inference.likelihoods.filter_points import filter_densities
from boomdp_jax.inference.sample import sample_blocks
from boomdp_jax.inference.samplers.structure_draws import SampleSettings
from tests.inference.prior_objects import PriorTracks, draw_tracks
from tests.reference.ranks import rank, thin, uniformity

METHODS = ("rj", "enumerate", "smc")
FALSE_ALARM = 0.01
"""Chance that a method without fault fails one of its ranks, all together."""

CAUGHT = 1e-6
"""A planted mistake counts as caught where chance would do as much this rarely."""

FAR = 5.0
"""A truth that is so many nats above every draw was not found."""

_SETTINGS = SampleSettings(num_samples=256)


class Draws(NamedTuple):
    """Draws of a batch of objects, `[object, draw, ...]`."""

    structure: np.ndarray
    z: np.ndarray
    noise: np.ndarray
    """Logarithms, `[object, draw, 6]`."""


def main() -> None:
    parser = parser_of(__doc__, quick="one method, 12 objects, no verdict")
    parser.add_argument("--objects", type=int, default=320)
    parser.add_argument("--rows", type=int, default=20, help="transitions of each")
    parser.add_argument("--batch", type=int, default=40, help="objects in one call")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.objects, arguments.batch, arguments.methods = 12, 12, ("enumerate",)
    reporter = Reporter(arguments.out)
    rng = np.random.default_rng(arguments.seed)
    batches = [
        draw_tracks(rng, arguments.batch, arguments.rows)
        for _ in range(-(-arguments.objects // arguments.batch))
    ]
    for method in arguments.methods:
        ranks: dict[str, dict[str, list[int]]] = {}
        gaps: list[float] = []
        for number, batch in enumerate(batches):
            key = jax.random.key(1000 * arguments.seed + number)
            found = sample_blocks(key, batch.targets, _SETTINGS, method=method)
            assert found.impulse_scale is not None
            vector = np.concatenate([found.noise_scale, found.impulse_scale], axis=-1)
            draws = Draws(found.structure, found.z, np.log(vector[:, :, 0]))
            cases = {method: draws}
            if method == arguments.methods[0]:
                cases["noise drawn from its prior"] = _with_prior_noise(
                    rng, batch, draws
                )
            for case, drawn in cases.items():
                rows, gap = _ranks(rng, batch, drawn)
                for name, row in rows.items():
                    ranks.setdefault(case, {}).setdefault(name, []).extend(row)
                gaps += gap if case == method else []
        reporter.report(
            case=method,
            metric=f"objects whose truth is {FAR:g} nats above every draw",
            value=float(np.mean(np.array(gaps) > FAR)),
            n=len(gaps),
            spread=max(gaps),
        )
        for case, theirs in ranks.items():
            report(reporter, case, theirs, case not in METHODS, not arguments.quick)
    reporter.print_table()


def _with_prior_noise(rng, batch: PriorTracks, draws: Draws) -> Draws:
    """The same draws with noise that has not seen the data."""
    likelihood = batch.targets.log_likelihood
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[0]
    both = np.concatenate(prior_noise(rng, scale, draws.structure.shape), axis=-1)
    return draws._replace(noise=np.log(both))


def _ranks(
    rng, batch: PriorTracks, draws: Draws
) -> tuple[dict[str, list[int]], list[float]]:
    """Rank of the truth in every statistic, object by object.

    And how much the truth is more probable than the most probable draw [nats].
    """
    num_objects, num_draws = draws.structure.shape
    kept = np.stack([thin(rng, num_draws) for _ in range(num_objects)])
    each = np.arange(num_objects)[:, None]
    structure = np.append(draws.structure[each, kept], batch.structure[:, None], 1)
    z = np.append(draws.z[each, kept], batch.z[:, None], axis=1)
    noise = np.append(draws.noise[each, kept], batch.noise.vector[:, None], axis=1)
    out: dict[str, list[int]] = {}
    found = statistics(batch, structure, z, noise)
    for name, values in found.items():
        out[name] = [rank(rng, row[-1], row[:-1]) for row in values]
    vector = noise.reshape(structure.size, -1)
    likelihood: Any = batch.targets.log_likelihood
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[0]
    prior = log_noise_prior(np.tile(scale, (structure.size, 1)), vector)
    total = found["log-likelihood"] + found["log-prior"]
    total = total + prior.reshape(structure.shape)
    return out, (total[:, -1] - total[:, :-1].max(axis=1)).tolist()


def statistics(batch: PriorTracks, structure, z, noise) -> dict[str, np.ndarray]:
    """Functions of structure, numbers and noise, `[object, draw]` each."""
    targets = batch.targets
    num_objects, num_draws = structure.shape
    index = np.repeat(np.arange(num_objects), num_draws)
    flat = structure.reshape(-1), z.reshape(len(index), -1).astype(float)
    level = NoiseFit.of_vector(noise.reshape(len(index), -1))
    likelihood = filter_densities(targets, index, *flat, level)
    prior = log_prior_density(targets, index, *flat)
    slots = np.asarray(targets.structures[0])[structure]
    slot = np.asarray(targets.slot[0])
    wheel, ground = (0, 1) if np.sum(slot == 0) > np.sum(slot == 1) else (1, 0)
    names = ("position", "angle", "velocity", "spin", "velocity kick", "spin kick")
    return {
        "log density": z[..., 0],
        "a wheel exists": slots[..., wheel].astype(float),
        "friction exists": slots[..., ground].astype(float),
        "log-likelihood": likelihood.reshape(structure.shape),
        "log-prior": prior.reshape(structure.shape),
        **{f"{name} noise": noise[..., i] for i, name in enumerate(names)},
    }


def report(
    reporter: Reporter,
    case: str,
    ranks: dict[str, list[int]],
    is_mistake: bool,
    is_judged: bool,
) -> None:
    """Chances of all ranks of one case, and the verdict."""
    chances = {name: uniformity(np.asarray(r)) for name, r in ranks.items()}
    limit = FALSE_ALARM / len(chances)
    case = f"planted mistake: {case}" if is_mistake else case
    for name, chance in chances.items():
        is_judged_alone = is_judged and not is_mistake
        reporter.report(
            case=case,
            metric=f"p-value of ranks: {name}",
            value=chance,
            n=len(ranks[name]),
            spread=float(np.mean(ranks[name])) / 63.0,
            target=limit if is_judged_alone else None,
            met=chance > limit if is_judged_alone else None,
        )
    if is_mistake:
        least = min(chances.values())
        reporter.report(
            case=case,
            metric="least p-value of all",
            value=least,
            target=CAUGHT if is_judged else None,
            met=least < CAUGHT if is_judged else None,
        )


if __name__ == "__main__":
    main()
