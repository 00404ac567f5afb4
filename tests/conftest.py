"""Set-up of every test: 64 bit, ranks that never broadcast silently, checked shapes."""

import contextlib
import gc
import importlib.metadata
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

# Most of the time of a test is that of the compiler. What one file compiled is there
# for others, for programs that tests start, and for the next run; set in the
# environment, before JAX reads it.
_PROGRAMS = Path(__file__).parents[1] / ".pytest_cache" / "xla"
_MOST_DAYS = 14
# Memory mappings, and memory [bytes], from which on a process lets go of what it
# compiled.
_MOST_MAPPINGS, _MOST_MEMORY = 15_000, 2.5e9
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(_PROGRAMS))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
# XLA's older emitters, which jaxlib 0.10 still has, compile in two thirds of the time
# what then runs a tenth slower. Examples are run as users' programs are compiled, and
# `tests/test_compilers.py` compares the two. Kept in the environment for workers, which
# find the flags of the process that starts them.
_users = os.environ.setdefault("USERS_XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
_QUICK_COMPILER = (
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=1"
)
if importlib.metadata.version("jaxlib").startswith(("0.9.", "0.10.")):
    # What is given by hand comes last, and wins.
    os.environ["XLA_FLAGS"] = f"{_QUICK_COMPILER} {_users}".strip()
# XLA takes its own tuning flags for features that the machine lacks, and says so at
# length of each program that it loads.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import jax  # noqa: E402
import jaxtyping  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("boomdp_jax", "beartype.beartype")

from boomdp_jax.core import kept_traces, side_by_side  # noqa: E402  After the hook.


def pytest_sessionstart() -> None:
    """Forget programs of weeks ago; JAX would keep them for ever."""
    oldest = time.time() - _MOST_DAYS * 86400
    for path in _PROGRAMS.glob("*"):
        # Another worker may be at it too.
        with contextlib.suppress(FileNotFoundError):
            if path.stat().st_mtime < oldest:
                path.unlink()


def _has_room() -> bool:
    """Whether more compiled programs may be kept; nobody knows but on Linux."""
    try:
        num_pages = int(Path("/proc/self/statm").read_text().split()[1])
        num_mappings = Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return False
    memory = num_pages * os.sysconf("SC_PAGE_SIZE")
    return num_mappings < _MOST_MAPPINGS and memory < _MOST_MEMORY


@pytest.fixture(autouse=True, scope="module")
def _drop_programs() -> Iterator[None]:
    """Let go of a module's compiled programs when it is done, if there are many.

    Each holds several memory mappings, of which a process may have 65,530 on Linux;
    all tests together need more, and the compiler then crashes. But to let go takes a
    second or two, and what is kept the next module need not compile again.
    """
    yield
    # What a command line in a test turned on.
    kept_traces.keep_traces(None)
    if _has_room():
        return
    jax.clear_caches()
    side_by_side.forget_compiled()
    gc.collect()


class Precision(NamedTuple):
    """The float type that a test runs in."""

    bits: int

    def choose(self, *, single: float, double: float) -> float:
        """Pick the tolerance that belongs to this float type."""
        return single if self.bits == 32 else double


@pytest.fixture(
    params=[32, pytest.param(64, marks=pytest.mark.slow)], ids=["float32", "float64"]
)
def precision(request: pytest.FixtureRequest) -> Iterator[Precision]:
    """Run the test once on 32 bit floats and, among slow ones, once on 64 bit ones."""
    with jax.enable_x64(request.param == 64):
        yield Precision(request.param)


@pytest.fixture
def no_type_checks() -> Iterator[None]:
    """Run the test as users run the package: nothing is checked but by itself."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
