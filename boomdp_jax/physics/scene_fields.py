"""Fields of a scene file, read one by one with messages that say what is wrong."""

import difflib
import math
import reprlib
from collections.abc import Collection
from typing import NoReturn

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

MAX_NUMBER = 1e15
"""Largest size of any number in a scene file; squares of it still fit 32 bit floats."""

_MAX_NAME_LENGTH = 100


def refuse(where: str, expected: str, got: object) -> NoReturn:
    """Say in one line which field is wrong, what was expected and what was got.

    Args:
        where: file, body and field.
        expected: what should stand there, without the word "expected".
        got: what stands there.

    Raises:
        ValueError: always.
    """
    raise ValueError(f"{where}: expected {expected}, got {reprlib.repr(got)}")


def in_terms_of_json(value: object) -> object:
    """Replace arrays and NumPy's numbers by what a JSON file would hold.

    Args:
        value: anything; objects and lists are looked into.

    Returns:
        The same with lists for arrays and tuples, and Python's numbers and flags for
        those of NumPy; what is neither stays.
    """
    if isinstance(value, jax.Array) and not isinstance(value, Tracer):
        value = np.asarray(value)
    if isinstance(value, dict):
        return {key: in_terms_of_json(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray) and value.ndim == 0:
        return in_terms_of_json(value[()])
    if isinstance(value, list | tuple | np.ndarray):
        return [in_terms_of_json(inner) for inner in value]
    for kind, plain in ((np.bool_, bool), (np.integer, int), (np.floating, float)):
        if isinstance(value, kind):
            return plain(value)
    return value


def read_object(
    value: object,
    where: str,
    *,
    required: Collection[str] = (),
    optional: Collection[str] = (),
) -> dict:
    """Check that a value is an object with these fields and no others.

    Args:
        value: what stands in the file.
        where: file, body and field.
        required: fields that must be there.
        optional: fields that may be there.

    Returns:
        The object.

    Raises:
        ValueError: it is none, a field is missing, or one is not known.
    """
    if not isinstance(value, dict):
        refuse(where, "an object", value)
    known = [*required, *optional]
    for field in value:
        if field not in known:
            close = difflib.get_close_matches(str(field), known, n=1)
            hint = f" (did you mean {close[0]!r}?)" if close else ""
            refuse(where, f"fields out of {', '.join(known)}{hint}", field)
    for field in required:
        if field not in value:
            refuse(where, f"a field {field!r}", list(value))
    return value


def read_list(value: object, where: str) -> list:
    """Check that a value is a list.

    Args:
        value: what stands in the file.
        where: file, body and field.

    Returns:
        The list.
    """
    if not isinstance(value, list | tuple):
        refuse(where, "a list", value)
    return list(value)


def read_name(value: object, where: str) -> str:
    """Check that a value is a name: printable text, not empty, not too long.

    Args:
        value: what stands in the file.
        where: file, body and field.

    Returns:
        The name.
    """
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        refuse(where, "a printable name", value)
    if len(value) > _MAX_NAME_LENGTH:
        refuse(where, f"a name of at most {_MAX_NAME_LENGTH} characters", value)
    return value


def read_flag(value: object, where: str) -> bool:
    """Check that a value is true or false.

    Args:
        value: what stands in the file.
        where: file, body and field.

    Returns:
        The value.
    """
    if not isinstance(value, bool):
        refuse(where, "true or false", value)
    return value


def read_count(value: object, where: str, *, least: int = 0, most: int) -> int:
    """Check that a value is a whole number from `least` to `most`.

    Args:
        value: what stands in the file.
        where: file, body and field.
        least: smallest count allowed.
        most: largest count allowed.

    Returns:
        The count.
    """
    is_whole = isinstance(value, int) and not isinstance(value, bool)
    if not is_whole or not least <= value <= most:
        refuse(where, f"a whole number from {least} to {most}", value)
    return value


def read_number(
    value: object,
    where: str,
    *,
    least: float = -math.inf,
    most: float = math.inf,
    is_positive: bool = False,
    is_nullable: bool = False,
) -> float:
    """Check that a value is a finite number within bounds and `MAX_NUMBER`.

    Args:
        value: what stands in the file.
        where: file, body and field.
        least: smallest number allowed.
        most: largest number allowed.
        is_positive: whether zero and less are refused.
        is_nullable: whether null (to be inferred) is allowed.

    Returns:
        The number; NaN for null.

    Raises:
        ValueError: it is none, is not finite or is out of bounds.
    """
    if value is None and is_nullable:
        return math.nan
    expected = "a finite number"
    if is_positive:
        expected = "a finite number above 0"
    elif math.isfinite(least):
        expected = f"a finite number of at least {least:g}"
        if math.isfinite(most):
            expected = f"a number from {least:g} to {most:g}"
    if is_nullable:
        expected += " or null"
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    try:
        number = float(value) if is_number else math.nan
    except OverflowError:
        number = math.inf
    if MAX_NUMBER < abs(number) < math.inf:
        refuse(where, f"a number of at most {MAX_NUMBER:g} in size", value)
    if not math.isfinite(number) or not least <= number <= most:
        refuse(where, expected, value)
    if is_positive and number <= 0:
        refuse(where, expected, value)
    return number


def read_vector(
    value: object,
    where: str,
    size: int,
    *,
    least: float = -math.inf,
    is_positive: bool = False,
    is_nullable: bool = False,
) -> Float[np.ndarray, " size"]:
    """Check that a value is a list of numbers.

    Args:
        value: what stands in the file.
        where: file, body and field.
        size: how many numbers.
        least: smallest number allowed.
        is_positive: whether zero and less are refused.
        is_nullable: whether null (to be inferred) is allowed, for one or for all.

    Returns:
        The numbers; NaN for null.

    Raises:
        ValueError: it is none, has another size, or one of its numbers is refused.
    """
    if value is None and is_nullable:
        return np.full(size, np.nan)
    if not isinstance(value, list | tuple) or len(value) != size:
        or_null = " or null" if is_nullable else ""
        refuse(where, f"a list of {size} numbers{or_null}", value)
    numbers = [
        read_number(
            number,
            f"{where}[{index}]",
            least=least,
            is_positive=is_positive,
            is_nullable=is_nullable,
        )
        for index, number in enumerate(value)
    ]
    return np.array(numbers, float)


def read_points(value: object, where: str) -> Float[np.ndarray, "point 2"]:
    """Check that a value is a list of one or more points.

    Args:
        value: what stands in the file.
        where: file, body and field.

    Returns:
        The points [m].

    Raises:
        ValueError: it is none, or one of its points is not two finite numbers.
    """
    points = read_list(value, where)
    if not points:
        refuse(where, "at least one point", value)
    return np.stack([read_vector(p, f"{where}[{i}]", 2) for i, p in enumerate(points)])


def check_finite(value: object, where: str) -> None:
    """Make sure that no number inside a free-form value is infinite or NaN.

    Args:
        value: anything that JSON can hold.
        where: file and field.

    Raises:
        ValueError: one of its numbers is not finite, or it is nothing JSON can hold.
    """
    if isinstance(value, dict):
        for key, inner in value.items():
            check_finite(inner, f"{where}.{key}")
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            check_finite(inner, f"{where}[{index}]")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        read_number(value, where)
    elif not isinstance(value, str | bool | None):
        refuse(where, "what JSON can hold", value)
