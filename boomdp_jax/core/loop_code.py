"""What a function of scalars becomes over arrays (`one_loop`): one loop, or many."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.scalar_parts import parts_of
from boomdp_jax.core.unmerged import one_by_sorting

# Numbers in a batch from which a loop that it is worked out in should not be merged
# (`unmerged`), however many `vmap`s made the batch.
_MANY = 8


def common_shape(arrays) -> tuple[int, ...]:
    """The one shape of all arrays that are not scalars."""
    shapes = {tuple(a.shape) for a in arrays} - {()}
    if len(shapes) > 1:
        raise TypeError(f"one_loop got arrays of different shapes: {sorted(shapes)}")
    return shapes.pop() if shapes else ()


@functools.lru_cache(maxsize=256)
def _parts(body):
    return parts_of(body.jaxpr)


def by_vmap(*arguments, body, passed, is_marked):
    """Apply a body as everywhere else in JAX.

    Args:
        arguments: arrays of one shape, and scalars.
        body: `one_loop`'s, a function of scalars.
        passed: which arguments are handed on.
        is_marked: of no concern here.

    Returns:
        The results, and the arguments that are handed on.
    """
    del is_marked
    shape, handed_on = common_shape(arguments), [arguments[i] for i in passed]
    if not shape:
        return [*body.function(*arguments), *handed_on]
    flat = [a.reshape(-1) if a.shape else a for a in arguments]
    axes = tuple(0 if a.shape else None for a in arguments)
    out = jax.vmap(body.function, axes, axis_size=int(np.prod(shape)))(*flat)
    return [leaf.reshape(shape) for leaf in out] + handed_on


def by_reduction(*arguments, body, passed, is_marked):
    """The same by functions of windowed reductions, given and returning the same.

    Args:
        arguments: as for `by_vmap`.
        body: likewise.
        passed: likewise.
        is_marked: whether a loop that many are worked out in should not be merged.
    """
    shape, values, out = common_shape(arguments), list(arguments), []
    # One mark that it should not be merged is enough for all parts.
    needs_mark = is_marked and int(np.prod(shape)) >= _MANY
    for part in _parts(body):
        inputs = [values[i] for i in part.inputs]
        out = _reduction(part.function, inputs, part.num_outputs, needs_mark)
        needs_mark, values = False, values + out
    # A result that depends on scalars alone is one.
    results = [jnp.broadcast_to(leaf, shape) for leaf in out]
    return results + [arguments[i] for i in passed]


def _reduction(function, arguments: list, num_out: int, is_unmerged: bool) -> list:
    """A function of a windowed reduction; scalars travel as initial values."""
    shape, dtype = common_shape(arguments), arguments[0].dtype
    is_array = [bool(a.shape) for a in arguments]
    # What has several axes gets a first one of one: to a vector the backend adds an
    # axis, in an order of its own, and copies for that what is no vector elsewhere.
    flat = (-1,) if len(shape) < 2 else (1, -1)
    arrays = [a.reshape(flat) for a in arguments if a.shape]
    scalars = [a for a in arguments if not a.shape]
    num_slots = max(len(arrays), len(scalars), num_out)
    if is_unmerged:
        # A number more that nobody looks at.
        scalars.append(one_by_sorting(sum(a.reshape(-1)[0] for a in arrays)))
        num_slots = max(num_slots, len(scalars))
    spare = arrays[0] if arrays else jnp.zeros((1,) * len(flat), dtype)
    zero = jnp.zeros((), dtype)
    arrays += [spare] * (num_slots - len(arrays))
    scalars += [zero] * (num_slots - len(scalars))

    def apply(initial, element):
        sources = {True: iter(element), False: iter(initial)}
        out = function(*(next(sources[is_one]) for is_one in is_array))
        return (*out, *(jnp.zeros((), dtype),) * (num_slots - num_out))

    window = (1,) * len(flat)
    out = jax.lax.reduce_window(
        tuple(arrays), tuple(scalars), apply, window, window, "VALID"
    )
    return [leaf.reshape(shape) for leaf in out[:num_out]]


@functools.cache
def is_applied_once() -> bool:
    """Whether the CPU backend applies the function of a reduction as is needed here."""
    first, second = np.array([[1.0, 2.0, -3.0], [0.5, -4.0, 7.0]], np.float32)

    def apply(initial, element):
        return initial[0] - 2.0 * element[0] * element[1], initial[1] + element[1] ** 3

    def reduce(first, second, start):
        return jax.lax.reduce_window(
            (first, second), (start, 2.0 * start), apply, (1,), (1,), "VALID"
        )

    expected = (5.0 - 2.0 * first * second, 10.0 + second**3)
    with (
        jax.ensure_compile_time_eval(),
        jax.disable_jit(False),
        jax.default_device(jax.local_devices(backend="cpu")[0]),
    ):
        found = jax.jit(reduce)(first, second, np.float32(5.0))
        return all(np.array_equal(f, e) for f, e in zip(found, expected, strict=True))
