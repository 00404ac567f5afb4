"""Compiled programs that outlive the process: kept in the user's cache folder.

Compilation takes most of the first minute of an inference or a plan, and its outcome
depends on shapes and versions alone, so that the next run can have it from disk. JAX
keeps programs where it is told of a folder; what it makes them from is kept beside them
(`kept_traces`). The command line and the examples tell it of one; a library does not,
for that is its user's to say.
"""

import contextlib
import os
import pathlib
import sys
import time

from jax import config as settings_of_jax
from jax.experimental.compilation_cache import compilation_cache

from boomdp_jax.core.kept_traces import TRACE_FILES, keep_traces

_MOST_DAYS = 30
_IS_WANTED = "jax_enable_compilation_cache"
_TOLD = "JAX_COMPILATION_CACHE_DIR"
# JAX keeps what took a second to compile unless it is told otherwise. An inference has
# twenty programs that take less, and eight seconds between them.
_LEAST = "jax_persistent_cache_min_compile_time_secs"
_LEAST_BY_DEFAULT, _LEAST_SECONDS = 1.0, 0.1


def keep_programs(folder: str | os.PathLike | None = None) -> pathlib.Path | None:
    """Let JAX find what it compiled in earlier runs, and keep what it compiles in this.

    Also what this library's programs were traced from, and what took a tenth of a
    second to compile, where JAX has its own limit of a whole one.

    Where `JAX_COMPILATION_CACHE_DIR` is set, it stays; with
    `JAX_ENABLE_COMPILATION_CACHE=false` nothing is kept. Programs of a month ago are
    deleted from a folder that is made here, to which nobody else should be able to
    write: JAX runs what it finds there.

    Args:
        folder: where to; default: `boomdp_jax/programs` in the user's cache folder
            (`XDG_CACHE_HOME`, `~/.cache`, `~/Library/Caches`, `LOCALAPPDATA`).

    Returns:
        The folder that JAX uses; None if there is none that can be written to.
    """
    if told := os.environ.get(_TOLD):
        _keep_traces_in(pathlib.Path(told))
        return pathlib.Path(told)
    try:
        path = _default_folder() if folder is None else pathlib.Path(folder)
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # The latter: nobody's home.
        return None
    if not os.access(path, os.W_OK):
        return None
    _forget_old(path, f"*-{'[0-9a-f]' * 64}-cache")
    compilation_cache.set_cache_dir(str(path))
    is_told = _LEAST.upper() in os.environ
    if settings_of_jax.values[_LEAST] == _LEAST_BY_DEFAULT and not is_told:
        settings_of_jax.update(_LEAST, _LEAST_SECONDS)
    # Whether there is a cache is looked up once, at the first compilation, which may
    # lie behind us.
    compilation_cache.reset_cache()
    _keep_traces_in(path)
    return path


def _keep_traces_in(programs: pathlib.Path) -> None:
    """Keep what programs were traced from beside them, where JAX keeps anything."""
    is_elsewhere = "://" in os.environ.get(_TOLD, "")
    if is_elsewhere or not settings_of_jax.values[_IS_WANTED]:
        return
    folder = programs / "traces"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return
    _forget_old(folder, TRACE_FILES)
    keep_traces(folder)


def _default_folder() -> pathlib.Path:
    """Where programs of this user keep what they can make again."""
    home = pathlib.Path.home()
    folder = home / ".cache"
    if sys.platform == "darwin":
        folder = home / "Library" / "Caches"
    elif sys.platform == "win32":
        folder = pathlib.Path(
            os.environ.get("LOCALAPPDATA", home / "AppData" / "Local")
        )
    # By the standard, a relative path there counts as none.
    told = pathlib.Path(os.environ.get("XDG_CACHE_HOME", ""))
    if told.is_absolute():
        folder = told
    return folder / "boomdp_jax" / "programs"


def _forget_old(folder: pathlib.Path, names: str) -> None:
    """Delete what JAX would keep for ever, and traces that nobody used."""
    oldest = time.time() - _MOST_DAYS * 86400
    for path in folder.glob(names):
        # Another process may be at it too.
        with contextlib.suppress(OSError):
            if path.stat().st_mtime < oldest:
                path.unlink()
