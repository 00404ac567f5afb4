"""Compile a function and run it, the seconds of each apart."""

import time
from collections.abc import Callable

import jax


def compiled(
    function: Callable[..., object], arguments: tuple
) -> tuple[Callable[[], object], float]:
    """Compile a pure function of JAX arrays for its arguments.

    Args:
        function: what to compile.
        arguments: what it is called with.

    Returns:
        What runs it on them and waits for its results, and the seconds to compile it.
    """
    start = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    return lambda: jax.block_until_ready(program(*arguments)), seconds


def measure(
    function: Callable[..., object], arguments: tuple, num_runs: int
) -> tuple[float, list[float]]:
    """Time a function, after one run that does not count.

    Args:
        function: of JAX arrays.
        arguments: what it is called with.
        num_runs: how often.

    Returns:
        Seconds to compile, and of each run.
    """
    run, seconds = compiled(function, arguments)
    run()
    runs = []
    for _ in range(num_runs):
        start = time.perf_counter()
        run()
        runs.append(time.perf_counter() - start)
    return seconds, runs
