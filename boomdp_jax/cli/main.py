"""The command line: reads arguments, calls the library, answers bad input with 2."""

import argparse
import importlib
import math
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import NoReturn, TextIO

METHODS = ("auto", "rj", "enumerate", "smc", "nuts", "svi", "laplace", "map")
"""Ways to infer that exist."""

LIKELIHOODS = ("auto", "filtered", "one-step", "open-loop")
"""Likelihoods of readings that exist."""

OUTLIERS = ("none", "student-t")
"""Laws of the readings' noise that exist."""

TASKS = ("pendulum", "cart", "acrobot", "living-room", "namo")
"""Tasks of `run`."""

AGENTS = (
    "true",
    "physics",
    "physics-map",
    "physics-informative",
    "physics-pretrained",
    "physics-residual",
    "point-fit",
    "cma-es",
    "lr",
    "lr-body",
    "lwr",
    "lwr-world",
    "lwr-pretrained",
    "oo-lwr",
    "gp",
    "ensemble",
    "physics-kinds",
    "papers",
    "true-way",
    "physics-way",
    "random",
    "prior",
    "optimistic",
    "lightest",
    "navigation",
)
"""Agents of `run`; the last four, and no others but `true`, `physics` and
`physics-map`, do namo."""

WORLDS = ("as-told", "dry", "off-centre", "caster", "large", "box")
"""Worlds of the cart."""


FIGURES = (
    "1a",
    "1b",
    "2a",
    "2b",
    "cart",
    "cart-noisy-1",
    "cart-noisy-4",
    "cart-noisy-16",
    "cart-noisy-64",
    "apartment",
    "acrobot",
)
"""Figures of `figure`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: arguments after the program's name; default: those of the process.

    Returns:
        Exit status: 0; 2 for bad input, then with one line on standard error; or 1
        where all was done but what inference refused, with a line for each.
    """
    try:
        arguments = _make_parser().parse_args(argv)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2
    # Where a compiled program comes from disk, XLA complains at length that features
    # which it gave it itself (`prefer-no-gather`) are not the machine's.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    importlib.import_module("boomdp_jax.core").keep_programs()
    command = importlib.import_module(f"boomdp_jax.cli.{arguments.command}")
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        warnings.showwarning = _show_warning  # ty: ignore[invalid-assignment]
        try:
            failed = command.run(arguments) or []
        except IsADirectoryError as error:
            folder = error.filename
            _complain(
                f"{folder}: Is a directory; expected a file (of several recordings: "
                f"{folder}/*.npz)"
            )
            return 2
        except OSError as error:
            message = error.strerror or str(error)
            _complain(f"{error.filename}: {message}" if error.filename else message)
            return 2
        except ValueError as error:
            _complain(str(error))
            return 2
    for line in failed:
        _complain(line)
    return 1 if failed else 0


class _OneLineParser(argparse.ArgumentParser):
    """A parser whose complaint is one line; argparse offers no other way to say so."""

    def error(self, message: str) -> NoReturn:
        _complain(message)
        self.exit(2)


