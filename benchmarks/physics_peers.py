"""How fast and how right are other engines on the same scenes, in the same run?

Scenes, all at 60 Hz: one body on a pin, and on a pin and a wheel (a peer without wheels
is set against ours with the pin only); a pendulum let go horizontally, for 5 s, against
SciPy; ten boxes in a walled room, flying without gravity, and piling up, with the
deepest overlap seen, found by one function for every engine. Batches are worlds with
different starts and one model.

Peers: MuJoCo C on all cores (pins as hinges and as equalities), MJX, Brax (generalized
and spring), Jax2D, pymunk and Box2D. The settings of each are in `_peers_<name>.py`:
what its manual advises at 60 Hz. The last two run in a loop over worlds on one core,
without reading out their states, which the others return; CPU time is that of the whole
process, over all threads. An engine's answer is judged before it is timed, and one that
is missing, or fails, is reported with its reason. A batch that would take longer than
`--limit` seconds a run is left out.
"""

import contextlib
import dataclasses
import importlib
import sys
from collections.abc import Callable

from _peers_program import Figure, Peer, measure
from _peers_scenes import Case, all_cases
from _peers_table import OURS, Row, find, print_lines, print_rows
from _report import Reporter, parser_of

MODULES = ("ours", "mujoco", "mjx", "brax", "jax2d", "pymunk", "box2d")
JUDGED_BATCH = 64
"""Largest batch whose answer is looked at."""
NUM_RUNS = 5


@dataclasses.dataclass
class Results:
    """What is known so far."""

    reporter: Reporter
    rows: list[Row] = dataclasses.field(default_factory=list)
    reasons: dict[tuple[str, str], list[str]] = dataclasses.field(default_factory=dict)
    """Scenes that an engine did not run, by engine and reason."""
    figures: dict[str, dict[str, list[Figure]]] = dataclasses.field(
        default_factory=dict
    )
    """How right an answer is, by scene and engine."""

    def refuse(self, case: str, engine: str, reason: str) -> None:
        """Say in one line why an engine is missing."""
        line = " ".join(reason.split())[:200]
        self.reasons.setdefault((engine, line), []).append(case)
        self.reporter.report(
            case=case, metric=f"not run: {line}", value=None, peer=engine
        )


def find_peers(results: Results) -> list[Peer]:
    """Every engine that is installed, ours first."""
    peers: list[Peer] = []
    for name in MODULES:
        try:
            # Standard output is for JSON lines, whatever a package prints.
            with contextlib.redirect_stdout(sys.stderr):
                peers += importlib.import_module(f"_peers_{name}").PEERS
        except ImportError as error:
            results.refuse("all scenes", name, f"not installed ({error})")
    return peers


def run_case(
    results: Results, case: Case, peer: Peer, batches: tuple[int, ...], limit: float
) -> None:
    """Judge and time one engine on one scene, at growing batches."""
    seconds_per_step = 0.0
    figures: list[Figure] = []
    for batch in batches:
        world_steps = batch * case.num_steps
        expected = seconds_per_step * world_steps
        if expected > limit:
            reason = f"batch {batch} would take {expected:.0f} s a run"
            results.refuse(case.name, peer.name, reason)
            break
        try:
            program = peer.prepare(case.spec, case.starts(batch), case.num_steps)
            if batch <= JUDGED_BATCH:
                figures = case.judge(program.states())
        except Exception as error:  # Whatever a peer raises is its result.
            results.refuse(case.name, peer.name, str(error) or type(error).__name__)
            break
        wrong = [f for f in figures if f.bound is not None and not f.value <= f.bound]
        if wrong:
            reason = f"no right answer: {wrong[0].metric} {wrong[0].value:.3g}"
            results.refuse(case.name, peer.name, f"{reason} {wrong[0].unit}")
            break
        timing = measure(program, NUM_RUNS, limit)
        seconds_per_step = timing.median / world_steps
        num_bodies = sum(not body.is_static for body in case.spec.bodies)
        row = Row(
            case.name,
            batch,
            peer.name,
            timing,
            world_steps,
            num_bodies,
            program.compile_seconds,
        )
        results.rows.append(row)
        report_timing(results, row)
    report_figures(results, case.name, peer.name, figures)


