"""Is it a door, a drawer or fixed, and where does it turn or slide?

MuJoCo holds random boxes on a hinge, on a slide or fast; a hand pushes and pulls each
at a handle, eight times for two seconds, and a camera reads it 20 times a second with
noise of 1 mm, 1 mrad, 4 mm/s and 4 mrad/s. Pin, drawer, weld and friction with the
floor are all unknown. An object is right where the joint with the largest posterior
probability, with or without friction of the floor, is the true one.

Errors of posterior means over draws with the true joint, each relative to what the
number is of: hinge on the body and in the world, by the longer side of the outline; a
drawer's axis, by a radian; how far its line passes from the true one, and the place of
what is fixed, by the longer side; mass, by the true one (that of a fixed thing cannot
be told).

With `--stops` doors and drawers go no further than 0.05 to 0.25 m, or rad, either way,
and come against that; hypotheses do not know of it, and rows there are left out.
"""

import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
from _joint_objects import KINDS, JointObject, handled, random_object, scene_of
from _report import Reporter, parser_of

from boomdp_jax.core.atomic import atomic_write
from boomdp_jax.inference.infer import infer_batch
from boomdp_jax.inference.posteriors.summary import axial_difference

JOINTS = tuple(KINDS.values())
STOPPED = "may have come against a stop"
"""In the note on rows that are left out."""
TARGET_SHARE, TARGET_ERROR = 0.99, 0.05


def main() -> None:
    parser = parser_of(__doc__, quick="3 objects")
    parser.add_argument("--objects", type=int, default=240, help="over all kinds")
    parser.add_argument("--batch", type=int, default=48, help="objects in one call")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stops", action="store_true", help="they have end stops")
    parser.add_argument(
        "--keep",
        type=Path,
        metavar="FOLDER",
        help="write what was found in each batch there, and go on with what is missing",
    )
    arguments = parser.parse_args()
    reporter = Reporter(arguments.out)
    num = 3 if arguments.quick else arguments.objects
    objects = make_objects(num, arguments.seed, has_stops=arguments.stops)
    batch = min(num, arguments.batch)
    results, seconds = [], []
    for begin in range(0, num, batch):
        # The last batch is filled up, so that all share one compiled call.
        chosen = [objects[i % num] for i in range(begin, begin + batch)]
        found = None
        if arguments.keep is not None:
            names = [f"{key}-{getattr(arguments, key)}" for key in ("seed", "batch")]
            names += ["stops"] * arguments.stops
            found = arguments.keep / f"{'-'.join(names)}-from-{begin}.json"
        if found is not None and found.exists():
            kept = json.loads(found.read_text(encoding="utf-8"))
        else:
            kept = of_batch(chosen, arguments.seed + begin)
            if found is not None:
                found.parent.mkdir(exist_ok=True)
                atomic_write(found, json.dumps(kept).encode())
        seconds.append(kept["seconds"])
        for place, result in enumerate(kept["results"]):
            results.append(result)
            note_failure(begin + place, result)
    results = results[:num]
    report_all(reporter, results)
    # The first call compiles.
    rest = seconds[1:] or seconds
    reporter.report(
        case=f"batch of {batch}",
        metric="time per object",
        value=float(np.median(rest)) / batch,
        unit="s",
        n=len(rest),
        spread=[min(rest) / batch, max(rest) / batch],
    )
    reporter.report(
        case=f"batch of {batch}",
        metric="time of first call",
        value=seconds[0],
        unit="s",
    )
    reporter.print_table()


def of_batch(chosen: list[tuple], seed: int) -> dict:
    """Scores of some objects, and how long their inference took."""
    start = time.perf_counter()
    posteriors = infer_batch(
        jax.random.key(seed),
        [scene_of(thing) for thing, _ in chosen],
        [history for _, history in chosen],
        progress=True,
    )
    seconds = time.perf_counter() - start
    results = [
        score(thing, posterior)
        for (thing, _), posterior in zip(chosen, posteriors, strict=True)
    ]
    return {"seconds": seconds, "results": results}


def make_objects(num: int, seed: int, *, has_stops: bool = False) -> list[tuple]:
    """Truth and readings of each object, kinds in turn."""
    objects = []
    for index in range(num):
        rng = np.random.default_rng([seed, index])
        kind = list(KINDS)[index % len(KINDS)]
        thing = random_object(rng, kind, has_stops=has_stops)
        objects.append((thing, handled(rng, thing)))
    return objects


