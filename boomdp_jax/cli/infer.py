"""`infer`: from recordings of a scene to what is true of it."""

import argparse
import contextlib
import sys

from boomdp_jax.cli.output import (
    check_figure,
    check_writable,
    numbered,
    print_json,
    print_notes,
)


def run(arguments: argparse.Namespace) -> None:
    """Infer from each data file, all in one compiled call, and report.

    Args:
        arguments: what `cli.main` parsed.

    Raises:
        ValueError: bad input; nothing has been written then.
    """
    from boomdp_jax.physics.scene_file import load_scene

    check_writable(arguments.out)
    check_figure(arguments.plot)
    spec = load_scene(arguments.scene)
    print_notes(spec.notes)
    histories = _load_histories(arguments, spec)
    posteriors = _infer(arguments, spec, histories)
    for index, posterior in enumerate(posteriors):
        with contextlib.redirect_stdout(sys.stderr):
            if arguments.out:
                posterior.save(numbered(arguments.out, index, len(posteriors)))
            if arguments.plot:
                posterior.plot(numbered(arguments.plot, index, len(posteriors)))
    for path, posterior in zip(arguments.data, posteriors, strict=True):
        if arguments.json:
            print_json(posterior.to_json())
        else:
            print(f"{path}\n{posterior.summary()}", flush=True)


def _load_histories(arguments: argparse.Namespace, spec) -> list:
    """Histories of equal capacity, so that they share one compiled call."""
    from boomdp_jax.core.history_file import load_transitions

    tables = [
        load_transitions(path, spec=spec, num_rows=arguments.rows)
        for path in arguments.data
    ]
    for table in tables:
        if not table.num_rows:
            raise ValueError(f"{table.source}: expected at least one row, got none")
    capacity = max(table.num_rows for table in tables)
    return [table.to_history(capacity=capacity) for table in tables]


def _infer(arguments: argparse.Namespace, spec, histories: list) -> list:
    """Posteriors, in order; whatever is printed on the way goes to standard error."""
    with contextlib.redirect_stdout(sys.stderr):
        import jax

        from boomdp_jax.inference.infer import infer, infer_batch

        key = jax.random.key(arguments.seed)
        method = arguments.method
        if len(histories) == 1:
            return [infer(key, spec, histories[0], method=method, progress=True)]
        specs = [spec] * len(histories)
        return list(infer_batch(key, specs, histories, method=method, progress=True))
