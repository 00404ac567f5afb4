"""`predict`: how well a posterior foretells a recording it has not seen."""

import argparse
import contextlib
import sys

from boomdp_jax.cli.output import print_json

_NUMBERS = ("rmse", "baseline_rmse", "coverage90", "log_score")


def run(arguments: argparse.Namespace) -> None:
    """Report held-out error and coverage at several horizons.

    Args:
        arguments: what `cli.main` parsed.

    Raises:
        ValueError: bad input.
    """
    with contextlib.redirect_stdout(sys.stderr):
        from boomdp_jax.core.history_file import load_transitions
        from boomdp_jax.inference.posteriors.posterior import load_posterior
        from boomdp_jax.inference.posteriors.predict import predict

        posterior = load_posterior(arguments.posterior)
        table = load_transitions(arguments.data, spec=posterior.spec)
        if not table.num_rows:
            raise ValueError(f"{table.source}: expected at least one row, got none")
        report = predict(posterior, table.to_history(), tuple(arguments.horizon))
    if arguments.json:
        print_json(report)
    else:
        print(_table(report), flush=True)


def _table(report: dict) -> str:
    """One line for each horizon and quantity."""
    lines = [
        f"{'steps':>6} {'quantity':<9}" + "".join(f"{name:>15}" for name in _NUMBERS)
    ]
    for horizon, quantities in report["horizons"].items():
        for quantity, numbers in quantities.items():
            cells = "".join(_cell(numbers.get(name)) for name in _NUMBERS)
            lines.append(f"{horizon:>6} {quantity:<9}{cells}")
        if not report["num_starts"][horizon]:
            lines.append(
                f"{horizon:>6} steps: nothing to predict from; expected rows whose "
                "state was read in all channels of all bodies, or whose poses were "
                "read twice until then, followed by as many rows of their run, got "
                "none"
            )
        elif all(each["rmse"] is None for each in quantities.values()):
            lines.append(f"{horizon:>6} steps: nothing was read so many steps later")
    if report.get("starts") == "filtered":
        lines.append("no reading was whole: predicted from all readings until then")
    return "\n".join(lines)


def _cell(number: float | None) -> str:
    return f"{'-':>15}" if number is None else f"{number:>15.4g}"
