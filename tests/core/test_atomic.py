"""Atomic files: the old version or the whole new one, and nothing left behind."""

from pathlib import Path

import pytest

from boomdp_jax.core.atomic import atomic_file, atomic_write


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


def test_a_missing_folder_is_an_os_error(tmp_path: Path):
    with pytest.raises(FileNotFoundError):
        atomic_write(tmp_path / "missing" / "result", b"new")
