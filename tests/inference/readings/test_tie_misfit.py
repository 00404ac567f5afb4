"""Whether a pair may be tied, from readings made up by geometry alone."""

import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.readings.components import TIE_TOLERANCE, independent_blocks
from boomdp_jax.inference.readings.tie_misfit import (
    pin_misfit,
    rod_range,
    rotations,
    slide_misfit,
)
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

NUM = 60
ONE_RUN = np.zeros(NUM)
ARM_A, ARM_B = np.array([0.35, 0.1]), np.array([-0.3, 0.0])


def path(rng, num=NUM):
    """A smooth way of poses, some 0.4 m and 2 rad about."""
    time = np.linspace(0.0, 1.0, num)[:, None]
    slow, fast = rng.uniform(3.0, 9.0, (2, 3))
    begin = rng.uniform(0.0, 6.0, 3)
    waves = np.sin(slow * time + begin) + 0.5 * np.sin(fast * time)
    return waves * [0.3, 0.3, 1.2]


def pinned(rng, num=NUM):
    """Two bodies that share a point."""
    a, b = path(rng, num), path(rng, num)
    b[:, :2] = a[:, :2] + rotations(a[:, 2]) @ ARM_A - rotations(b[:, 2]) @ ARM_B
    return a, b


def noisy(rng, pair, position, angle=0.01):
    return [p + rng.normal(size=p.shape) * [position, position, angle] for p in pair]


@pytest.mark.parametrize("position", [0.001, 0.02, 0.03, 0.06])
def test_noise_alone_parts_no_pair(position):
    for seed in range(10):
        rng = np.random.default_rng([seed, 1])
        misfit = pin_misfit(*noisy(rng, pinned(rng), position), ONE_RUN)
        assert misfit.may_be(TIE_TOLERANCE)
        # Of the offset of two bodies.
        assert misfit.noise == pytest.approx(np.sqrt(2) * position, rel=0.6, abs=0.006)


@pytest.mark.parametrize("position", [0.001, 0.03])
def test_pairs_that_go_their_own_ways_are_parted(position):
    for seed in range(10):
        rng = np.random.default_rng([seed, 2])
        misfit = pin_misfit(*noisy(rng, (path(rng), path(rng)), position), ONE_RUN)
        assert not misfit.may_be(TIE_TOLERANCE)
        assert misfit.smooth > 0.06


def test_a_pair_of_which_one_moves_for_a_tenth_of_the_time_is_parted():
    rng = np.random.default_rng(3)
    a, b = np.zeros((NUM, 3)), np.tile([1.0, 0.0, 0.3], (NUM, 1))
    b[30:36] += np.linspace(0.0, 1.0, 6)[:, None] * [0.2, 0.1, 1.0]
    b[36:] = b[35]
    # A pin between them would be anywhere but for the angle, which returns.
    b[36:, 2] = 0.3
    assert not pin_misfit(*noisy(rng, (a, b), 0.001), ONE_RUN).may_be(TIE_TOLERANCE)


@pytest.mark.parametrize("count", [1, 5])
def test_gross_errors_part_no_pair(count):
    for seed in range(10):
        rng = np.random.default_rng([seed, 4])
        pair = noisy(rng, pinned(rng), 0.001)
        for poses in pair:
            bad = rng.choice(NUM, count, replace=False)
            poses[bad, :2] += rng.normal(0.0, 0.3, (count, 2)) + 0.3
        misfit = pin_misfit(*pair, ONE_RUN)
        assert misfit.raw > TIE_TOLERANCE
        assert misfit.may_be(TIE_TOLERANCE)


def test_a_burst_of_four_rows_parts_no_pair():
    for seed in range(10):
        rng = np.random.default_rng([seed, 9])
        pair = noisy(rng, pinned(rng), 0.001)
        pair[1][20:24, :2] += [0.3, -0.2]
        misfit = pin_misfit(*pair, ONE_RUN)
        assert misfit.raw > TIE_TOLERANCE
        assert misfit.may_be(TIE_TOLERANCE)


def test_medians_do_not_reach_from_run_to_run():
    rng = np.random.default_rng(5)
    first, second = pinned(rng, 30), pinned(rng, 30)
    # Run by run one point in common, but not the same one.
    second[1][:, 0] += 0.5
    pair = [np.concatenate(parts) for parts in zip(first, second, strict=True)]
    misfit = pin_misfit(*pair, np.repeat([0, 1], 30))
    assert not misfit.may_be(TIE_TOLERANCE)
    # Too short for medians: as they are.
    short = pin_misfit(*(p[:10] for p in pair), np.zeros(10))
    assert short.noise == 0.0
    assert short.smooth == pytest.approx(short.raw, abs=1e-3)


def test_a_drawer_with_coarse_readings_may_be_one():
    for seed in range(10):
        rng = np.random.default_rng([seed, 6])
        b = path(rng)
        a = np.array(b)
        slid = np.stack([0.3 * np.sin(np.linspace(0, 7, NUM)), np.full(NUM, 0.2)], 1)
        a[:, :2] += np.einsum("tij,tj->ti", rotations(b[:, 2]), slid)
        a[:, 2] += 0.4
        assert slide_misfit(a, b, 0.4, ONE_RUN).raw < 1e-6
        assert slide_misfit(*noisy(rng, (a, b), 0.04), 0.4, ONE_RUN).may_be(
            TIE_TOLERANCE
        )
        apart = slide_misfit(*noisy(rng, (path(rng), b), 0.04), 0.4, ONE_RUN)
        assert not apart.may_be(TIE_TOLERANCE)


def test_one_gross_error_does_not_make_a_rod_longer():
    rng = np.random.default_rng(7)
    a = path(rng)
    b = a + np.array([1.0, 0.0, 0.0])
    assert rod_range(a, b, ONE_RUN) < 1e-9
    b[30, 0] += 5.0
    assert rod_range(a, b, ONE_RUN) < 1e-9
    b[30:, 0] += 2.0
    assert rod_range(a, b, ONE_RUN) == pytest.approx(2.0)


def test_nothing_read_parts_nothing():
    none = np.zeros((0, 3))
    assert pin_misfit(none, none, np.zeros(0)).may_be(TIE_TOLERANCE)
    assert slide_misfit(none, none, 1.0, np.zeros(0)).may_be(TIE_TOLERANCE)
    assert rod_range(none, none, np.zeros(0)) == 0.0


def test_blocks_of_a_scene_with_coarse_readings():
    """Readings 3 cm off: the pinned pair is one block, a third body another."""
    rng = np.random.default_rng(8)
    bodies = [*noisy(rng, pinned(rng), 0.03), *noisy(rng, [path(rng)], 0.03)]
    state = np.zeros((NUM, 3, 6))
    state[..., :3] = np.stack(bodies, axis=1)
    history = make_history(state[:-1], np.zeros((NUM - 1, 3, 3)), state[1:], 0.02)
    shape = {"type": "box", "half_extents": [0.3, 0.2]}
    names = ("table", "leaf", "chair")
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [{"name": name, "shape": shape} for name in names],
            "unknown": {"revolute": 1},
        }
    )
    blocks, notes = independent_blocks(spec, history)
    assert blocks == [(0, 1), (2,)]
    assert "table-chair" in notes[0]
    assert "table-leaf" not in notes[0]
