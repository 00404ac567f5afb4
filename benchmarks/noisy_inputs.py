"""Readings that are noisy, motion that is: error against the bound, and coverage.

Free boxes, carts and pinned tables are pushed for 200 steps. Readings, the motion (an
impulse on the twist before each step) or both have noise of 5 or 15 % of each channel's
standard deviation. Structure, numbers and noise are inferred; every number of the true
structure is compared with the truth in units of its Cramér-Rao bound. Beside it stand
least squares of single steps and of open loops, which are told the structure and start
at the truth. Last, what a value of each likelihood costs.
"""

import time

import jax
import numpy as np
from _noisy_objects import (
    Bounds,
    NoisyObject,
    bounds_and_rivals,
    make_noisy_object,
    offsets_of_draws,
    quantities,
)
from _report import Reporter, parser_of

from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.infer import infer_batch
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points, log_prior_density
from boomdp_jax.inference.likelihoods.filter_points import filter_densities
from boomdp_jax.inference.likelihoods.one_step import OneStepLikelihood
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.structure_report import Slots, group_by_structure
from boomdp_jax.inference.posteriors.summary import weighted_quantiles
from boomdp_jax.interop.object_families import hide
from boomdp_jax.physics.params import WORLD

FAMILIES = {"box": (), "cart": ("wheel",), "table": ("revolute",)}
"""With the constraints that each truly has."""

LEVELS = (0.05, 0.15)
KINDS = {"readings": (True, False), "motion": (False, True), "both": (True, True)}
LEAST_READING = 1e-3
"""Noise of readings where it is the motion that is noisy, as a share."""

NUM_ROWS = 200
_HALF_WIDTH = 1.6449
"""Of a central 90 % interval, in standard deviations."""

FEWEST_JUDGED = 25


def main() -> None:
    parser = parser_of(__doc__, quick="3 boxes of 50 steps in one cell")
    parser.add_argument("--objects", type=int, default=24, help="in each cell")
    parser.add_argument("--rows", type=int, default=NUM_ROWS)
    parser.add_argument("--batch", type=int, default=12, help="objects in one call")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=FAMILIES)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--levels", nargs="+", type=float, default=LEVELS)
    arguments = parser.parse_args()
    reporter = Reporter(arguments.out)
    if arguments.quick:
        arguments.objects, arguments.rows, arguments.batch = 3, 50, 3
        arguments.families, arguments.kinds, arguments.levels = ["box"], ["both"], [0.1]
    for family in arguments.families:
        for kind in arguments.kinds:
            for level in arguments.levels:
                run_cell(reporter, family, kind, level, arguments)
    report_costs(reporter, arguments)
    reporter.print_table()


def run_cell(reporter: Reporter, family: str, kind: str, level: float, arguments):
    """Infer all objects of a cell and report what was asked of it."""
    of_readings, of_motion = KINDS[kind]
    items = [
        make_noisy_object(
            [arguments.seed, index, round(1000 * level), list(KINDS).index(kind)],
            family,
            arguments.rows,
            level if of_readings else LEAST_READING,
            level if of_motion else 0.0,
        )
        for index in range(arguments.objects)
    ]
    bounds = [bounds_and_rivals(item) for item in items]
    posteriors, seconds = [], []
    for begin in range(0, len(items), arguments.batch):
        batch = items[begin : begin + arguments.batch]
        start = time.perf_counter()
        posteriors += infer_batch(
            jax.random.key(arguments.seed + begin),
            [hide(item.truth) for item in batch],
            [item.table.to_history() for item in batch],
        )
        seconds.append((time.perf_counter() - start) / len(batch))
    case = f"{family}, {kind} {level:.0%}"
    report_numbers(reporter, case, items, bounds, posteriors)
    probability = [own_draws(i, p)[0] for i, p in zip(items, posteriors, strict=True)]
    wrong = [p < 0.5 for p in probability]
    reporter.report(
        case=case,
        metric="objects whose true structure is not the most probable",
        value=float(np.mean(wrong)),
        n=len(wrong),
        spread=min(probability),
        target=0.0,
        met=not any(wrong),
    )
    ok = [bool(posterior.diagnostics["ok"]) for posterior in posteriors]
    reporter.report(
        case=case,
        metric="diagnostics ok",
        value=float(np.mean(ok)),
        n=len(ok),
        target=1.0,
        met=all(ok),
    )
    reporter.report(
        case=case,
        metric="time of an object in a batch",
        value=float(np.median(seconds)),
        unit="s",
        n=len(seconds),
        spread=[min(seconds), max(seconds)],
    )


def own_draws(item: NoisyObject, posterior: Posterior) -> tuple[float, np.ndarray]:
    """Probability of the true structure, and which draws have it."""
    slots = {Slots(kind, 0, WORLD, 1) for kind in FAMILIES[item.family]}
    params = jax.tree.map(np.asarray, posterior.params)
    groups = group_by_structure(params, posterior.inferred, posterior.weights)
    for group in groups:
        if set(group.slots) == slots:
            return group.probability, group.draws
    return 0.0, np.zeros(0, int)


