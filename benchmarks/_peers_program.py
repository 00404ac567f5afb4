"""What every engine of the comparison offers: a scene ready to run and be timed."""

import dataclasses
import statistics
import time
from collections.abc import Callable

import numpy as np
from _timing import compiled

from boomdp_jax.physics.body_spec import BodySpec
from boomdp_jax.physics.scene_spec import SceneSpec


class NotExpressibleError(Exception):
    """An engine has no element for a part of a scene; the message says which."""


def mean_arm(body: BodySpec) -> float:
    """Torque of a body's ground friction against a pure spin, over its force [m]."""
    arms = np.hypot(np.hypot(*body.feet.T), body.foot_size)
    return float(body.foot_load @ arms)


@dataclasses.dataclass(frozen=True)
class Program:
    """A batch of worlds that can be run from their start as often as one likes."""

    run: Callable[[], object]
    """Advance all worlds to the end; this is what is timed."""
    states: Callable[[], np.ndarray]
    """The same motion, `[world, time, body, 6]`: poses and twists after each step."""
    reset: Callable[[], object] = lambda: None
    """Put the worlds back to their start; called before each run, and not timed."""
    compile_seconds: float | None = None


@dataclasses.dataclass(frozen=True)
class Peer:
    """An engine with its settings."""

    name: str
    prepare: Callable[[SceneSpec, np.ndarray, int], Program]
    """From a scene, starts `[world, body, 6]` and a number of steps of `spec.dt`."""
    quick_cases: tuple[str, ...] | None = None
    """Scenes for which a quick run has time, compilation included; None: for all."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """One number that says how right an engine is, and the most that it may be."""

    metric: str
    value: float
    unit: str
    bound: float | None = None
    """What lies above it, or is not finite, is no answer, and is not timed."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds for one run of a program: wall clock, and CPU time of all threads."""

    wall: list[float]
    cpu: list[float]

    @property
    def fastest(self) -> float:
        """Wall seconds of the fastest run."""
        return min(self.wall)

    @property
    def median(self) -> float:
        """Wall seconds of the median run."""
        return statistics.median(self.wall)

    @property
    def cpu_median(self) -> float:
        """CPU seconds of the median run."""
        return statistics.median(self.cpu)


def compiled_program(
    function: Callable[..., object],
    arguments: tuple,
    read: Callable[[object], np.ndarray],
) -> Program:
    """Compile a pure function of JAX arrays into a program.

    Args:
        function: what advances all worlds and returns every state.
        arguments: what it is called with.
        read: from what it returns to `[world, time, body, 6]`.

    Returns:
        The program; every result is computed in each run.
    """
    run, seconds = compiled(function, arguments)
    return Program(run=run, states=lambda: read(run()), compile_seconds=seconds)


def measure(program: Program, num_runs: int, limit: float) -> Timing:
    """Time a program, after one run that does not count.

    Args:
        program: what to run.
        num_runs: how often.
        limit: a first run that takes longer [s] is the only one, and counts.

    Returns:
        The seconds of each run.
    """
    wall, cpu = [], []
    for i in range(num_runs + 1):
        program.reset()
        wall_start, cpu_start = time.perf_counter(), time.process_time()
        program.run()
        cpu_seconds = time.process_time() - cpu_start
        wall_seconds = time.perf_counter() - wall_start
        is_long = not i and wall_seconds > limit
        if i or is_long:
            wall.append(wall_seconds)
            cpu.append(cpu_seconds)
        if is_long:
            break
    return Timing(wall, cpu)
