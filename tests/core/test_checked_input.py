"""Numbers from a caller: read as they are meant, or refused by name."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.checked_input import real_array, whole_number


@pytest.mark.parametrize("value", [3, np.int64(3), jnp.asarray(3)])
def test_every_kind_of_whole_number_is_taken(value: Any):
    assert whole_number("count", value, 1) == 3


@pytest.mark.parametrize("value", [2.5, 3.0, np.float64(3.0), True, "3", None])
def test_what_is_no_whole_number_is_refused(value: Any):
    with pytest.raises(ValueError, match="count: expected a whole number, at least 1"):
        whole_number("count", value, 1)


def test_too_small_a_number_is_refused():
    with pytest.raises(ValueError, match="count: expected at least 1, got -1"):
        whole_number("count", -1, 1)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([[1.0], [1.0, 2.0]], "state: expected an array, got rows of unequal length"),
        ([True], "state: expected real numbers, got an array of bool"),
        ([object()], "state: expected real numbers, got an array of object"),
    ],
)
def test_what_is_no_array_of_real_numbers_is_refused(values: list, message: str):
    with pytest.raises(ValueError, match=message):
        real_array("state", values)
