"""Is the posterior calibrated, and would the test say so if it were not?

Objects are drawn from the prior: density, wheel, friction with the floor, noise, and
which of these exist. Readings are drawn from the paper's model of single steps, and
the posterior of each is sampled by every method over structures. The truth's rank
among the draws must be uniform: for the log-density, for whether a wheel and friction
exist, for their coefficients, and for the log-likelihood. Then mistakes are planted in
the sampler, each of which must be caught: draws of the prior, importance weights
forgotten, a structure's prior off by a constant, and a likelihood counted twice.
"""

from collections.abc import Callable
from typing import NamedTuple

import _repository  # noqa: F401
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _report import Reporter, parser_of

from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.fits.find_modes import find_single_step_modes
from boomdp_jax.inference.fits.fit import FitSettings, Modes
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points, log_prior_density
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.sample import SAMPLERS
from boomdp_jax.inference.samplers.importance_evidence import draws_of_noise
from boomdp_jax.inference.samplers.structure_draws import SampleSettings, start_mixtures
from boomdp_jax.inference.samplers.weighing import batch_noise, evaluate_each
from tests.inference.prior_objects import PriorObjects, draw_objects
from tests.reference.ranks import rank, thin, uniformity

METHODS = ("rj", "enumerate", "smc")
FALSE_ALARM = 0.01
"""Chance that a method without fault fails one of its ranks, all together."""

CAUGHT = 1e-6
"""A planted mistake counts as caught where chance would do as much this rarely."""

_SETTINGS = SampleSettings(num_samples=256)
# How much a structure's log-prior is off in one planted mistake, wheel or not [nats].
_SHIFT = 1.5


class Draws(NamedTuple):
    """Draws of a batch of objects, `[object, draw]` and `[object, draw, dim]`."""

    structure: np.ndarray
    z: np.ndarray


Sampler = Callable[[jax.Array, StructureTarget, Modes], Draws]


