"""What is left of a batch, a few lanes at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.few_at_a_time import few_at_a_time


def halved(known, found):
    """What is known, halved until it is odd, and how often that takes."""

    def go_on(carry):
        rest, count = carry
        is_even = rest % 2 == 0
        return jnp.where(is_even, rest // 2, rest), count + is_even

    rest, count = jax.lax.while_loop(
        lambda carry: jnp.any(carry[0] % 2 == 0), go_on, (known, found[0])
    )
    return count, found[1] + rest[None]


@pytest.mark.parametrize("num_open", [0, 1, 4, 5, 9, 23])
def test_open_lanes_and_no_others_are_changed(num_open):
    rng = np.random.default_rng(num_open)
    known = rng.integers(1, 2**10, 23) * 2 ** rng.integers(0, 8, 23)
    is_open = np.zeros(23, bool)
    is_open[rng.permutation(23)[:num_open]] = True
    before = rng.integers(0, 9, 23), rng.integers(0, 9, (2, 23))
    count, total = jax.jit(lambda *given: few_at_a_time(halved, *given, at_a_time=4))(
        is_open, known, before
    )
    # The largest power of two in a number is it and its complement's successor.
    power = known & -known
    np.testing.assert_array_equal(
        count, before[0] + np.where(is_open, np.log2(power), 0).astype(int)
    )
    np.testing.assert_array_equal(
        total, before[1] + np.where(is_open, known // power, 0)
    )
