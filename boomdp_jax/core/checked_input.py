"""Numbers that a caller gives, checked before a cast could change their meaning."""

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int


def whole_number(name: str, value: Any, least: int) -> int:
    """Read a count.

    Args:
        name: of the argument, for the message.
        value: what was given.
        least: the smallest that there may be.

    Returns:
        The count.

    Raises:
        ValueError: not a whole number (a truth value is none), or a smaller one.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = None
    if number is None or isinstance(value, bool):
        raise ValueError(
            f"{name}: expected a whole number, at least {least}, got {value!r}"
        )
    if number < least:
        raise ValueError(f"{name}: expected at least {least}, got {number}")
    return number


def is_real(dtype: Any) -> bool:
    """Whether an array of a type holds real numbers; truth values are none."""
    return jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)


def check_real(name: str, dtype: Any) -> None:
    """Raise a ValueError unless an array of a type holds real numbers."""
    if not is_real(dtype):
        raise ValueError(f"{name}: expected real numbers, got an array of {dtype}")


def has_shape(shape: tuple[int, ...], wanted: tuple[int | str, ...]) -> bool:
    """Whether a shape is the wanted one, in which a word is an axis of any length."""
    return len(shape) == len(wanted) and all(
        isinstance(want, str) or want == size
        for want, size in zip(wanted, shape, strict=True)
    )


def real_array(name: str, values: Any) -> np.ndarray:
    """Read an array of real numbers, on the host.

    Args:
        name: of the argument, for the message.
        values: what was given.

    Returns:
        The array in 64 bit, of whatever shape.

    Raises:
        ValueError: rows of unequal length, text, complex numbers or objects.
    """
    array = _any_array(name, values)
    check_real(name, array.dtype)
    return np.asarray(array, float)


def one_number(name: str, value: Any) -> float:
    """Read a single real number.

    Args:
        name: of the argument, for the message.
        value: what was given.

    Raises:
        ValueError: no number, or several.
    """
    array = real_array(name, value)
    if array.ndim:
        raise ValueError(f"{name}: expected one number, got shape {array.shape}")
    return float(array)


def positive_seconds(name: str, value: Any) -> float:
    """Read a length of time.

    Args:
        name: of the argument, for the message.
        value: what was given.

    Raises:
        ValueError: no single number, or one that is not positive and finite.
    """
    seconds = one_number(name, value)
    if not 0.0 < seconds < np.inf:
        raise ValueError(f"{name}: expected positive seconds, got {value}")
    return seconds


def reading_scale(name: str, values: Any) -> Float[np.ndarray, "4"]:
    """Read standard deviations of position, angle, velocity and spin.

    Args:
        name: of the argument, for the message.
        values: what was given.

    Returns:
        The four numbers in 64 bit.

    Raises:
        ValueError: another shape, or a number that is negative or not finite.
    """
    array = real_array(name, values)
    wanted = f"{name}: expected four finite numbers, at least 0, got"
    if array.shape != (4,):
        raise ValueError(f"{wanted} shape {array.shape}")
    if not np.all(np.isfinite(array) & (array >= 0.0)):
        raise ValueError(f"{wanted} {array.tolist()}")
    return array


def episode_array(values: Any, num_rows: int) -> Int[np.ndarray, " time"]:
    """Read which run each row belongs to.

    Args:
        values: a number for each row; whole ones of a float type will do.
        num_rows: how many rows there are.

    Returns:
        The numbers in 32 bit; rows of one run follow each other.

    Raises:
        ValueError: another shape, numbers that are not whole or do not fit into 32 bit,
            no numbers, or a run that is taken up again.
    """
    array = _any_array("episode", values)
    wanted = "episode: expected whole numbers of 32 bit, got"
    if not is_real(array.dtype):
        raise ValueError(f"{wanted} an array of {array.dtype}")
    if array.shape != (num_rows,):
        raise ValueError(f"episode: expected shape ({num_rows},), got {array.shape}")
    number = np.asarray(array, float)
    # A NaN is neither whole nor small.
    is_right = (number == np.round(number)) & (np.abs(number) < 2**31)
    if not np.all(is_right):
        raise ValueError(f"{wanted} {array[~is_right][0]}")
    starts = np.flatnonzero(np.diff(number, prepend=np.nan) != 0)
    if len(starts) > len(np.unique(number)):
        raise ValueError(
            "episode: expected the rows of an episode to follow each other, got one "
            "that is taken up again"
        )
    return number.astype(np.int32)


def check_fits(name: str, array: Float[np.ndarray, "time body channel"]) -> None:
    """Make sure that no finite number becomes infinite on the default float type.

    Args:
        name: of the argument, for the message.
        array: numbers in 64 bit, none of them infinite.

    Raises:
        ValueError: one does; which row, which body.
    """
    dtype = jax.dtypes.canonicalize_dtype(float)
    is_large = np.abs(array) > jnp.finfo(dtype).max
    if np.any(is_large):
        row, body, _ = np.argwhere(is_large)[0]
        raise ValueError(
            f"{name}: expected numbers that fit {dtype}, got {array[row, body]} in row "
            f"{row}, body {body}"
        )


def _any_array(name: str, values: Any) -> np.ndarray:
    try:
        return np.asarray(values)
    except ValueError as error:
        raise ValueError(
            f"{name}: expected an array, got rows of unequal length"
        ) from error


def check_positive_seconds(
    where: str, dt: np.ndarray, is_right: np.ndarray | np.bool
) -> None:
    """Name the first length of a step that is none, and its row.

    Args:
        where: what the message begins with.
        dt: one length, or one for each row [s].
        is_right: whether each is one.

    Raises:
        ValueError: some are not.
    """
    if np.all(is_right):
        return
    place = int(np.argmin(np.ravel(is_right)))
    row = f" in row {place}" if np.size(dt) > 1 else ""
    wrong = np.ravel(dt)[place]
    raise ValueError(f"{where}dt: expected positive seconds, got {wrong}{row}")
