"""Robots among furniture: who gets to the goal, and how many pushes are wasted.

Random rooms of 2, 4 and 8 things, and the papers' story room, for agents that know,
that learn, and that do not. A room is solved if the robot's body is at its goal with no
overlap, in the engine. Bands are 95 % (Wilson for shares, normal for means).
"""

import math
import pathlib
import tempfile

import numpy as np
from _report import Reporter, parser_of

from boomdp_jax.core.npz_file import read_npz
from boomdp_jax.envs.namo_room import KINDS
from boomdp_jax.experiments.namo_run import begin_namo

_AGENTS = ("true", "physics", "physics-map", "prior", "optimistic", "lightest")
_TABLE, _REVOLUTE = 1, KINDS.index("revolute")


def main() -> None:
    parser = parser_of(__doc__, "three rooms of two things, two agents")
    parser.add_argument("--rooms", type=int, default=100, help="of each size")
    parser.add_argument("--stories", type=int, default=20, help="story rooms")
    parser.add_argument("--things", type=int, nargs="+", default=[2, 4, 8])
    parser.add_argument("--agents", nargs="+", default=list(_AGENTS))
    parser.add_argument(
        "--runs", type=pathlib.Path, help="folder of the runs, which go on where it is"
    )
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.rooms, arguments.stories = 3, 0
        arguments.things, arguments.agents = [2], ["true", "optimistic"]
    with tempfile.TemporaryDirectory() as folder:
        measure(arguments, pathlib.Path(arguments.runs or folder))


def measure(arguments, folder: pathlib.Path) -> None:
    reporter = Reporter(arguments.out)
    for num in arguments.things if arguments.rooms else []:
        found = {
            agent: finished(folder / f"{num}-{agent}", agent, arguments.rooms, num)
            for agent in arguments.agents
        }
        for agent, run in found.items():
            report_rooms(reporter, f"{num} things, {agent}", run, found, agent, num)
    if arguments.stories:
        report_story(reporter, folder, arguments.stories)
    reporter.print_table()


def finished(folder, agent: str, num_rooms: int, num_things: int) -> dict:
    run = begin_namo(agent, folder, num_seeds=num_rooms, num_things=num_things)
    run.run_seeds(run.missing())
    return run.collect()


def report_rooms(reporter, case, run, found, agent, num) -> None:
    solved = run["is_solved"]
    share = float(solved.mean())
    peer = found.get("true")
    peer = None if peer is None or agent == "true" else float(peer["is_solved"].mean())
    is_asked = agent == "physics" and num == 4 and peer is not None
    reporter.report(
        case=case,
        metric="share of rooms solved",
        value=share,
        unit="",
        n=len(solved),
        spread=wilson(share, len(solved)),
        peer=None if peer is None else "true",
        peer_value=peer,
        target=0.9 * peer if is_asked else None,
        met=share >= 0.9 * peer if is_asked else None,
    )
    blind = {
        name: float(other["num_wasted"].mean())
        for name, other in found.items()
        if name in ("prior", "optimistic", "lightest")
    }
    for metric, name, unit in (
        ("wasted pushes", "num_wasted", "pushes"),
        ("pushes", "num_pushes", "pushes"),
        ("time", "seconds", "s"),
        ("effort", "effort", "s"),
    ):
        value = float(run[name].mean())
        asked = agent == "physics" and name == "num_wasted" and num == 4 and blind
        best = min(blind, key=blind.get) if asked else None
        reporter.report(
            case=case,
            metric=metric,
            value=value,
            unit=unit,
            n=len(solved),
            spread=1.96 * float(run[name].std(ddof=1)) / math.sqrt(len(solved)),
            peer=best,
            peer_value=blind[best] if asked else None,
            target=blind[best] if asked else None,
            met=value < blind[best] if asked else None,
        )
    for name in blind if agent == "physics" else ():
        # Both in the same rooms: what sets rooms apart is left out.
        more = found[name]["num_wasted"] - run["num_wasted"].astype(float)
        band = 1.96 * float(more.std(ddof=1)) / math.sqrt(len(more))
        reporter.report(
            case=case,
            metric=f"wasted pushes fewer than those of {name}, room by room",
            value=float(more.mean()),
            unit="pushes",
            n=len(more),
            spread=band,
            peer=name,
            peer_value=blind[name],
            target=0.0 if num == 4 else None,
            met=bool(more.mean() > band) if num == 4 else None,
        )
    seconds = run["decision_seconds"]
    is_asked = agent == "physics"
    value = float(np.nanmedian(seconds))
    reporter.report(
        case=case,
        metric="belief update and plan, median",
        value=1e3 * value,
        unit="ms",
        n=int(np.sum(np.isfinite(seconds))),
        spread=None,
        target=300.0 if is_asked else None,
        met=value < 0.3 if is_asked else None,
    )


def report_story(reporter, folder, num: int) -> None:
    run = begin_namo("physics", folder / "story", num_seeds=num, room="story")
    run.run_seeds(run.missing())
    run.collect()
    done = [read_npz(run.path(seed)) for seed in range(num)]
    told = [as_told(one) for one in done]
    reporter.report(
        case="story room, physics",
        metric="table first, revolute over 0.9, then the couch, goal reached",
        value=sum(told),
        unit="rooms",
        n=num,
        spread=None,
        target=0.9 * num,
        met=sum(told) >= 0.9 * num,
    )
    for metric, count in (
        ("solved", [bool(one["is_solved"]) for one in done]),
        ("table tried first", [list(one["try_thing"][:1]) == [_TABLE] for one in done]),
        ("revolute over 0.9 after it", [belief_after(one) > 0.9 for one in done]),
    ):
        reporter.report(
            case="story room, physics",
            metric=metric,
            value=sum(count),
            unit="rooms",
            n=num,
            spread=None,
        )


def belief_after(record: dict) -> float:
    """Share of the revolute kind when the first tries of the table were over."""
    things = list(record["try_thing"])
    if not things or things[0] != _TABLE:
        return 0.0
    last = next((i for i, t in enumerate(things) if t != _TABLE), len(things)) - 1
    return float(record["try_shares"][last, _REVOLUTE])


def as_told(record: dict) -> bool:
    things = list(record["try_thing"])
    couch_last = bool(things) and things[-1] != _TABLE
    return bool(record["is_solved"]) and couch_last and belief_after(record) > 0.9


def wilson(share: float, num: int) -> float:
    """Half the width of Wilson's 95 % interval."""
    z = 1.96
    inside = share * (1 - share) / num + z**2 / (4 * num**2)
    return z * math.sqrt(inside) / (1 + z**2 / num)


if __name__ == "__main__":
    main()
