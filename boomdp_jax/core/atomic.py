"""Files that are either the old version or the whole new one, never half of it."""

import contextlib
import os
import secrets
import stat
from collections.abc import Generator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike) -> Generator[BinaryIO, None, None]:
    """Open a temporary file beside `path` that takes its place when all went well.

    The file replaces `path` once its bytes are on the disk. If the block raises, `path`
    is left as it was and the temporary file is removed. A device or a pipe is no file
    to replace: it is written to.

    Args:
        path: the file to write; its folder must exist.

    Yields:
        The temporary file, open for writing bytes.

    Raises:
        OSError: it cannot be written; names `path`.
    """
    if _takes_what_comes(path):
        with open(path, "wb") as file:
            yield file
        return
    partial = _partial(path)
    try:
        with open(partial, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        _remove(partial)
        if isinstance(error, OSError) and error.filename == os.fspath(partial):
            # Nobody knows the temporary file.
            raise OSError(error.errno, error.strerror, os.fspath(path)) from None
        raise


def check_folder_takes_files(path: str | os.PathLike) -> None:
    """Try whether `atomic_file` could begin a file, and leave nothing behind.

    Args:
        path: the file that is to be written; it is not touched.

    Raises:
        OSError: it could not; names `path`.
    """
    if _takes_what_comes(path):
        return
    partial = _partial(path)
    try:
        with open(partial, "xb"):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, os.fspath(path)) from None
    finally:
        _remove(partial)


def atomic_write(path: str | os.PathLike, content: bytes) -> None:
    """Write a whole file at once.

    Args:
        path: the file to write; its folder must exist.
        content: its new bytes.

    Raises:
        OSError: it cannot be written; names `path`.
    """
    with atomic_file(path) as file:
        file.write(content)


def _partial(path: str | os.PathLike) -> Path:
    """A name beside `path` that no other writer has."""
    path = Path(path)
    return path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")


def _takes_what_comes(path: str | os.PathLike) -> bool:
    """Whether there is a device or a pipe."""
    try:
        mode = os.stat(path).st_mode
    except OSError:
        return False
    return stat.S_ISCHR(mode) or stat.S_ISBLK(mode) or stat.S_ISFIFO(mode)


def _remove(partial: Path) -> None:
    # Where there is no such folder, another error is on its way.
    with contextlib.suppress(OSError):
        partial.unlink()
