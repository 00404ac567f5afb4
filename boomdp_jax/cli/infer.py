"""`infer`: from recordings of a scene to what is true of it."""

import argparse
import contextlib
import sys
from typing import Any

from boomdp_jax.cli.output import (
    check_figure,
    check_writable,
    numbered,
    print_json,
    print_notes,
)


def run(arguments: argparse.Namespace) -> list[str]:
    """Infer from each data file and report: in one compiled call, or as a sweep.

    Args:
        arguments: what `cli.main` parsed.

    Returns:
        A line for each data file of a sweep that inference refused.

    Raises:
        ValueError: bad input; nothing has been written then.
    """
    from boomdp_jax.physics.scene_file import load_scene

    is_sweep = _is_sweep(arguments)
    if not is_sweep:
        check_writable(arguments.out)
    check_figure(arguments.plot)
    spec = load_scene(arguments.scene)
    print_notes(spec.notes)
    if is_sweep:
        return _sweep(arguments, spec)
    histories = _load_histories(arguments, spec)
    posteriors = _infer(arguments, spec, histories)
    for index, posterior in enumerate(posteriors):
        with contextlib.redirect_stdout(sys.stderr):
            if arguments.out:
                posterior.save(numbered(arguments.out, index, len(posteriors)))
            if arguments.plot:
                posterior.plot(numbered(arguments.plot, index, len(posteriors)))
    for path, posterior in zip(arguments.data, posteriors, strict=True):
        _print(arguments, path, posterior)
    return []


def _print(arguments: argparse.Namespace, path: str, posterior) -> None:
    """Report one posterior on standard output."""
    if arguments.json:
        print_json(posterior.to_json())
    else:
        print(f"{path}\n{posterior.summary()}", flush=True)


def _is_sweep(arguments: argparse.Namespace) -> bool:
    """Whether a sweep is asked for.

    Raises:
        ValueError: it is, and there is no folder to write to.
    """
    is_folder = arguments.out is not None and arguments.out.endswith("/")
    for name in ("batch", "shard", "resume"):
        if getattr(arguments, name) and not is_folder:
            raise ValueError(
                f"--{name}: expected --out with a folder that ends in /, got "
                f"{arguments.out}"
            )
    return is_folder


def _sweep(arguments: argparse.Namespace, spec) -> list[str]:
    """Infer unit after unit, each written and reported as it is done.

    Returns:
        A line for each data file that inference refused.
    """
    import jax

    from boomdp_jax.inference.posteriors.posterior import load_posterior
    from boomdp_jax.inference.sweeps.sweep import begin_sweep

    shard, batch = arguments.shard or (0, 1), arguments.batch or 16
    sweep = begin_sweep(
        jax.random.key(arguments.seed),
        spec,
        arguments.data,
        arguments.out,
        shard=shard,
        batch=batch,
        num_rows=arguments.rows,
        needs_rows=True,
        **_options(arguments),
    )
    units = sweep.units(shard)
    if not arguments.resume:
        sweep.check_untouched(units)
    # Other recordings than the folder's are refused before the work, too.
    waiting = {unit for unit in units if not sweep.is_done(unit)}
    failed: list[str] = []
    for place, unit in enumerate(units):
        print(f"unit {unit}, {place + 1} of {len(units)}", file=sys.stderr)
        if unit in waiting:
            with contextlib.redirect_stdout(sys.stderr):
                sweep.run(unit, progress=True)
        refused = sweep.failed(unit)
        failed += refused.values()
        inferred = [index for index in sweep.objects(unit) if index not in refused]
        for index, path in zip(inferred, sweep.paths(unit), strict=True):
            posterior = load_posterior(path)
            if arguments.plot:
                with contextlib.redirect_stdout(sys.stderr):
                    num_files = len(arguments.data)
                    posterior.plot(numbered(arguments.plot, index, num_files))
            _print(arguments, arguments.data[index], posterior)
    return failed


def _load_table(arguments: argparse.Namespace, spec, path: str):
    """A recording that is not empty."""
    from boomdp_jax.core.history_file import load_transitions

    table = load_transitions(path, spec=spec, num_rows=arguments.rows)
    if not table.num_rows:
        raise ValueError(f"{table.source}: expected at least one row, got none")
    return table


def _load_histories(arguments: argparse.Namespace, spec) -> list:
    """Histories of equal capacity, so that they share one compiled call."""
    tables = [_load_table(arguments, spec, path) for path in arguments.data]
    capacity = max(table.num_rows for table in tables)
    return [table.to_history(capacity=capacity) for table in tables]


def _infer(arguments: argparse.Namespace, spec, histories: list) -> list:
    """Posteriors, in order; whatever is printed on the way goes to standard error."""
    with contextlib.redirect_stdout(sys.stderr):
        import jax

        from boomdp_jax.inference.infer import infer, infer_batch
        from boomdp_jax.inference.members import MemberError

        key = jax.random.key(arguments.seed)
        options = _options(arguments)
        if len(histories) == 1:
            return [infer(key, spec, histories[0], progress=True, **options)]
        specs = [spec] * len(histories)
        try:
            return list(infer_batch(key, specs, histories, progress=True, **options))
        except MemberError as error:
            first, *others = error.messages
            text = f"{arguments.data[first]}: {error.messages[first]}"
            rest = [arguments.data[index] for index in others]
            if rest:
                text = f"{text}; refused as well: {', '.join(rest)}"
            raise ValueError(text) from error


def _options(arguments: argparse.Namespace) -> dict[str, Any]:
    """How to infer, as the library's functions take it."""
    return {
        "method": arguments.method,
        "likelihood": arguments.likelihood,
        "horizon": arguments.horizon,
        "outliers": arguments.outliers,
    }
