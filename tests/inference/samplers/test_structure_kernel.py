"""The NumPyro front end: chain methods, summary, progress, resuming, refusals."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.infer import MCMC

from boomdp_jax.inference.samplers.moves import MOVES
from boomdp_jax.inference.samplers.structure_kernel import StructureKernel
from tests.inference.linear_gaussian import (
    SLOT,
    closed_form,
    make_problem,
    skewed_mixture,
)


def linear_case():
    """A linear target and a skewed mixture."""
    target, design, data = make_problem()
    _, _, means, covariances = closed_form(design, data)
    return target, skewed_mixture(target, means, covariances)


@pytest.fixture(scope="module")
def kernel():
    target, mixture = linear_case()
    return StructureKernel(target, mixture)


def run_mcmc(kernel, key, method, num_samples=30):
    # With a progress bar NumPyro compiles an iteration once, without it every run anew.
    mcmc = MCMC(
        kernel,
        num_warmup=10,
        num_samples=num_samples,
        num_chains=2,
        chain_method=method,
    )
    mcmc.run(key, extra_fields=("log_density", "info.accepted"))
    return mcmc


@pytest.mark.slow
def test_numpyro_chains_agree_between_methods_and_print(kernel, capsys):
    key = jax.random.key(5)
    together = run_mcmc(kernel, key, "vectorized")
    one_by_one = run_mcmc(kernel, key, "sequential")
    jax.tree.map(
        partial(np.testing.assert_allclose, atol=1e-9),
        together.get_samples(group_by_chain=True),
        one_by_one.get_samples(group_by_chain=True),
    )
    samples = together.get_samples()
    assert samples["structure"].shape == (60,)
    assert samples["z"].shape == (60, SLOT.size)
    fields = together.get_extra_fields()
    expected = jax.vmap(kernel.target.log_density)(samples["structure"], samples["z"])
    np.testing.assert_allclose(fields["log_density"], expected, atol=1e-9)
    together.print_summary()
    assert "structure" in capsys.readouterr().out
    accepted = fields["info.accepted"].reshape(2, 30, len(MOVES), 2)
    assert np.all(np.diff(accepted, axis=1) >= 0)


@pytest.mark.slow
def test_numpyro_run_resumes_to_the_same_bits(kernel):
    whole = run_mcmc(kernel, jax.random.key(5), "vectorized", num_samples=30)
    first = run_mcmc(kernel, jax.random.key(5), "vectorized", num_samples=10)
    begun = first.get_samples(group_by_chain=True)["z"]
    rest = MCMC(
        kernel,
        num_warmup=10,
        num_samples=20,
        num_chains=2,
        chain_method="vectorized",
        progress_bar=False,
    )
    rest.post_warmup_state = first.last_state
    rest.run(first.last_state.rng_key)
    z = np.concatenate([begun, rest.get_samples(group_by_chain=True)["z"]], axis=1)
    np.testing.assert_array_equal(z, whole.get_samples(group_by_chain=True)["z"])


@pytest.mark.slow
def test_numpyro_single_chain_shows_progress_and_postprocesses(capsys):
    target, mixture = linear_case()
    kernel = StructureKernel(
        target, mixture, postprocess=lambda sample: {"first": sample["z"][0]}
    )
    mcmc = MCMC(kernel, num_warmup=2, num_samples=4, num_chains=1)
    start = {"structure": jnp.asarray(1), "z": jnp.asarray([0.1, 0.2, 9.0, 9.0, 9.0])}
    state = kernel.init(jax.random.key(0), 2, start)
    np.testing.assert_array_equal(state.sample.z, [0.1, 0.2, 0.0, 0.0, 0.0])
    mcmc.run(jax.random.key(0), init_params=start)
    assert mcmc.get_samples()["first"].shape == (4,)
    assert "jump" in kernel.get_diagnostics_str(mcmc.last_state)


@pytest.mark.slow
def test_a_structure_without_components_is_refused_by_the_kernel():
    target, mixture = linear_case()
    lacking = eqx.tree_at(
        lambda m: m.log_weight,
        mixture,
        jnp.where(mixture.structure == 2, -jnp.inf, mixture.log_weight),
    )
    with pytest.raises(ValueError, match=r"got none for structures \[2\]"):
        StructureKernel(target, lacking)
