"""The JSON header of a result file: decoded and checked, one line on what is wrong."""

import json
import os
from collections.abc import Mapping

import numpy as np


def read_json_header(
    path: str | os.PathLike,
    encoded: np.ndarray | None,
    *,
    what: str,
    schema: str,
    fields: Mapping[str, type | tuple[type, ...]],
    max_bytes: int,
) -> dict:
    """Decode a header that a file holds as bytes.

    Args:
        path: the file, for messages.
        encoded: the array that holds the header; None where there is none.
        what: what the file should be of, for messages.
        schema: value that the field of this name must have.
        fields: types of further fields that must be there.
        max_bytes: largest size.

    Returns:
        The header.

    Raises:
        ValueError: no header, too large a one, not JSON, another schema, or a field
            that is missing or of another type; one line.
    """
    if encoded is None or encoded.dtype != np.uint8 or encoded.ndim != 1:
        raise ValueError(f"{path}: expected {what} with a header, got none")
    if encoded.size > max_bytes:
        raise ValueError(
            f"{path}: header: expected at most {max_bytes} bytes, got {encoded.size}"
        )
    try:
        header = json.loads(encoded.tobytes().decode())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: header: expected JSON, got {error}") from error
    found = header.get("schema") if isinstance(header, dict) else None
    if found != schema:
        raise ValueError(f"{path}: schema: expected {schema!r}, got {found!r}")
    for name, kind in fields.items():
        if name not in header or not isinstance(header[name], kind):
            raise ValueError(
                f"{path}: header: expected a field {name!r} of the right kind, got "
                f"{str(header.get(name))[:80]!r}"
            )
    return header
