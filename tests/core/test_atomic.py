"""Atomic files: the old version or the whole new one, and nothing left behind."""

import os
import threading
from pathlib import Path

import pytest

from boomdp_jax.core.atomic import (
    atomic_file,
    atomic_write,
    check_folder_takes_files,
)


def test_a_write_replaces_the_whole_file(tmp_path: Path):
    path = tmp_path / "result"
    path.write_bytes(b"a longer old version")
    atomic_write(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path: Path):
    path = tmp_path / "result"
    path.write_bytes(b"old")

    def fail_half_way() -> None:
        with atomic_file(path) as file:
            file.write(b"half of the n")
            raise RuntimeError("interrupted")

    with pytest.raises(RuntimeError, match="interrupted"):
        fail_half_way()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("folder", ["missing", "file"])
@pytest.mark.parametrize(
    "write", [lambda path: atomic_write(path, b"new"), check_folder_takes_files]
)
def test_an_error_names_the_file_that_was_given(tmp_path: Path, folder: str, write):
    (tmp_path / "file").touch()
    path = tmp_path / folder / "result"
    with pytest.raises(OSError, match=r"result'$") as caught:
        write(path)
    assert caught.value.filename == str(path)
    assert caught.value.filename2 is None
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def test_a_folder_in_the_way_is_an_error_that_names_it(tmp_path: Path):
    path = tmp_path / "result"
    path.mkdir()
    with pytest.raises(OSError, match=r"result'$"):
        atomic_write(path, b"new")
    assert list(tmp_path.iterdir()) == [path]


def test_trying_leaves_nothing_behind(tmp_path: Path):
    path = tmp_path / "result"
    path.write_bytes(b"old")
    check_folder_takes_files(path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes by name")
def test_a_pipe_is_written_to_and_stays_one(tmp_path: Path):
    """So is a device: who writes to /dev/null must not put a file in its place."""
    path, taken = tmp_path / "pipe", []
    os.mkfifo(path)
    reader = threading.Thread(target=lambda: taken.append(path.read_bytes()))
    reader.start()
    check_folder_takes_files(path)
    atomic_write(path, b"all of it")
    reader.join(timeout=10.0)
    assert taken == [b"all of it"]
    assert path.is_fifo()
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_folder_is_an_os_error(tmp_path: Path):
    with pytest.raises(FileNotFoundError):
        atomic_write(tmp_path / "missing" / "result", b"new")
