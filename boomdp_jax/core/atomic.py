"""Files that are either the old version or the whole new one, never half of it."""

import contextlib
import os
import secrets
from collections.abc import Generator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike) -> Generator[BinaryIO, None, None]:
    """Open a temporary file beside `path` that takes its place when all went well.

    The file replaces `path` once its bytes are on the disk. If the block raises, `path`
    is left as it was and the temporary file is removed.

    Args:
        path: the file to write; its folder must exist.

    Yields:
        The temporary file, open for writing bytes.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    try:
        with open(partial, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def atomic_write(path: str | os.PathLike, content: bytes) -> None:
    """Write a whole file at once.

    Args:
        path: the file to write; its folder must exist.
        content: its new bytes.
    """
    with atomic_file(path) as file:
        file.write(content)
