"""How many objects a second does one call of `infer_batch` infer, by their number?

Objects of three families (free box, pinned table, cart on a fixed wheel), pushed in
MuJoCo; joint, wheel and ground friction are unknown of each. Every batch size is called
cold, which compiles it, and again on other objects. The answers are checked first:
structure and mass of every object.
"""

import time
from typing import NamedTuple

import jax
import numpy as np
from _report import Reporter, parser_of

from boomdp_jax.core.history import History
from boomdp_jax.inference.infer import infer_batch
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.interop.object_families import (
    hide,
    random_object,
    record_random_pushes,
)
from boomdp_jax.interop.recording import with_reading_noise
from boomdp_jax.physics.scene_spec import SceneSpec

FAMILIES = ("box", "table", "cart")
BATCHES = (1, 4, 16, 64)
NUM_ROWS, QUICK_ROWS = 50, 20
MASS_ERROR = 0.05
"""Largest relative error of the median of a mass that counts as found."""


class Objects(NamedTuple):
    """What is inferred, and the truth about it."""

    truths: list[SceneSpec]
    specs: list[SceneSpec]
    histories: list[History]


def main() -> None:
    parser = parser_of(__doc__, quick="batches of 1 and 2, short, by laplace")
    parser.add_argument("--batches", nargs="+", type=int, default=BATCHES)
    parser.add_argument("--runs", type=int, default=3, help="that count, of each")
    parser.add_argument("--method", default="rj")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.method = "laplace"
    reporter = Reporter(arguments.out)
    batches = (1, 2) if arguments.quick else arguments.batches
    num_runs = 1 if arguments.quick else arguments.runs
    num_rows = QUICK_ROWS if arguments.quick else NUM_ROWS
    first_rate = None
    for batch in batches:
        cold, warm, share = measure(batch, num_runs, num_rows, arguments)
        case = f"{batch} objects, {num_rows} rows, {arguments.method}"
        reporter.report(
            case=case,
            metric="objects whose structure and mass are found",
            value=share,
            n=batch * num_runs,
            target=None if arguments.quick else 0.9,
            met=None if arguments.quick else share >= 0.9,
        )
        middle = float(np.median(warm))
        reporter.report(
            case=case,
            metric="time to compile (cold call less a warm one)",
            value=cold - middle,
            unit="s",
            n=1,
        )
        rate = batch / middle
        first_rate = rate if first_rate is None else first_rate
        reporter.report(
            case=case,
            metric="objects per second, compiled",
            value=rate,
            unit="1/s",
            n=len(warm),
            spread=[batch / max(warm), batch / min(warm)],
            peer=f"batch of {batches[0]}",
            peer_value=first_rate,
        )
    reporter.print_table()


def measure(
    batch: int, num_runs: int, num_rows: int, arguments
) -> tuple[float, list[float], float]:
    """Seconds of the cold call and of the others, and the share that is found."""
    seconds, found = [], []
    for number in range(num_runs + 1):
        objects = make_objects(batch, num_rows, [arguments.seed, batch, number])
        key = jax.random.key(arguments.seed + number)
        start = time.perf_counter()
        posteriors = infer_batch(
            key, objects.specs, objects.histories, method=arguments.method
        )
        seconds.append(time.perf_counter() - start)
        if number:
            found += [
                is_found(truth, posterior)
                for truth, posterior in zip(objects.truths, posteriors, strict=True)
            ]
    return seconds[0], seconds[1:], float(np.mean(found))


def make_objects(num: int, num_rows: int, seed: list[int]) -> Objects:
    """Objects of all families in turn, with noisy recordings."""
    objects = Objects([], [], [])
    for place in range(num):
        rng = np.random.default_rng([*seed, place])
        truth = random_object(rng, FAMILIES[place % len(FAMILIES)])
        table = with_reading_noise(rng, record_random_pushes(rng, truth, num_rows))
        objects.truths.append(truth)
        objects.specs.append(hide(truth))
        objects.histories.append(table.to_history())
    return objects


def is_found(truth: SceneSpec, posterior: Posterior) -> bool:
    """Whether the most probable structure and the median of the mass are right."""
    report = posterior.to_json()
    kinds = sorted(c["type"] for c in report["structure"][0]["constraints"])
    mass = truth.bodies[0].density * truth.bodies[0].area
    error = report["bodies"]["object"]["mass"]["q50"] / mass - 1.0
    is_right = kinds == sorted(constraint.kind for constraint in truth.constraints)
    return is_right and abs(error) < MASS_ERROR


if __name__ == "__main__":
    main()
