"""What stands on the floor in ways that the scene does not tell: has it a wheel?

Discs and boxes press on the floor with all of their area, with four legs at their
corners, legs that carry unequal loads or stand under a part of the outline, with a rim
or with three legs, and slip in 60 pushes each. The truth is this
engine's own step with up to 64 points, so that nothing but where the load rests is in
question. A scene that gives no feet leaves that to be found; legs that it gives are
known. An object is right where friction with the floor and no wheel and no pin has more
than half of the posterior probability.
"""

import json
import sys
import time

import _repository  # noqa: F401
import jax
import numpy as np
from _report import Reporter, parser_of

from boomdp_jax.inference.infer import infer_batch
from tests.inference.standing_objects import STANCES, pushed_object


def main() -> None:
    parser = parser_of(__doc__, quick="2 objects of each")
    parser.add_argument("--objects", type=int, default=16, help="of each stance")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--stances", nargs="+", choices=STANCES, default=STANCES)
    arguments = parser.parse_args()
    reporter = Reporter(arguments.out)
    num = 2 if arguments.quick else arguments.objects
    for stance in arguments.stances:
        objects = [pushed_object([arguments.seed, i], stance) for i in range(num)]
        specs, histories, truths = zip(*objects, strict=True)
        start = time.perf_counter()
        found = infer_batch(
            jax.random.key(arguments.seed), list(specs), list(histories), progress=True
        )
        seconds = time.perf_counter() - start
        results = [
            score(posterior, spec, truth)
            for posterior, spec, truth in zip(found, specs, truths, strict=True)
        ]
        for index, result in enumerate(results):
            if result["friction"] < 0.95 or not result["is_ok"]:
                print(
                    f"{stance} {index}: {json.dumps(result)}",
                    file=sys.stderr,
                    flush=True,
                )
        report(reporter, stance, results, seconds)
    reporter.print_table()


def score(posterior, spec, truth: dict) -> dict:
    """Probabilities, and how far off mass and friction of the floor are."""
    names = posterior.structure_probabilities()
    weights = posterior.weights
    mass = np.asarray(posterior.params.density)[:, 0] * float(spec.scene.area[0])
    ground = jax.tree.map(np.asarray, posterior.params.ground)
    is_on = ground.active[:, 0, 0]
    dry = np.nan
    if is_on.any():
        dry = weights[is_on] @ ground.dry[is_on, 0, 0] / weights[is_on].sum()
    wheel = float(weights @ np.asarray(posterior.params.wheel.active).any((1, 2)))
    return {
        "friction": float(names.get("friction", 0.0)),
        "wheel": wheel,
        "mass": float(weights @ mass / truth["mass"] - 1.0),
        "dry": float(dry / truth["friction"] - 1.0),
        "is_ok": bool(posterior.diagnostics["ok"]),
    }


def report(reporter: Reporter, stance: str, results: list[dict], seconds: float):
    """Shares and errors of one stance."""
    column = {key: np.array([r[key] for r in results]) for key in results[0]}
    is_told = stance.endswith("told")
    values = {
        "share right": np.mean(column["friction"] > 0.5),
        "share with probability >= 0.95": np.mean(column["friction"] >= 0.95),
        "share with a wheel, ok": np.mean((column["wheel"] > 0.5) & column["is_ok"]),
        "share ok": np.mean(column["is_ok"]),
        "median error of the mass": np.median(np.abs(column["mass"])),
        "median error of the friction": np.nanmedian(np.abs(column["dry"])),
        "time per object": seconds / len(results),
    }
    for metric, value in values.items():
        is_target = metric == "share right" and (is_told or stance != "three legs")
        reporter.report(
            case=stance,
            metric=metric,
            value=float(value),
            unit="s" if metric.startswith("time") else "",
            n=len(results),
            target=1.0 if is_target else None,
            met=bool(value >= 1.0) if is_target else None,
        )


if __name__ == "__main__":
    main()
