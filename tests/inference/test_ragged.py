"""Histories of different lengths in one batch."""

import jax
import numpy as np
import pytest

from boomdp_jax.core.compile_ahead import signature
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import FitSettings
from boomdp_jax.inference.infer import padded_histories
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points
from tests.inference.recordings import box_scene, free_box


def histories(*num_rows):
    return [free_box(np.random.default_rng(n), n) for n in num_rows]


@pytest.mark.parametrize(
    ("lengths", "capacities"),
    [
        ((5, 9, 7), (9, 9, 9)),
        ((0, 3), (3, 3)),
        # None is padded to more than four times its length.
        ((200, 60, 10, 49), (200, 200, 13, 50)),
        ((), ()),
    ],
)
def test_few_capacities_do_for_all(lengths, capacities):
    padded = padded_histories(histories(*lengths))
    assert tuple(history.capacity for history in padded) == capacities
    assert tuple(int(history.num_transitions) for history in padded) == lengths


def test_lengths_share_a_compiled_program():
    spec = box_scene({"wheel": 1})
    blocks = [
        make_block(spec, (0,), history) for history in padded_histories(histories(5, 9))
    ]
    assert signature(blocks[0].target) == signature(blocks[1].target)


@pytest.mark.slow
def test_padding_changes_neither_fit_nor_density():
    spec = box_scene({})
    (short,) = histories(12)
    plain, padded = (
        stack_blocks([make_block(spec, (0,), history)])
        for history in (short, short.padded(40))
    )
    found = [find_modes(jax.random.key(1), t, FitSettings()) for t in (plain, padded)]
    np.testing.assert_allclose(found[0].modes.z, found[1].modes.z, atol=1e-6)
    np.testing.assert_allclose(
        found[0].noise.reading, found[1].noise.reading, rtol=1e-4
    )
    z = np.random.default_rng(0).normal(size=(20, plain.slot.shape[1]))
    index = np.zeros(20, int)
    values = [evaluate_points(f.targets, index, index, z).log_density for f in found]
    np.testing.assert_allclose(*values, rtol=1e-5)
