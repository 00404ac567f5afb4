"""Every method of inference beside the papers' own recipe and a general sampler.

MuJoCo pushes random objects of several families, 50 noisy transitions each. All methods
see the same readings. The papers' recipe is plain Metropolis from prior draws (30
chains of 20,000), one noise scale for everything, constraints that are always there and
nulled by a value; BlackJAX (where installed) tempers 2,048 particles of the same
density, and `sbi` (where installed) trains a neural posterior estimator on simulations
of the same pushes. Given the true structure, NUTS and SVI stand beside them. Last comes
the ablation of what jumps between structures propose: births from the prior, from one
fit of each structure, or from the adapted mixture of all modes.
"""

import argparse
import contextlib
import importlib.util
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from _ablation import PROPOSALS, Ablation, ablate
from _information import log_mass_bound
from _neural import neural_posterior
from _plain_samplers import blackjax_smc, metropolis
from _report import Reporter, parser_of
from _scores import ObjectScore, score_object
from numpyro.diagnostics import effective_sample_size
from structure_recovery import make_objects

from boomdp_jax.core.history import History
from boomdp_jax.inference.infer import infer
from boomdp_jax.inference.likelihoods import evaluate, filter_points
from boomdp_jax.inference.likelihoods.chunking import CHUNK_SIZE
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.interop.object_families import FAMILIES, hide
from boomdp_jax.interop.recording import READING_NOISE, with_reading_noise
from boomdp_jax.physics.scene_spec import SceneSpec

OURS = ("rj", "enumerate", "smc", "laplace", "map")
RIVALS = ("metropolis", "blackjax", "npe")
_NEEDS = {"blackjax": "blackjax", "npe": "sbi"}
GIVEN = ("nuts", "svi")
"""Told the true structure."""
METHODS = OURS + GIVEN + RIVALS
NUM_ROWS = 50
_POINT_ESTIMATES = ("map",)


class Run(NamedTuple):
    """One method on one object."""

    score: ObjectScore
    num_calls: int | None
    """Steps of the simulator; None where nobody counts."""
    seconds: float
    """Without compilation."""
    sample_size: float


def main() -> None:
    parser = parser_of(__doc__, quick="two objects, short chains")
    parser.add_argument("--objects", type=int, default=21)
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=FAMILIES)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=METHODS)
    parser.add_argument("--iterations", type=int, default=20_000)
    parser.add_argument("--simulations", type=int, default=20_000, help="of `npe`")
    parser.add_argument("--ablated", type=int, default=7, help="objects of the table")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.objects, arguments.ablated = 2, 1
        arguments.families, arguments.iterations = ("cart", "table"), 500
        arguments.simulations = 1000
    reporter = Reporter(arguments.out)
    objects = make_objects(
        arguments.families, arguments.objects, NUM_ROWS, arguments.seed
    )
    noise = np.array(READING_NOISE)
    histories = [
        with_reading_noise(
            np.random.default_rng([arguments.seed, place]), table, noise
        ).to_history()
        for place, (_, _, table) in enumerate(objects)
    ]
    bounds = [
        log_mass_bound(truth, table, noise, is_chained=True)
        for _, truth, table in objects
    ]
    probabilities = {}
    for method in arguments.methods:
        needed = _NEEDS.get(method)
        if needed is not None and importlib.util.find_spec(needed) is None:
            continue
        runner = _runner(method, arguments)
        runs = []
        for place, (family, truth, _) in enumerate(objects):
            key = jax.random.key(1000 * arguments.seed + place)
            posterior, calls, seconds = runner(key, truth, histories[place])
            score = score_object(family, truth, posterior, bounds[place])
            runs.append(Run(score, calls, seconds, _sample_size(posterior)))
            probabilities[method, place] = posterior.structure_probabilities()
        report_method(reporter, method, runs)
    report_agreement(reporter, probabilities, len(objects))
    report_ablation(reporter, objects[: arguments.ablated], histories, arguments)
    reporter.print_table()


def _runner(method: str, arguments: argparse.Namespace) -> Callable[..., tuple]:
    """A function of key, scene and history to posterior, calls and seconds."""

    def ours(key, truth: SceneSpec, history: History):
        structure = _true_structure(truth) if method in GIVEN else None
        with counted_calls() as count:
            start = time.perf_counter()
            posterior = infer(
                key,
                hide(truth),
                history,
                method=method,
                structure=structure,
                progress=False,
            )
            seconds = time.perf_counter() - start
        # Gradients are steps too, and nobody counts them.
        calls = None if method in GIVEN else count[0]
        return posterior, calls, seconds - (posterior.seconds["compile"] or 0.0)

    def plain(key, truth: SceneSpec, history: History):
        spec = hide(truth)
        if method == "metropolis":
            found = metropolis(key, spec, history, num_iterations=arguments.iterations)
        elif method == "npe":
            found = neural_posterior(
                key,
                spec,
                history,
                num_simulations=arguments.simulations,
                num_epochs=10 if arguments.quick else 200,
            )
        else:
            found = blackjax_smc(key, spec, history)
        return found.posterior, found.num_calls, found.seconds["run"]

    return plain if method in RIVALS else ours


def _true_structure(truth: SceneSpec) -> dict[str, list[str]]:
    """Kinds of constraints that the one body truly has."""
    params = truth.params()
    kinds = ("revolute", "wheel", "ground")
    active = [k for k in kinds if np.any(np.asarray(getattr(params, k).active))]
    return {truth.names[0]: active}