def score(thing: JointObject, posterior) -> dict:
    """Probabilities of the joints, and errors of what the true one has."""
    params = jax.tree.map(np.asarray, posterior.params)
    weights = posterior.weights
    active = {kind: getattr(params, kind).active[:, 0] for kind in JOINTS}
    probability = {kind: float(weights @ on) for kind, on in active.items()}
    probability["none"] = 1.0 - sum(probability.values())
    kind = KINDS[thing.kind]
    chosen = active[kind]
    errors = {}
    if chosen.any():
        draws = jax.tree.map(lambda leaf: leaf[chosen], params)
        errors = errors_of(thing, draws, weights[chosen] / weights[chosen].sum())
    return {
        "kind": thing.kind,
        "is_right": max(probability, key=lambda name: probability[name]) == kind,
        "probability": probability[kind],
        "errors": {name: float(error) for name, error in errors.items()},
        "is_ok": posterior.diagnostics["ok"],
        "reasons": posterior.diagnostics["reasons"],
        "is_cut": any(STOPPED in note for note in posterior.diagnostics["notes"]),
    }


def note_failure(number: int, result: dict) -> None:
    """Say on standard error which object is wrong, and how."""
    worst = max(result["errors"].values(), default=np.inf)
    if not result["is_right"] or worst >= TARGET_ERROR or not result["is_ok"]:
        print(f"object {number}: {result}", file=sys.stderr, flush=True)


def errors_of(thing: JointObject, draws, weight: np.ndarray) -> dict[str, float]:
    """Relative errors of posterior means."""
    area = 4.0 * thing.half.prod()
    errors = {}
    if thing.kind != "fixed":
        mass = weight @ (draws.density[:, 0] * area)
        errors["mass"] = abs(mass / thing.mass - 1.0)
    if thing.kind == "door":
        on_body = weight @ draws.revolute.anchor_a[:, 0]
        in_world = weight @ draws.revolute.anchor_b[:, 0]
        errors["hinge on the body"] = np.hypot(*(on_body - thing.hinge)) / thing.size
        off = in_world - thing.hinge_in_world
        errors["hinge in the world"] = np.hypot(*off) / thing.size
        return errors
    joint = draws.prismatic if thing.kind == "drawer" else draws.weld
    off = weight @ joint.anchor_b[:, 0] - thing.pose[:2]
    if thing.kind == "fixed":
        errors["place"] = np.hypot(*off) / thing.size
    else:
        turn = weight @ axial_difference(joint.axis[:, 0], thing.axis)
        errors["axis"] = abs(turn)
        across = np.array([-np.sin(thing.axis), np.cos(thing.axis)])
        errors["line"] = abs(off @ across) / thing.size
    return {name: float(error) for name, error in errors.items()}


def report_all(reporter: Reporter, results: list[dict]) -> None:
    """Shares and errors, over all objects and by kind."""
    for case in ("all", *KINDS):
        mine = [r for r in results if case in ("all", r["kind"])]
        share = float(np.mean([r["is_right"] for r in mine]))
        reporter.report(
            case=case,
            metric="share of right joints",
            value=share,
            n=len(mine),
            spread=float(np.sqrt(share * (1.0 - share) / len(mine))),
            target=TARGET_SHARE,
            met=share >= TARGET_SHARE,
        )
        sure = float(np.mean([r["probability"] >= 0.95 for r in mine]))
        reporter.report(
            case=case,
            metric="share whose joint has probability >= 0.95",
            value=sure,
            n=len(mine),
        )
        names = dict.fromkeys(name for r in mine for name in r["errors"])
        if case == "all":
            worst = [max(r["errors"].values(), default=np.inf) for r in mine]
            report_errors(reporter, case, "worst number of each object", worst)
            continue
        for name in names:
            values = [r["errors"].get(name, np.inf) for r in mine]
            report_errors(reporter, case, name, values)
    reporter.report(
        case="all",
        metric="share with diagnostics ok",
        value=float(np.mean([r["is_ok"] for r in results])),
        n=len(results),
    )
    reporter.report(
        case="all",
        metric="share of which rows at stops are left out",
        value=float(np.mean([r["is_cut"] for r in results])),
        n=len(results),
    )
    far_off = [max(r["errors"].values(), default=0.0) >= TARGET_ERROR for r in results]
    is_ok = [r["is_ok"] for r in results]
    reporter.report(
        case="all",
        metric=f"share ok with a number off by {TARGET_ERROR:g} or more",
        value=float(np.mean(np.array(far_off) & is_ok)),
        n=len(results),
    )


def report_errors(reporter: Reporter, case: str, name: str, values: list) -> None:
    """Median of an error, and the share of objects in which it is small enough."""
    median = float(np.median(values))
    reporter.report(
        case=case,
        metric=f"median relative error: {name}",
        value=median,
        n=len(values),
        spread=float(np.quantile(values, 0.9)),
        target=TARGET_ERROR,
        met=median < TARGET_ERROR,
    )
    reporter.report(
        case=case,
        metric=f"share under {TARGET_ERROR:g}: {name}",
        value=float(np.mean(np.array(values) < TARGET_ERROR)),
        n=len(values),
    )


if __name__ == "__main__":
    main()
