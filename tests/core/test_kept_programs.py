"""Programs that one process compiled are there for the next."""

import json
import os
import pathlib
import subprocess
import sys
import time

import jax
import pytest

from boomdp_jax import keep_programs

_COMPILES = """
import json, sys, jax, jax.numpy as jnp
found = []
jax.monitoring.register_event_listener(lambda name, **_: found.append(name))
if "first" in sys.argv:
    jax.jit(lambda x: x * 2)(1.0)
from boomdp_jax import keep_programs
folder = keep_programs()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((7, 7)))
hits = [name for name in found if name.endswith("/cache_hits")]
print(json.dumps([str(folder), len(hits)]))
"""


def environment(cache: pathlib.Path, **more: str) -> dict[str, str]:
    """Of a process whom nobody told where to keep programs."""
    mine = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("JAX_COMPILATION_CACHE", "JAX_PERSISTENT_CACHE"))
    }
    return mine | {"XDG_CACHE_HOME": str(cache)} | more


def compile_something(cache: pathlib.Path, *arguments: str, **more: str):
    """Folder and programs that were read from it, by a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", _COMPILES, *arguments],
        env=environment(cache, **more),
        check=True,
        capture_output=True,
        text=True,
    )
    folder, hits = json.loads(done.stdout)
    return folder, hits, done.stderr


@pytest.mark.parametrize("before", [(), ("first",)], ids=["at first", "later"])
def test_the_next_process_reads_what_this_one_compiled(tmp_path, before):
    folder, hits, _ = compile_something(tmp_path, *before)
    assert (pathlib.Path(folder), hits) == (tmp_path / "boomdp_jax" / "programs", 0)
    assert list(pathlib.Path(folder).glob("jit*-cache"))
    _, hits, errors = compile_something(tmp_path, *before)
    assert hits >= 1
    assert errors == ""


def test_who_wants_nothing_kept_is_heeded(tmp_path):
    folder, _, _ = compile_something(tmp_path, JAX_ENABLE_COMPILATION_CACHE="false")
    assert not list(pathlib.Path(folder).iterdir())


def test_a_folder_that_cannot_be_made_is_done_without(tmp_path):
    (tmp_path / "boomdp_jax").write_text("not a folder")
    assert compile_something(tmp_path)[:2] == ("None", 0)


def test_a_folder_that_jax_was_told_of_stays():
    # Tests are given one in the environment.
    told = jax.config.jax_compilation_cache_dir
    assert told
    assert keep_programs("another") == pathlib.Path(told)
    assert jax.config.jax_compilation_cache_dir == told


@pytest.mark.parametrize(
    ("place", "old", "new", "other"),
    [
        (
            ".",
            f"jit_old-{'0a' * 32}-cache",
            f"jit_new-{'0b' * 32}-cache",
            "notes-cache",
        ),
        ("traces", f"a-{'0a' * 32}.trace", f"b-{'0b' * 32}.trace", "profile.trace"),
    ],
)
def test_what_is_of_long_ago_is_deleted_and_nothing_else(
    tmp_path, place, old, new, other
):
    folder = tmp_path / "boomdp_jax" / "programs" / place
    folder.mkdir(parents=True)
    for name in (old, new, other):
        (folder / name).write_bytes(b"")
    for name in (old, other):
        os.utime(folder / name, times=(time.time() - 40 * 86400,) * 2)
    compile_something(tmp_path)
    assert not (folder / old).exists()
    assert (folder / new).exists()
    assert (folder / other).exists()


def test_the_command_line_keeps_what_it_compiles(tmp_path):
    scene = tmp_path / "scene.json"
    scene.write_text(
        '{"schema": "planar-scene-1", "dt": 0.02, "bodies": [{"name": "box", '
        '"shape": {"type": "box", "half_extents": [0.2, 0.1]}, "density": 10}]}'
    )
    command = [sys.executable, "-m", "boomdp_jax", "simulate", str(scene)]
    command += ["--actions", "missing.npz", "--out", str(tmp_path / "out.npz")]
    subprocess.run(command, env=environment(tmp_path), capture_output=True, check=False)
    assert (tmp_path / "boomdp_jax" / "programs").is_dir()