def report_timing(results: Results, row: Row) -> None:
    """Our figure beside the peer's; ours alone in our own row."""
    own = find(results.rows, row.case, row.batch)
    case = f"{row.case}, batch {row.batch}"

    def write(metric: str, unit: str, value: Callable, spread: Callable) -> None:
        is_own = own is row
        results.reporter.report(
            case=case,
            metric=metric,
            value=None if own is None else value(own),
            unit=unit,
            n=len(row.timing.wall),
            spread=spread(row),
            peer=None if is_own else row.engine,
            peer_value=None if is_own else value(row),
        )

    work = row.world_steps * row.num_bodies
    write(
        "rate, fastest run (spread: this engine's median run)",
        "body-steps/s",
        lambda r: r.rate,
        lambda r: [work / r.timing.median],
    )
    per_step = 1e6 / row.world_steps
    write(
        "wall time of a world step, median run (spread: this engine's fastest)",
        "us",
        lambda r: r.wall,
        lambda r: [per_step * r.timing.fastest],
    )
    write(
        "CPU time of a world step, all threads, median run (spread: its least)",
        "us",
        lambda r: r.cpu,
        lambda r: [per_step * min(r.timing.cpu)],
    )
    if row.compile_seconds is not None:
        write("compile", "s", lambda r: r.compile_seconds, lambda r: None)


def report_figures(
    results: Results, case: str, engine: str, figures: list[Figure]
) -> None:
    """How right the answer is, at the largest batch that was judged."""
    if not figures:
        return
    known = results.figures.setdefault(case, {})
    known[engine] = figures
    own = {figure.metric: figure.value for figure in known.get(OURS, [])}
    for figure in figures:
        results.reporter.report(
            case=case,
            metric=figure.metric,
            value=own.get(figure.metric),
            unit=figure.unit,
            peer=None if engine == OURS else engine,
            peer_value=None if engine == OURS else figure.value,
        )


def print_results(results: Results) -> None:
    """Speeds, then answers, then what is missing and why."""
    print_rows(results.rows)
    for case, by_engine in results.figures.items():
        first = next(iter(by_engine.values()))
        lines = [[case, *(f"{f.metric} [{f.unit}]" for f in first)]]
        for engine, figures in by_engine.items():
            lines.append([engine, *(f"{figure.value:.3g}" for figure in figures)])
        print_lines(lines)
    for (engine, reason), cases in results.reasons.items():
        where = "; ".join(cases)
        print(f"not run: {engine}: {reason} ({where})", file=sys.stderr)


def main() -> int:
    """Run every engine on every scene."""
    parser = parser_of(__doc__)
    parser.add_argument("--only", default="", help="engines whose name contains this")
    parser.add_argument("--scene", default="", help="scenes whose name contains this")
    parser.add_argument("--limit", type=float, default=30.0, help="seconds a run")
    arguments = parser.parse_args()
    results = Results(Reporter(arguments.out))
    peers = find_peers(results)
    for case in all_cases(is_quick=arguments.quick):
        if arguments.scene not in case.name:
            continue
        for peer in peers:
            is_own = peer is peers[0]
            if arguments.only not in peer.name and not is_own:
                continue
            batches = case.batches
            if arguments.quick:
                if peer.quick_cases is not None and case.name not in peer.quick_cases:
                    reason = "a quick run has no time for its compilation"
                    results.refuse(case.name, peer.name, reason)
                    continue
                if peer.quick_cases is not None:
                    batches = batches[-1:]
            run_case(results, case, peer, batches, arguments.limit)
    print_results(results)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