def main() -> None:
    parser = parser_of(__doc__, quick="one method, 24 objects, no verdict")
    parser.add_argument("--objects", type=int, default=320)
    parser.add_argument("--rows", type=int, default=12, help="readings of each")
    parser.add_argument("--batch", type=int, default=40, help="objects in one call")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--no-mistakes", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.objects, arguments.batch, arguments.methods = 24, 24, ("enumerate",)
    reporter = Reporter(arguments.out)
    rng = np.random.default_rng(arguments.seed)
    batches = [
        draw_objects(rng, arguments.batch, arguments.rows)
        for _ in range(-(-arguments.objects // arguments.batch))
    ]
    modes = [
        find_single_step_modes(jax.random.key(i), batch.targets, FitSettings())
        for i, batch in enumerate(batches)
    ]
    cases: list[tuple[str, Sampler, bool]] = [
        (method, _sampler(method), False) for method in arguments.methods
    ]
    if not arguments.no_mistakes and not arguments.quick:
        cases += [(name, mistake, True) for name, mistake in MISTAKES.items()]
    for case, sampler, is_mistake in cases:
        ranks, contraction = run_case(rng, batches, modes, sampler)
        report(reporter, case, ranks, contraction, is_mistake, not arguments.quick)
    reporter.print_table()


def run_case(
    rng: np.random.Generator,
    batches: list[PriorObjects],
    modes: list[Modes],
    sampler: Sampler,
) -> tuple[dict[str, list[int]], float]:
    """Ranks of every statistic, and the log-density's median contraction."""
    ranks: dict[str, list[int]] = {}
    contractions = []
    for number, (batch, found) in enumerate(zip(batches, modes, strict=True)):
        draws = sampler(jax.random.key(1000 + number), batch.targets, found)
        num_objects = len(batch.structure)
        kept = np.stack([thin(rng, draws.structure.shape[1]) for _ in batch.structure])
        each = np.arange(num_objects)[:, None]
        structure = np.append(
            draws.structure[each, kept], batch.structure[:, None], axis=1
        )
        z = np.append(draws.z[each, kept], batch.z[:, None], axis=1)
        for name, values in statistics(batch.targets, structure, z).items():
            for row in values:
                ranks.setdefault(name, []).append(rank(rng, row[-1], row[:-1]))
        contractions += list(1.0 - draws.z[..., 0].var(axis=1))
    return ranks, float(np.median(contractions))


def statistics(
    targets: StructureTarget, structure: np.ndarray, z: np.ndarray
) -> dict[str, np.ndarray]:
    """Functions of structure and numbers, `[object, draw]` each."""
    num_objects, num_draws = structure.shape
    index = np.repeat(np.arange(num_objects), num_draws)
    flat = structure.reshape(-1), z.reshape(len(index), -1)
    log_density = evaluate_points(targets, index, *flat).log_density
    log_likelihood = log_density - log_prior_density(targets, index, *flat)
    slots = np.asarray(targets.structures[0])[structure]
    slot = np.asarray(targets.slot[0])
    first = [int(np.flatnonzero(slot == s)[0]) for s in range(slots.shape[-1])]
    wheel, ground = (0, 1) if np.sum(slot == 0) > np.sum(slot == 1) else (1, 0)
    return {
        "log density": z[..., 0],
        "a wheel exists": slots[..., wheel].astype(float),
        "friction exists": slots[..., ground].astype(float),
        # Coefficients are zero where they do not exist; ties are broken at random.
        "lateral rate": z[..., first[wheel] + 3],
        "friction": z[..., first[ground]],
        "log-likelihood": log_likelihood.reshape(structure.shape),
    }


def report(
    reporter: Reporter,
    case: str,
    ranks: dict[str, list[int]],
    contraction: float,
    is_mistake: bool,
    is_judged: bool,
) -> None:
    """Chances of all ranks of one case, and the verdict."""
    chances = {name: uniformity(np.asarray(r)) for name, r in ranks.items()}
    limit = FALSE_ALARM / len(chances)
    for name, chance in chances.items():
        is_judged_alone = is_judged and not is_mistake
        reporter.report(
            case=f"planted mistake: {case}" if is_mistake else case,
            metric=f"p-value of ranks: {name}",
            value=chance,
            n=len(ranks[name]),
            target=limit if is_judged_alone else None,
            met=chance > limit if is_judged_alone else None,
        )
    if is_mistake:
        least = min(chances.values())
        reporter.report(
            case=f"planted mistake: {case}",
            metric="least p-value of all",
            value=least,
            target=CAUGHT,
            met=least < CAUGHT,
        )
    reporter.report(
        case=f"planted mistake: {case}" if is_mistake else case,
        metric="median contraction of log density",
        value=contraction,
        n=len(ranks["log density"]),
    )


def _sampler(method: str) -> Sampler:
    def sample(key: jax.Array, targets: StructureTarget, modes: Modes) -> Draws:
        drawn = SAMPLERS[method](key, targets, modes, _SETTINGS)
        structure = drawn.structure.reshape(len(drawn.structure), -1)
        return Draws(structure, drawn.z.reshape(*structure.shape, -1))

    return sample


def prior_draws(key: jax.Array, targets: StructureTarget, modes: Modes) -> Draws:
    """Draws that ignore the data."""
    rng = host_generator(key)
    num_objects, num = len(targets.slot), 256
    probability = np.exp(np.asarray(targets.log_prior[0], float))
    structure = rng.choice(
        len(probability), size=(num_objects, num), p=probability / probability.sum()
    )
    period = np.asarray(targets.period[0], float)
    shape = (num_objects, num, len(period))
    z = np.where(period > 0, period * (rng.random(shape) - 0.5), rng.normal(size=shape))
    slots = np.asarray(targets.structures[0])
    active = np.concatenate([slots, np.ones((len(slots), 1), bool)], axis=1)
    return Draws(
        structure, np.where(active[:, np.asarray(targets.slot[0])][structure], z, 0.0)
    )


@jax.jit
def _draw_mixtures(offset, noise, targets, mixtures):
    return jax.vmap(draws_of_noise)(offset, noise, targets, mixtures)


def without_weights(key: jax.Array, targets: StructureTarget, modes: Modes) -> Draws:
    """Draws of the fitted mixture whose importance weights are forgotten."""
    rng = host_generator(key)
    mixtures = start_mixtures(targets, modes)
    noise = batch_noise(rng, targets, mixtures, 256)
    offset = jnp.asarray(rng.random(len(targets.slot)), noise.normal.dtype)
    found = _draw_mixtures(offset, noise, targets, mixtures)
    return Draws(np.asarray(found.structure), np.asarray(found.z))


def constant_off(key: jax.Array, targets: StructureTarget, modes: Modes) -> Draws:
    """The jump sampler with structures whose prior is off by a constant."""
    shift = jnp.where(targets.structures[..., 0], _SHIFT, 0.0)
    wrong = eqx.tree_at(lambda t: t.log_prior, targets, targets.log_prior + shift)
    return _sampler("rj")(key, wrong, modes)


def counted_twice(key: jax.Array, targets: StructureTarget, modes: Modes) -> Draws:
    """Particles of a target with the likelihood squared."""

    def evaluate(targets, structure, z):
        num_objects, num = structure.shape
        index = np.repeat(np.arange(num_objects), num)
        flat = np.asarray(structure).reshape(-1), np.asarray(z).reshape(len(index), -1)
        prior = log_prior_density(targets, index, *flat).reshape(num_objects, num)
        return 2.0 * evaluate_each(targets, structure, z) - jnp.asarray(
            prior, targets.log_prior.dtype
        )

    drawn = SAMPLERS["smc"](key, targets, modes, _SETTINGS, evaluate)
    structure = drawn.structure.reshape(len(drawn.structure), -1)
    return Draws(structure, drawn.z.reshape(*structure.shape, -1))


MISTAKES: dict[str, Sampler] = {
    "draws of the prior": prior_draws,
    "importance weights forgotten": without_weights,
    "a structure's prior off by a constant": constant_off,
    "likelihood counted twice": counted_twice,
}
"""Samplers with a fault each."""


if __name__ == "__main__":
    main()
