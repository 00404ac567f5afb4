"""Is an object that nobody touched understood from others of its kind?

Rooms of twenty objects of four kinds (light box, heavy box, cart on a wheel, pinned
table), half of which are pushed for ten transitions; within a kind, sizes, densities
and friction scatter by five per cent. The truth is simulated by the library's engine,
readings scatter by 1 mm, 1 mrad, 4 mm/s and 4 mrad/s. The other half is then pushed
anew, and its motion predicted from rest: by a mixture over kinds that is given labels,
or outlines, or neither, and by separate posteriors, which for what was never touched
are the prior (with pins where the body stands). Error is that of the predictive median,
and of the mean, which the prior's tails of very light objects spoil; log score that of
a normal distribution with the draws' mean and variance.
"""

import sys
import time

import jax
import numpy as np
from _kind_scenes import KINDS, NOISE, Room, draw_pushes, make_room, predict, run
from _report import Reporter, parser_of

from boomdp_jax.inference.kinds.chains import KindSettings
from boomdp_jax.inference.kinds.infer_kinds import infer_kinds_of
from boomdp_jax.inference.kinds.objects import sample_alone
from boomdp_jax.inference.kinds.posterior import KindsPosterior
from boomdp_jax.inference.kinds.prior import KindPrior
from boomdp_jax.inference.samplers.structure_draws import SampleSettings

HORIZONS = (5, 20)
"""Steps ahead, of 40 ms."""
NUM_DRAWS = 256
CASES = {
    "labels": {"use_labels": True, "use_outlines": False},
    "outlines": {"use_labels": False, "use_outlines": True},
    "neither": {"use_labels": False, "use_outlines": False},
}
# So readily of a kind of its own that nothing is shared.
_SEPARATE = 1e12


def main() -> None:
    parser = parser_of(__doc__, quick="one room of eight objects, few draws")
    parser.add_argument("--rooms", type=int, default=5, help="random rooms")
    parser.add_argument("--bodies", type=int, default=20, help="objects in each")
    parser.add_argument("--rows", type=int, default=10, help="transitions of a push")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.rooms, arguments.bodies = 1, 8
    settings = KindSettings(num_warmup=50, num_samples=70)
    sampling = SampleSettings()
    if arguments.quick:
        settings = KindSettings(num_chains=16, num_warmup=15, num_samples=15)
        sampling = SampleSettings(num_warmup=64, num_samples=128, num_importance=512)
    reporter = Reporter(arguments.out)
    scores: dict[str, list[dict]] = {name: [] for name in ("separate", *CASES)}
    for number in range(arguments.rooms):
        rng = np.random.default_rng([arguments.seed, number])
        room = make_room(
            rng,
            arguments.bodies,
            arguments.rows,
            with_outlines=True,
            with_labels=True,
        )
        key = jax.random.key(arguments.seed + number)
        one = score_room(rng, key, room, settings, sampling)
        for name, score in one.items():
            scores[name].append(score)
            error = np.sqrt(np.mean(score["median"] ** 2, axis=1)).round(4)
            print(f"room {number}, {name}: {error} m", file=sys.stderr, flush=True)
    for name in CASES:
        report_case(reporter, name, scores[name], scores["separate"])
    reporter.print_table()


def score_room(rng, key, room: Room, settings, sampling) -> dict[str, dict]:
    """Errors and scores of every way of looking at one room."""
    specs, histories = [room.seen], [room.history]
    start = time.perf_counter()
    objects = sample_alone(key, specs, histories, sampling)
    alone = time.perf_counter() - start
    wrench = draw_pushes(rng, room.truth, max(HORIZONS)) * ~room.is_pushed[:, None]
    truth = run(room.truth, wrench)[list(HORIZONS)]
    out = {}
    for name in ("separate", *CASES):
        options = CASES.get(name, CASES["neither"])
        fixed = _SEPARATE if name == "separate" else None
        start = time.perf_counter()
        found = infer_kinds_of(
            jax.random.fold_in(key, 1),
            specs,
            histories,
            objects,
            settings._replace(concentration=fixed),
            KindPrior(),
            **options,
        )
        seconds = time.perf_counter() - start
        score = score_prediction(room, found, wrench, truth)
        score |= score_kinds(room, found)
        out[name] = score | {"seconds": seconds, "alone": alone}
    return out


