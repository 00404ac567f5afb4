import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.diagnostics import effective_sample_size

from boomdp_jax.inference.assemble import _named
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.chain_diagnostics import diagnose_chains
from boomdp_jax.inference.samplers.structure_chain import ChainDraws
from tests.inference.recordings import box_scene, free_box


def one_angle() -> StructureTarget:
    """A target of one coordinate, an angle, and one structure."""
    return StructureTarget(
        log_likelihood=lambda z, active: jnp.zeros(()),
        structures=jnp.ones((1, 0), bool),
        log_prior=jnp.zeros(1),
        slot=jnp.full(1, -1, jnp.int32),
        period=jnp.full(1, np.pi, jnp.float32),
    )


def test_an_angle_close_to_zero_is_judged_beyond_single_precision():
    """Its cosine is one to single precision, but for a few draws far out."""
    rng = np.random.default_rng(0)
    z = (4e-5 * rng.standard_normal((4, 256, 1))).astype(np.float32)
    draws = ChainDraws(
        jnp.zeros((4, 256), jnp.int32),
        jnp.asarray(z),
        jnp.asarray(rng.standard_normal((4, 256))),
    )
    verdict = diagnose_chains(one_angle(), draws)
    cosine = np.cos(2.0 * z[..., 0].astype(float))
    expected = float(effective_sample_size(cosine))
    assert verdict.effective_sample_size["z_0_cos"] == pytest.approx(expected)
    assert verdict.ok, verdict.reasons


@pytest.mark.parametrize("num_each", [1, 3])
def test_few_draws_are_not_judged_and_it_says_so(num_each):
    """Halves of chains cannot be compared, nor can it be told that one is stuck."""
    rng = np.random.default_rng(1)
    draws = ChainDraws(
        jnp.zeros((2, num_each), jnp.int32),
        jnp.asarray(rng.standard_normal((2, num_each, 1))),
        jnp.asarray(rng.standard_normal((2, 1)).repeat(num_each, axis=1)),
    )
    verdict = diagnose_chains(one_angle(), draws)
    assert verdict.reasons == [
        f"too few draws to judge: expected at least 4 of each chain, got {num_each}"
    ]
    assert not verdict.ok
    assert np.isnan(verdict.r_hat["log_density"])
    assert np.isnan(verdict.effective_sample_size["log_density"])


def test_reasons_name_what_people_know():
    """A box's density is coordinate 0, a wheel's take 1 to 8, its heading is 3."""
    spec = box_scene({"wheel": 1, "ground": 1})
    block = make_block(spec, (0,), free_box(np.random.default_rng(0), 2))
    reasons = {
        "z_0: R-hat is 2.000, above 1.05": "box.density: R-hat is 2.000, above 1.05",
        "z_2: R-hat is nan": "box.wheel.position[1]: R-hat is nan",
        "z_3_cos: R-hat is 2": "cos 2 box.wheel.heading: R-hat is 2",
        "z_3_sin: R-hat is 2": "sin 2 box.wheel.heading: R-hat is 2",
        "z_10: R-hat is 2": "box.ground.knee_speed: R-hat is 2",
        "slot_1: R-hat is 2": "whether box.ground exists: R-hat is 2",
        "log_density: R-hat is 2": "log_density: R-hat is 2",
        "chains [0] never moved": "chains [0] never moved",
    }
    assert _named(spec, block, list(reasons)) == list(reasons.values())
