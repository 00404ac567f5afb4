"""What channels were between rare readings, and what is found from such."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import boomdp_jax
from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.read_velocities import with_read_velocities
from boomdp_jax.inference.readings.between_readings import between_readings
from boomdp_jax.physics import rollout, scene_spec_from_dict

BOX = {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}}
BOX |= {"pose": [0.1, -0.2, 0.3]}
COMMON = {"schema": "planar-scene-1", "dt": 0.02}
UNKNOWN = {"revolute": 1, "wheel": 1, "ground": 1}
NOISE = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])


def parabola(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Instants and states of a body of constant acceleration, which turns past pi."""
    time = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.03, num))
    rate, bend = np.array([0.3, -0.2, 2.0]), np.array([1.0, -2.0, 1.5])
    pose = [0.1, 0.2, 2.8] + time[:, None] * rate + 0.5 * time[:, None] ** 2 * bend
    velocity = rate + time[:, None] * bend
    return time, np.concatenate([pose, velocity], axis=1)[:, None]


def wrapped(states: np.ndarray) -> np.ndarray:
    return np.where(np.arange(6) == 2, np.angle(np.exp(1j * states)), states)


@pytest.mark.parametrize("every", [2, 5])
@pytest.mark.parametrize("channels", [3, 6])
def test_constant_acceleration_is_met_exactly(every, channels):
    time, states = parabola(41)
    read = (np.arange(41) % every == 0)[:, None, None] & (np.arange(6) < channels)
    bare = np.where(read, wrapped(states), np.nan)
    found, is_known = between_readings(time, bare, read, 3)
    assert np.all(is_known)
    apart = found - states
    apart[..., 2] = np.angle(np.exp(1j * apart[..., 2]))
    np.testing.assert_allclose(apart, 0.0, atol=1e-9)


def test_channels_may_be_read_in_turn():
    time, states = parabola(40)
    turn = np.arange(40)[:, None] % 6 == np.arange(6)
    bare = np.where(turn[:, None], wrapped(states), np.nan)
    found, is_known = between_readings(time, bare, turn[:, None], 1)
    # Before its first reading and after its last nothing is known of a place or angle,
    # and where neither these nor it tell, nothing of a velocity.
    seen = [np.flatnonzero(turn[:, channel]) for channel in range(6)]
    for channel in range(6):
        expected = np.zeros(40, bool)
        for tells in (channel, channel % 3):
            expected[seen[tells][0] : seen[tells][-1] + 1] = True
        np.testing.assert_array_equal(is_known[:, 0, channel], expected)
    apart = np.where(is_known, found - states, 0.0)
    apart[..., 2] = np.angle(np.exp(1j * apart[..., 2]))
    np.testing.assert_allclose(apart, 0.0, atol=1e-9)


def test_two_readings_make_a_line_and_one_makes_nothing():
    time, read = 0.1 * np.arange(5), np.zeros((5, 2, 6), bool)
    read[[0, 4], 0, 0] = read[2, 1, 0] = True
    values = np.where(read, 2.0 * time[:, None, None], np.nan)
    found, is_known = between_readings(time, values, read, 1)
    np.testing.assert_allclose(found[:, 0, 0], 2.0 * time, atol=1e-12)
    # With the slope of its places for a velocity, which nobody read.
    np.testing.assert_allclose(found[:, 0, 3], 2.0, rtol=1e-12)
    assert is_known[:, 0, [0, 3]].all()
    assert not is_known[:, 0, [1, 2, 4, 5]].any()
    np.testing.assert_array_equal(np.argwhere(is_known[:, 1]), [[2, 0]])


def pushed(seed: int, num: int = 64):
    """Instants of a pinned box that is pushed about, and the wrenches."""
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    anchor = np.array([0.15, 0.05])
    pin = {"type": "revolute", "a": "box", "b": "world", "viscous": 0.02}
    pin |= {"anchor_a": anchor.tolist()}
    pin |= {"anchor_b": (turn @ anchor + BOX["pose"][:2]).tolist()}
    bodies = [BOX | {"density": 20.0}]
    truth = scene_spec_from_dict({**COMMON, "bodies": bodies, "constraints": [pin]})
    rng = np.random.default_rng(seed)
    wrench = rng.normal(size=(num // 8, 1, 3)) * [60.0, 60.0, 12.0]
    wrench = np.repeat(wrench, 8, axis=0)
    start = truth.initial_state()
    known = truth.scene, truth.params(), start, jnp.asarray(wrench)
    run, _ = jax.jit(rollout)(*known)
    states = np.concatenate([np.asarray(start.array)[None], np.asarray(run.array)])
    return states + NOISE * rng.normal(size=states.shape), wrench


def history_of(states: np.ndarray, wrench: np.ndarray):
    return make_history(states[:-1], wrench, states[1:], 0.02)


def test_where_few_steps_were_read_in_full_first_fits_get_the_rest():
    states, wrench = pushed(0)
    spec = scene_spec_from_dict({**COMMON, "bodies": [BOX], "unknown": UNKNOWN})

    def targets_of(states):
        return stack_blocks([make_block(spec, (0,), history_of(states, wrench))])

    states[1::2] = np.nan
    targets = targets_of(states)
    assert not np.any(targets.log_likelihood.data.steps.mask)
    data = with_read_velocities(targets).log_likelihood.data
    assert np.all(data.steps.mask)
    # Readings stay what they were.
    seen = ~np.isnan(states[:-1])
    np.testing.assert_array_equal(
        np.where(seen, data.steps.state[0], 0.0), np.where(seen, states[:-1], 0.0)
    )
    # A single gap is left a gap.
    states, _ = pushed(0)
    states[20:40] = np.nan
    targets = targets_of(states)
    assert with_read_velocities(targets) is targets


def rarely(states: np.ndarray, way: str) -> np.ndarray:
    """Readings of some instants, or of some channels of each."""
    states = states.copy()
    if way == "poses of every second":
        states[1::2], states[..., 3:] = np.nan, np.nan
    elif way == "every fourth":
        states[np.arange(len(states)) % 4 > 0] = np.nan
    elif way == "ends of rows":
        states[0] = np.nan
    else:
        states[0::2, :, [0, 2, 4]], states[1::2, :, [1, 3, 5]] = np.nan, np.nan
    return states


WAYS = ("poses of every second", "every fourth", "channels in turn", "ends of rows")


@pytest.mark.slow
def test_a_pin_is_found_from_readings_that_are_rare():
    """Twelve of sixteen such were a wheel or free without a doubt."""
    spec = scene_spec_from_dict({**COMMON, "bodies": [BOX], "unknown": UNKNOWN})
    histories = []
    for number, way in enumerate(WAYS * 2):
        states, wrench = pushed(number)
        history = history_of(rarely(states, way), wrench)
        if way == "ends of rows":
            none = jnp.full_like(history.state, jnp.nan)
            history = make_history(none, wrench, states[1:], 0.02)
        histories.append(history)
    found = boomdp_jax.infer_batch(jax.random.key(0), [spec] * 8, histories)
    for posterior in found:
        has_pin = np.asarray(posterior.params.revolute.active)[:, 0]
        assert posterior.weights @ has_pin > 0.95
        density = np.log(np.asarray(posterior.params.density)[:, 0])
        apart = posterior.weights @ density - np.log(20.0)
        # Of a pin the moment about it is known, and mass with the place of the pin.
        assert abs(apart) < 4.0 * density.std() + 0.01
