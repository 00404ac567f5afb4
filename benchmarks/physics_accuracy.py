"""How far is the engine from the truth, and how far are others, on the same scenes?

Every scene has a closed form or a reference that shares nothing with the engine: SciPy
on minimal coordinates (rtol 1e-10) for pendulums and chains, on dry feet for a turning
box, quasi-static balance for a box in tow. All engines run at 60 Hz with the settings
of `_peers_<name>.py`; ours in single precision, as a user has it. Figures are errors:
the less the better. Friction between bodies is zero in collisions; MuJoCo has no
coefficient of restitution, Box2D takes none below 1 m/s.
"""

import importlib
import sys

from _accuracy_case import Case
from _accuracy_collisions import collision_cases
from _accuracy_friction import friction_cases
from _accuracy_smooth import smooth_cases
from _peers_program import Figure, Peer
from _peers_table import OURS, print_lines
from _report import Reporter, parser_of

MODULES = ("ours", "mujoco", "pymunk", "box2d")


def find_peers() -> tuple[list[Peer], dict[str, list[str]]]:
    """Engines that are installed, ours first; what is missing and why, and where."""
    peers: list[Peer] = []
    missing: dict[str, list[str]] = {}
    for name in MODULES:
        try:
            peers += importlib.import_module(f"_peers_{name}").PEERS
        except ImportError as error:
            missing[f"{name}: not installed ({error})"] = ["all scenes"]
    return peers, missing


def judge(
    case: Case, peers: list[Peer]
) -> tuple[dict[str, list[Figure]], dict[str, str]]:
    """Figures of every engine, and the reason of each that has none."""
    figures, reasons = {}, {}
    for peer in peers:
        try:
            program = peer.prepare(case.spec, case.start[None], case.num_steps)
            figures[peer.name] = case.judge(program.states()[0])
        except Exception as error:  # Whatever a peer raises is its result.
            line = " ".join(str(error).split())[:200]
            reasons[peer.name] = line or type(error).__name__
    for name, states in case.stand_ins.items():
        figures[name] = case.judge(states)
    return figures, reasons


def report(
    reporter: Reporter, case: Case, figures: dict[str, list[Figure]], reasons: dict
) -> None:
    """Our error beside each peer's."""
    own = {figure.metric: figure.value for figure in figures.get(OURS, [])}
    for engine, values in figures.items():
        for figure in values:
            reporter.report(
                case=case.name,
                metric=f"error, {figure.metric}",
                value=own.get(figure.metric),
                unit=figure.unit,
                n=1,
                peer=None if engine == OURS else engine,
                peer_value=None if engine == OURS else figure.value,
            )
    for engine, reason in reasons.items():
        reporter.report(
            case=case.name, metric=f"not run: {reason}", value=None, peer=engine
        )


def print_case(case: Case, figures: dict[str, list[Figure]]) -> None:
    """One small table for a scene: a row for each engine."""
    if not figures:
        return
    first = next(iter(figures.values()))
    lines = [[case.name, *(f"{f.metric} [{f.unit}]" for f in first)]]
    for engine, values in figures.items():
        lines.append([engine, *(f"{figure.value:.3g}" for figure in values)])
    print_lines(lines)


def main() -> int:
    """Run every engine on every scene."""
    parser = parser_of(__doc__)
    parser.add_argument("--scene", default="", help="scenes whose name contains this")
    arguments = parser.parse_args()
    reporter = Reporter(arguments.out)
    peers, absent = find_peers()
    for case in [*smooth_cases(), *friction_cases(), *collision_cases()]:
        is_left_out = arguments.quick and not case.in_quick
        if arguments.scene not in case.name or is_left_out:
            continue
        figures, reasons = judge(case, peers)
        report(reporter, case, figures, reasons)
        print_case(case, figures)
        for engine, reason in reasons.items():
            absent.setdefault(f"{engine}: {reason}", []).append(case.name)
    for reason, names in absent.items():
        print(f"not run: {reason} ({'; '.join(names)})", file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
