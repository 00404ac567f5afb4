"""The clock sees compilation and nothing else."""

import time

import jax
import jax.numpy as jnp

from boomdp_jax.core.compile_time import CompileClock


def test_only_compilation_is_counted():
    double = jax.jit(lambda x: 2.0 * jnp.sin(x))
    start = time.perf_counter()
    with CompileClock() as clock:
        double(jnp.ones(3)).block_until_ready()
    wall = time.perf_counter() - start
    assert 0.0 < clock.seconds <= wall
    first = clock.seconds
    with CompileClock() as again:
        double(jnp.ones(3)).block_until_ready()
    assert again.seconds == 0.0
    jax.jit(lambda x: 3.0 * jnp.cos(x))(jnp.ones(4)).block_until_ready()
    assert clock.seconds == first
