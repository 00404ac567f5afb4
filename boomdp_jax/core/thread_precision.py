"""Work for another thread, in the precision of this one."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def in_this_precision(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, with floats double or not as they are here.

    Whether they are is a setting of the thread.
    """
    is_double = jnp.zeros(()).dtype == jnp.float64

    @functools.wraps(function)
    def run(*arguments: Any) -> Any:
        with jax.enable_x64(is_double):
            return function(*arguments)

    return run