def report_numbers(
    reporter: Reporter,
    case: str,
    items: list[NoisyObject],
    bounds: list[Bounds],
    posteriors: list[Posterior],
) -> None:
    """Error over bound and coverage of every number of the true structure."""
    errors: dict[str, list] = {}
    covered: dict[str, list] = {}
    rivals: dict[str, dict[str, list]] = {}
    for item, bound, posterior in zip(items, bounds, posteriors, strict=True):
        _, rows = own_draws(item, posterior)
        params = jax.tree.map(
            lambda leaf, r=rows: np.asarray(leaf)[r], posterior.params
        )
        weights = posterior.weights[rows]
        draws = offsets_of_draws(item, params)
        for name, direction in quantities(item):
            sd = float(np.sqrt(direction @ bound.covariance @ direction))
            if len(rows):
                values = (draws @ direction)[:, None]
                share = weights / weights.sum()
                low, high = weighted_quantiles(values, share, (0.05, 0.95))[:, 0]
                error, inside = float(share @ values[:, 0]) / sd, low <= 0.0 <= high
            else:
                error, inside = np.inf, False
            errors.setdefault(name, []).append(error)
            covered.setdefault(name, []).append(bool(inside))
            for rival, guess in bound.rivals.items():
                own = np.sqrt(direction @ guess.covariance @ direction)
                offset = float(direction @ guess.offset)
                rivals.setdefault(rival, {}).setdefault(name, []).append(
                    (offset / sd, abs(offset) <= _HALF_WIDTH * own)
                )
    for name, values in errors.items():
        ratio = float(np.sqrt(np.mean(np.square(values))))
        n, one_step = len(values), np.array(rivals["one-step"][name])
        reporter.report(
            case=case,
            metric=f"error over the bound: {name}",
            value=ratio,
            n=n,
            spread=ratio / np.sqrt(2.0 * n),
            peer="one-step",
            peer_value=float(np.sqrt(np.mean(one_step[:, 0] ** 2))),
            target=1.15,
            met=ratio <= 1.15 if n >= FEWEST_JUDGED else None,
        )
        share = float(np.mean(covered[name]))
        for rival in rivals:
            reporter.report(
                case=case,
                metric=f"coverage of 90 % intervals: {name}",
                value=share,
                n=n,
                spread=float(np.sqrt(0.09 / n)),
                peer=rival,
                peer_value=float(np.mean(np.array(rivals[rival][name])[:, 1])),
                target="0.82 to 0.96",
                met=0.82 <= share <= 0.96 if n >= FEWEST_JUDGED else None,
            )


def report_costs(reporter: Reporter, arguments) -> None:
    """Milliseconds of a thousand values of one-step, fixed-gain and full filters."""
    item = make_noisy_object([arguments.seed], "cart", arguments.rows, 0.05, 0.05)
    block = make_block(hide(item.truth), (0,), item.table.to_history())
    targets = stack_blocks([block])
    rng, num = np.random.default_rng(arguments.seed), 1024
    z = 0.3 * rng.standard_normal((num, targets.slot.shape[1]))
    index = np.zeros(num, int)
    structure = np.arange(num) % targets.structures.shape[1]
    noise = NoiseFit(
        np.tile(item.reading, (num, 1, 1)), np.tile(item.impulse, (num, 1, 1))
    )

    on_device = jax.device_put((structure, z.astype(targets.log_prior.dtype)))

    def one_step():
        return np.asarray(one_step_values(targets, *on_device))

    # The answer first: gains of single steps make the fixed-gain filter one-step.
    plain = evaluate_points(targets, index, structure, z).log_density
    values = {
        "one-step": one_step,
        "fixed gains": lambda: evaluate_points(targets, index, structure, z),
        "extended filter": lambda: filter_densities(
            targets, index, structure, z, noise
        ),
    }
    expected = one_step() + log_prior_density(targets, index, structure, z)
    # In nats a row: a sum of many rows in single precision may come to next to nothing.
    gap = float(np.max(np.abs(plain - expected))) / arguments.rows
    if gap > 1e-3:
        raise AssertionError(
            f"one-step and fixed one-step gains differ by {gap:.2g} nats a row"
        )
    rounds: dict[str, list[float]] = {name: [] for name in values}
    for _ in range(9):
        for name, call in values.items():
            start = time.perf_counter()
            call()
            rounds[name].append(time.perf_counter() - start)
    base = np.array(rounds["one-step"][1:])
    for name, target in (("fixed gains", 3.0), ("extended filter", 10.0)):
        own = np.array(rounds[name][1:])
        ratio = float(np.median(own / base))
        reporter.report(
            case=f"{num} values of {arguments.rows} steps",
            metric=f"time of {name} over one-step",
            value=ratio,
            n=len(own),
            spread=[float(np.min(own / base)), float(np.max(own / base))],
            peer="one-step, ms",
            peer_value=1e3 * float(np.median(base)),
            target=target,
            met=ratio <= target,
        )


@jax.jit
def one_step_values(targets, structure, z):
    """Log-likelihoods of single steps, all points of one object at once."""
    target = jax.tree.map(lambda leaf: leaf[0], targets)
    filtered = target.log_likelihood
    likelihood = OneStepLikelihood(filtered.coordinates, filtered.data.steps)
    return jax.vmap(lambda k, z: likelihood(z, target.structures[k]))(structure, z)


if __name__ == "__main__":
    main()