def score_prediction(room: Room, found: KindsPosterior, wrench, truth) -> dict:
    """Errors `[horizon, body]` and log scores over objects that were not touched."""
    posterior = found.posterior.thin(NUM_DRAWS)
    states = predict(room.seen, posterior.params, wrench)
    states = states[:, np.array(HORIZONS) - 1]
    pose = states[:, :, ~room.is_pushed, :3]
    right = truth[:, ~room.is_pushed, :3]
    mean, median = pose.mean(0), np.median(pose, axis=0)
    variance = pose.var(0) + NOISE[:3] ** 2
    score = -0.5 * ((right - mean) ** 2 / variance + np.log(2 * np.pi * variance))
    return {
        "median": np.linalg.norm((median - right)[..., :2], axis=-1),
        "mean": np.linalg.norm((mean - right)[..., :2], axis=-1),
        "angle": np.abs((median - right)[..., 2]),
        "log_score": score.sum(-1),
    }


def score_kinds(room: Room, found: KindsPosterior) -> dict:
    """How well the kinds were told apart, and whether the chains agree."""
    together, kind = found.co_clustering(), room.kind
    other = ~np.eye(len(kind), dtype=bool)
    same = (kind[:, None] == kind[None]) & other
    touched = ~room.is_pushed[:, None] & room.is_pushed[None]
    return {
        "same": float(together[same & touched].mean()),
        "different": float(together[~same & other & touched].mean()),
        "right number": found.num_kinds().get(len(KINDS), 0.0),
        "r_hat": float(found.posterior.diagnostics["r_hat"]),
        "acceptance": float(found.acceptance.min()),
    }


def report_case(reporter: Reporter, name: str, mine: list, separate: list) -> None:
    """One way of looking at rooms against separate posteriors."""
    case = f"{len(mine)} rooms, {name}"
    n = len(mine) * mine[0]["median"].shape[1]
    target = 1.0 if name == "neither" else 1 / 3
    for place, horizon in enumerate(HORIZONS):
        for kind in ("median", "mean", "angle"):
            ours = np.array([np.mean(s[kind][place] ** 2) for s in mine])
            theirs = np.array([np.mean(s[kind][place] ** 2) for s in separate])
            ratio = float(np.sqrt(ours.mean() / theirs.mean()))
            what = "angle" if kind == "angle" else f"position ({kind})"
            reporter.report(
                case=f"{case}, {horizon} steps",
                metric=f"RMS error of untouched objects' {what}, over separate",
                value=ratio,
                n=n,
                spread=[float(x) for x in np.sqrt(ours / theirs)],
                peer="RMS errors",
                peer_value=None,
                target=target,
                met=ratio <= target,
            )
            reporter.report(
                case=f"{case}, {horizon} steps",
                metric=f"RMS error of untouched objects' {what}",
                value=float(np.sqrt(ours.mean())),
                unit="rad" if kind == "angle" else "m",
                n=n,
                peer="separate",
                peer_value=float(np.sqrt(theirs.mean())),
            )
        ours = np.array([s["log_score"][place].mean() for s in mine])
        theirs = np.array([s["log_score"][place].mean() for s in separate])
        reporter.report(
            case=f"{case}, {horizon} steps",
            metric="log predictive density of a pose",
            value=float(ours.mean()),
            unit="nat",
            n=n,
            spread=[float(x) for x in ours],
            peer="separate",
            peer_value=float(theirs.mean()),
            target="no less than separate",
            met=ours.mean() >= theirs.mean(),
        )
    for metric, key in (
        ("an untouched and a pushed object of one kind are taken together", "same"),
        ("the same of different kinds", "different"),
        ("probability of the right number of kinds", "right number"),
        ("largest R-hat", "r_hat"),
        ("smallest acceptance of an object's proposals", "acceptance"),
        ("time of the mixture", "seconds"),
        ("time of each object by itself", "alone"),
    ):
        values = [s[key] for s in mine]
        reporter.report(
            case=case,
            metric=metric,
            value=float(np.mean(values)),
            unit="s" if "time" in metric else "",
            n=len(values),
            spread=[float(min(values)), float(max(values))],
        )


if __name__ == "__main__":
    main()