class _Versions(argparse.Action):
    """Prints versions and stops; libraries are asked for only then."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        versions = importlib.import_module("boomdp_jax.core.versions")
        found = versions.library_versions().items()
        print(", ".join(f"{name} {version}" for name, version in found))
        parser.exit()


def _make_parser() -> argparse.ArgumentParser:
    parser = _OneLineParser(
        prog="boomdp_jax", description="Learn what a pushed object is, and use it."
    )
    parser.add_argument(
        "--version",
        action=_Versions,
        nargs=0,
        help="of this and of what it computes with",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    _add_infer(commands.add_parser("infer", help="from recordings to a posterior"))
    _add_predict(commands.add_parser("predict", help="held-out error and coverage"))
    _add_simulate(commands.add_parser("simulate", help="from wrenches to a recording"))
    _add_run(commands.add_parser("run", help="an agent learns a task, over seeds"))
    _add_plot(commands.add_parser("plot", help="from runs to curves and a table"))
    _add_figure(commands.add_parser("figure", help="figures of the papers, run anew"))
    _add_view(commands.add_parser("view", help="from a recording to a moving picture"))
    return parser


def _add_infer(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("data", nargs="+", metavar="DATA.npz", help="planar-transitions-1")
    add("--scene", required=True, metavar="SCENE.json", help="planar-scene-1")
    add("--rows", type=_whole(1), metavar="N", help="use the first N rows")
    add("--method", choices=METHODS, default="auto")
    add(
        "--likelihood",
        choices=LIKELIHOODS,
        default="auto",
        help="filtered: all readings are noisy; one-step: those that a step starts from"
        " are exact; open-loop: so are those that a long prediction starts from, which"
        " makes intervals too narrow; default: filtered, of nuts and svi one-step",
    )
    add(
        "--horizon",
        type=_whole(1),
        metavar="K",
        help="of open-loop: most steps of a prediction; default: no limit",
    )
    add(
        "--outliers",
        choices=OUTLIERS,
        default="none",
        help="student-t: of readings with gross errors, which it takes little heed of;"
        " default: none, noise is normal",
    )
    add("--seed", type=_whole(0, 2**32 - 1), default=0)
    add(
        "--out",
        metavar="POST.npz|DIR/",
        help="write the posterior; of several data files, to POST-0.npz, POST-1.npz...;"
        " with a slash: a sweep, each unit written to the folder as it is done",
    )
    add(
        "--batch",
        type=_whole(1),
        metavar="N",
        help="of a sweep: data files in a unit, inferred in one call; default: 16",
    )
    add(
        "--shard",
        type=_shard,
        metavar="I/N",
        help="of a sweep: do units I, I + N, I + 2 N... only; I from 0",
    )
    add(
        "--resume",
        action="store_true",
        help="of a sweep: go on where the folder stands, to the same bits; what"
        " inference refused is not tried again",
    )
    add("--json", action="store_true", help="one JSON object a data file, a line each")
    add("--plot", metavar="FIG.png", help="draw the posterior; numbered like --out")


def _add_predict(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("posterior", metavar="POST.npz", help="what infer --out wrote")
    add("data", metavar="DATA.npz", help="planar-transitions-1")
    add("--horizon", nargs="+", type=_whole(1), default=[1, 10, 50], metavar="STEPS")
    add("--json", action="store_true", help="one JSON object on standard output")


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("scene", metavar="SCENE.json", help="planar-scene-1")
    add("--actions", required=True, metavar="A.npz", help="wrenches to apply")
    add("--out", required=True, metavar="DATA.npz", help="planar-transitions-1")
    add("--posterior", metavar="POST.npz", help="take the parameters from a draw")
    add("--draw", type=_whole(0), metavar="K", help="which draw, from 0")
    add(
        "--noise",
        nargs=4,
        type=_scale,
        metavar=("SX", "STHETA", "SV", "SOMEGA"),
        help="standard deviation of readings [m, rad, m/s, rad/s]",
    )
    add("--seed", type=_whole(0, 2**32 - 1), default=0)


def _add_run(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("task", choices=TASKS)
    add("--agent", choices=AGENTS, required=True)
    add("--world", choices=WORLDS, help="of the cart: what is not as agents are told")
    add("--seeds", type=_whole(1), default=20, metavar="N", help="episodes: 0 to N - 1")
    add("--steps", type=_whole(1), metavar="T", help="of each; default: the task's")
    add("--room", choices=("random", "story"), help="of namo; default: random")
    add(
        "--things",
        type=_whole(2),
        metavar="K",
        help="of namo: in a random room, 2 to 12; default: 4",
    )
    add("--difficulty", type=_scale, metavar="D", help="of namo: from 0 to 1; 0.5")
    add(
        "--delay",
        type=_whole(0),
        metavar="N",
        help="of namo: steps by which poses are read late; default: 0",
    )
    add(
        "--out",
        required=True,
        metavar="DIR",
        help="each episode is written there as it is done; the same command goes on"
        " where the folder stands",
    )
    add("--shard", type=_shard, metavar="I/N", help="do seeds I, I + N... only")
    add(
        "--noise",
        nargs=4,
        type=_scale,
        metavar=("SX", "STHETA", "SV", "SOMEGA"),
        help="standard deviation of the readings that are learnt from",
    )


def _add_plot(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("runs", nargs="+", metavar="DIR", help="what run --out wrote, of one task")
    add("--out", metavar="FIG.png", help="default: curves.png in the first folder")
    add("--json", action="store_true", help="one JSON object a run, a line each")


def _add_figure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("names", nargs="+", choices=FIGURES, metavar="NAME", help=", ".join(FIGURES))
    add(
        "--out",
        required=True,
        metavar="DIR",
        help="NAME.png, and runs; the same command goes on where the folder stands",
    )
    add("--seeds", type=_whole(1), default=20, metavar="N", help="of each agent")
    add("--steps", type=_whole(1), metavar="T", help="default: the figure's")
    add("--agents", nargs="+", metavar="NAME", help="others than the figure's own")
    add("--shard", type=_shard, metavar="I/N", help="do seeds I, I + N... only")
    add("--json", action="store_true", help="one JSON object an agent, a line each")


def _add_view(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "data",
        metavar="DATA.npz|DIR",
        help="planar-transitions-1, a folder with scene.json and such files, or what"
        " run wrote",
    )
    add("--scene", metavar="SCENE.json", help="outlines; required of a data file")
    add(
        "--out",
        required=True,
        metavar="FILE.gif|.html",
        help="of several data files, FILE-0.gif, FILE-1.gif... by name",
    )
    add("--episode", type=_whole(0), metavar="K", help="its number; default: the first")
    add("--fps", type=_whole(1, 1000), default=30, help="most frames a second")


def _whole(least: int, most: int | None = None) -> Callable[[str], int]:
    """A reader of whole numbers within bounds."""

    def read(text: str) -> int:
        bounds = f"at least {least}" if most is None else f"{least} to {most}"
        wrong = f"expected a whole number, {bounds}, got {text!r}"
        try:
            number = int(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(wrong) from error
        if number < least or (most is not None and number > most):
            raise argparse.ArgumentTypeError(wrong)
        return number

    return read


def _shard(text: str) -> tuple[int, int]:
    place, _, num = text.partition("/")
    if place.isdecimal() and num.isdecimal() and int(place) < int(num):
        return int(place), int(num)
    raise argparse.ArgumentTypeError(
        f"expected I/N, whole numbers with 0 <= I < N, got {text!r}"
    )


def _scale(text: str) -> float:
    wrong = f"expected a finite number of at least 0, got {text!r}"
    try:
        number = float(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(wrong) from error
    if not math.isfinite(number) or number < 0:
        raise argparse.ArgumentTypeError(wrong)
    return number


def _complain(message: str) -> None:
    print("boomdp_jax: error:", " ".join(message.split()), file=sys.stderr)


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    print("boomdp_jax: warning:", " ".join(str(message).split()), file=sys.stderr)