@contextlib.contextmanager
def counted_calls() -> Iterator[list[int]]:
    """Count steps of the simulator in likelihoods, padding included."""
    count = [0]
    originals = evaluate.run_each, filter_points.run_each

    def num_points(program, arguments: tuple) -> int:
        """Of one call; see what the first stages of these programs take."""
        if program is filter_points._FILTERS:
            return len(arguments[0])
        if program is filter_points._DENSITIES:
            structure, *_ = arguments[3]
            return int(arguments[2]) * structure.shape[1]
        if program is evaluate._PUSHED:
            return int(arguments[4]) * CHUNK_SIZE
        place = 3 if program is evaluate._RESTARTED else 2
        return int(arguments[place]) * CHUNK_SIZE

    def counting(original: Callable[..., Any], each_row: Callable[[Any], int]):
        def run(program, targets, inputs):
            data = targets.log_likelihood.data
            rows, bodies = data.steps.state.shape[1:3]
            for arguments in inputs:
                points = num_points(program, arguments)
                count[0] += points * rows * each_row(bodies)
            return original(program, targets, inputs)

        return run

    evaluate.run_each = counting(originals[0], lambda bodies: 1)
    # An extended filter predicts its mean and an offset in every direction.
    filter_points.run_each = counting(originals[1], lambda bodies: 1 + 6 * bodies)
    try:
        yield count
    finally:
        evaluate.run_each, filter_points.run_each = originals


def _sample_size(posterior: Posterior) -> float:
    """Effective draws of log-density and log-mass, the smaller."""
    chain, weight = np.asarray(posterior.chain), np.asarray(posterior.weights)
    by_weight = float(1.0 / np.sum(weight**2) / len(weight))
    sizes = []
    for value in (posterior.log_density, np.log(posterior.params.density[:, 0])):
        value = np.asarray(value, float)
        rows = np.stack([value[chain == number] for number in np.unique(chain)])
        if rows.shape[1] > 3 and np.ptp(rows) > 0:
            sizes.append(float(effective_sample_size(rows)))
    return by_weight * min(sizes, default=1.0)


def report_method(reporter: Reporter, method: str, runs: list[Run]) -> None:
    """What one method found, and what it took."""
    n = len(runs)
    probability = np.array([run.score.probability for run in runs])
    error = np.array([run.score.mass_error for run in runs])
    # The median of the size of a normal error is 0.67 standard deviations.
    bound = 0.6745 * np.median([run.score.mass_bound for run in runs])
    # The first run of a program may pay for what is not counted as compilation.
    later = [run for run in runs[1:]] or runs
    seconds = np.array([run.seconds for run in later])
    rate = np.median([run.sample_size / run.seconds for run in later])
    covered = [hit for run in runs for hit in run.score.covered.values()]
    lines: dict[str, tuple[float, Any]] = {
        "probability of the truth, mean": (float(probability.mean()), None),
        "truth most probable": (float(np.mean(probability > 0.5)), None),
        "relative error of mass, median": (
            float(np.median(error)),
            [float(x) for x in np.quantile(error, (0.25, 0.75))],
        ),
        "seconds without compilation, median": (
            float(np.median(seconds)),
            [float(seconds.min()), float(seconds.max())],
        ),
    }
    if method in GIVEN:
        del lines["probability of the truth, mean"], lines["truth most probable"]
    if method not in _POINT_ESTIMATES:
        # Of numbers whose structure was not found an interval does not exist: a miss.
        lines["coverage of 90 % intervals, all numbers"] = (
            float(np.mean(covered)),
            float(np.sqrt(0.09 / len(covered))),
        )
        lines["effective draws per second, median"] = (float(rate), None)
    calls = [run.num_calls for run in runs if run.num_calls is not None]
    if calls:
        lines["simulator steps, median"] = (float(np.median(calls)), None)
    for metric, (value, spread) in lines.items():
        is_error = metric.startswith("relative error")
        reporter.report(
            case=method,
            metric=metric,
            value=value,
            unit="s" if metric.startswith("seconds") else "",
            n=n,
            spread=spread,
            peer="Cramér-Rao bound" if is_error else None,
            peer_value=float(bound) if is_error else None,
        )


def report_agreement(reporter: Reporter, probabilities: dict, num_objects: int) -> None:
    """Total variation between the exact methods' structure probabilities."""
    methods = [m for m in ("rj", "enumerate", "smc") if (m, 0) in probabilities]
    for number, one in enumerate(methods):
        for other in methods[number + 1 :]:
            distances = []
            for place in range(num_objects):
                a, b = probabilities[one, place], probabilities[other, place]
                names = a.keys() | b.keys()
                total = sum(abs(a.get(k, 0.0) - b.get(k, 0.0)) for k in names)
                distances.append(0.5 * total)
            reporter.report(
                case=f"{one} and {other}",
                metric="total variation of structure probabilities, largest",
                value=max(distances),
                n=num_objects,
                spread=float(np.median(distances)),
                target=0.02,
                met=max(distances) < 0.02,
            )


def report_ablation(reporter: Reporter, objects, histories, arguments) -> None:
    """What jumps propose, against how often they land and where chains end."""
    found: dict[str, list[Ablation]] = {name: [] for name in PROPOSALS}
    for place, (_, truth, _) in enumerate(objects):
        key = jax.random.key(1000 * arguments.seed + 500 + place)
        results = ablate(
            key,
            hide(truth),
            histories[place],
            truth,
            num_samples=200 if arguments.quick else 1000,
        )
        for name, result in results.items():
            found[name].append(result)
    for name, results in found.items():
        for metric, values in (
            ("jumps accepted, median", [r.acceptance for r in results]),
            ("share of draws in the true structure, mean", [r.share for r in results]),
            ("effective draws of the log-density, median", [r.size for r in results]),
        ):
            middle = np.mean if metric.endswith("mean") else np.median
            value = float(middle(values)) if values else None
            reporter.report(
                case=f"jumps: {name}", metric=metric, value=value, n=len(values)
            )


if __name__ == "__main__":
    main()
