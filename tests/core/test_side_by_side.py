import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.compile_time import CompileClock
from boomdp_jax.core.side_by_side import call_each, forget_compiled


class Recorder:
    """A function that takes a moment and tells how many run at once."""

    def __init__(self):
        self.num_running, self.counts, self.lock = 0, [], threading.Lock()

    def __call__(self, number):
        with self.lock:
            self.num_running += 1
            self.counts.append((number, self.num_running))
        time.sleep(0.05)
        with self.lock:
            self.num_running -= 1
        return 10 * number


def test_results_come_in_order_and_the_first_call_is_alone():
    recorder = Recorder()
    inputs = [(number,) for number in range(7)]
    assert call_each(recorder, inputs, jnp.zeros(3)) == [10 * n for n in range(7)]
    assert recorder.counts[:2] in ([(0, 1), (1, 1)], [(0, 1), (2, 1)])
    assert sorted(number for number, _ in recorder.counts) == list(range(7))


def test_other_shapes_are_another_first_call():
    recorder = Recorder()
    call_each(recorder, [(0,)], jnp.zeros(3))
    recorder.counts.clear()
    call_each(recorder, [(0,), (1,)], jnp.zeros(4))
    assert recorder.counts == [(0, 1), (1, 1)]
    forget_compiled()
    recorder.counts.clear()
    call_each(recorder, [(0,), (1,)], jnp.zeros(4))
    assert recorder.counts == [(0, 1), (1, 1)]


def test_no_calls_are_no_results():
    assert call_each(lambda: 1, [], jnp.zeros(2)) == []


def test_an_error_is_the_caller_s():
    def fail(number):
        if number == 3:
            raise ValueError("number 3")
        return number

    with pytest.raises(ValueError, match="number 3"):
        call_each(fail, [(number,) for number in range(5)], jnp.zeros(5))


@pytest.mark.parametrize("is_double", [True, False])
def test_threads_have_the_caller_s_float_type(is_double):
    with jax.enable_x64(is_double):
        found = call_each(
            lambda _: jnp.zeros(()).dtype, [(n,) for n in range(4)], jnp.zeros(6)
        )
    assert set(found) == {jnp.dtype(jnp.float64 if is_double else jnp.float32)}


def test_arrays_reach_the_device_without_a_compiler(precision):
    source = np.arange(13.0)
    with jax.enable_x64(precision.bits == 64), CompileClock() as clock:
        array = on_device(source)
        number, flags = on_device(np.arange(17), int), on_device([1, 0, 1], bool)
        assert clock.seconds == 0.0
        assert array.dtype == jnp.zeros(()).dtype
        assert number.dtype == jnp.arange(1).dtype
        assert flags.dtype == bool
    source[:] = 7.0
    np.testing.assert_array_equal(array, np.arange(13.0))
