"""NPZ archives read without trust: no pickle, no surprise in kind or in size."""

import io
import math
import os
import zipfile
import zlib
from collections.abc import Mapping

import numpy as np

from boomdp_jax.core.atomic import atomic_file

MAX_NPZ_BYTES = 2**31
"""Most bytes that all arrays of one file may unpack to (2 GiB)."""

_MAX_NPZ_ARRAYS = 1000
_MAX_HEADER_BYTES = 10_000
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
    ValueError,
)


def read_npz(
    path: str | os.PathLike, *, max_bytes: int = MAX_NPZ_BYTES
) -> dict[str, np.ndarray]:
    """Read every array of an NPZ file.

    What an array unpacks to is checked before it is unpacked, so that a small file
    cannot fill the memory.

    Args:
        path: the file.
        max_bytes: most bytes that all arrays together may unpack to.

    Returns:
        Arrays by name.

    Raises:
        ValueError: not an NPZ file, a damaged or truncated one, one that holds Python
            objects, or one that unpacks to too much.
        OSError: the file cannot be opened.
    """
    with open(path, "rb") as file:
        try:
            archive = zipfile.ZipFile(file)
        except _DAMAGE as error:
            raise ValueError(
                f"{path}: expected an NPZ file, got one that is not or is cut short "
                f"({error})"
            ) from error
        with archive:
            members = archive.infolist()
            _check_members(path, members, max_bytes)
            return {
                member.filename.removesuffix(".npy"): _read_array(path, archive, member)
                for member in members
            }


def write_npz(path: str | os.PathLike, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to an NPZ file, all of them or none.

    Args:
        path: the file; its name is taken as it is.
        arrays: arrays by name; none may hold Python objects.

    Raises:
        ValueError: an array of Python objects.
    """
    for name, array in arrays.items():
        if np.asarray(array).dtype.hasobject:
            raise ValueError(f"{path}: {name}: expected numbers or text, got objects")
    with (
        atomic_file(path) as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asarray(array), allow_pickle=False)


def _check_members(
    path: str | os.PathLike, members: list[zipfile.ZipInfo], max_bytes: int
) -> None:
    if len(members) > _MAX_NPZ_ARRAYS:
        raise ValueError(
            f"{path}: expected at most {_MAX_NPZ_ARRAYS} arrays, got {len(members)}"
        )
    names = [member.filename for member in members]
    for name in names:
        if not name.endswith(".npy"):
            raise ValueError(f"{path}: expected arrays only, got an entry {name!r}")
        if names.count(name) > 1:
            raise ValueError(f"{path}: expected one array {name[:-4]!r}, got several")
    num_bytes = sum(member.file_size for member in members)
    if num_bytes > max_bytes:
        raise ValueError(
            f"{path}: expected at most {max_bytes} bytes of arrays, got {num_bytes}"
        )


def _read_array(
    path: str | os.PathLike, archive: zipfile.ZipFile, member: zipfile.ZipInfo
) -> np.ndarray:
    """Read one array after comparing its header with the bytes that follow it."""
    name = member.filename.removesuffix(".npy")
    try:
        stream = io.BytesIO(archive.read(member))
        shape, is_fortran, dtype = _read_header(stream)
        num_bytes = math.prod(shape) * dtype.itemsize
        left = member.file_size - stream.tell()
        if not dtype.hasobject and num_bytes == left:
            flat = np.frombuffer(stream.read(), dtype).copy()
            return flat.reshape(shape, order="F" if is_fortran else "C")
    except _DAMAGE as error:
        message = " ".join(str(error).split())
        raise ValueError(f"{path}: {name}: not a readable array ({message})") from error
    if dtype.hasobject:
        raise ValueError(f"{path}: {name}: expected numbers or text, got objects")
    raise ValueError(
        f"{path}: {name}: expected {num_bytes} bytes for shape {shape}, got {left}"
    )


def _read_header(stream: io.BytesIO) -> tuple[tuple, bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        read = np.lib.format.read_array_header_1_0
    elif version == (2, 0):
        read = np.lib.format.read_array_header_2_0
    else:
        raise ValueError(f"array format {version} is not known")
    return read(stream, max_header_size=_MAX_HEADER_BYTES)
