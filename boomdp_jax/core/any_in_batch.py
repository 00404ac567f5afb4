"""Whether anything in a batch is true: a number that stays one however it is batched.

A loop that goes on while its own condition holds becomes, batched, a loop that goes on
while anyone's does, and after every turn all of what it carries is selected anew for
those that are done. Where what is carried does not change any more once it is done, the
selection is for nothing; asked through this, the condition is one for all.
"""

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import batching, mlir
from jaxtyping import Array, Bool

_any_p = jax.extend.core.Primitive("any_in_batch")


def any_in_batch(is_true: Bool[Array, "..."]) -> Bool[Array, ""]:
    """Whether one is true at least, of all elements and of all of a batch.

    What is worked out from this depends on who else is in the batch. It may only decide
    how long something is gone on with that does no harm.

    Args:
        is_true: of this element of the batch. Not differentiated.

    Returns:
        One truth value, the same for all that are batched by `jax.vmap`.
    """
    return _any_p.bind(is_true)


def _any(is_true):
    return jnp.any(is_true)


def _batched(arguments, dims):
    (is_true,), _ = arguments, dims
    # Axes of the batch are axes like others.
    return _any_p.bind(is_true), None


_any_p.def_impl(_any)
_any_p.def_abstract_eval(lambda aval: jax.core.ShapedArray((), aval.dtype))
batching.primitive_batchers[_any_p] = _batched
mlir.register_lowering(_any_p, mlir.lower_fun(_any, multiple_results=False))
