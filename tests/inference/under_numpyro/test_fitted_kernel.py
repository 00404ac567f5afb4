"""The jump sampler's kernel made from a scene, and what it prints."""

import jax
import numpy as np
import pytest
from numpyro.infer import MCMC

from boomdp_jax.inference.under_numpyro.fitted_kernel import structure_kernel
from boomdp_jax.inference.under_numpyro.numpyro_model import make_model
from tests.inference.under_numpyro.test_numpyro_model import make_spec, pushed


@pytest.mark.slow
def test_a_scene_runs_under_numpyro_and_prints_physical_names(capsys):
    spec = make_spec(unknown={"revolute": 1})
    history = pushed(spec, num_rows=40)
    kernel = structure_kernel(jax.random.key(0), spec, history)
    mcmc = MCMC(
        kernel,
        num_warmup=50,
        num_samples=200,
        num_chains=2,
        chain_method="vectorized",
    )
    mcmc.run(jax.random.key(1), extra_fields=("chain.point.z",))
    samples = mcmc.get_samples()
    # The box is free, and a pin would be seen at once: about one prior odds per row.
    assert np.mean(samples["table.revolute"]) < 0.05
    mass = np.asarray(samples["table.mass"])
    assert abs(mass.mean() - 2.4) < 5 * mass.std()
    np.testing.assert_allclose(mass, samples["table.density"] * 0.08)
    is_free = np.asarray(samples["table.revolute"]) == 0
    assert np.all(np.asarray(samples["table.revolute.anchor_a"])[is_free] == 0)
    assert mcmc.get_extra_fields()["chain.point.z"].shape[-1] == kernel.target.dim
    with np.errstate(invalid="ignore"):
        mcmc.print_summary()
    printed = capsys.readouterr().out
    assert "table.mass" in printed
    assert "table.revolute.anchor_a[0]" in printed


def test_one_of_several_blocks_has_to_be_chosen():
    spec = make_spec(names=("table", "chair"), unknown={"wheel": 1})
    history = pushed(spec)
    with pytest.raises(ValueError, match=r"\['table'\]; \['chair'\]; got none"):
        structure_kernel(jax.random.key(0), spec, history)
    with pytest.raises(ValueError, match=r"got \['table', 'chair'\]"):
        structure_kernel(jax.random.key(0), spec, history, bodies=["table", "chair"])
    with pytest.raises(ValueError, match="one of table, chair, got 'lamp'"):
        structure_kernel(jax.random.key(0), spec, history, bodies=["lamp"])
    with pytest.raises(ValueError, match="expected 1 bodies, got 2"):
        structure_kernel(jax.random.key(0), make_spec(), history)


@pytest.mark.parametrize("history", [None, "x", np.zeros((2, 1, 6))])
def test_a_history_or_scene_that_is_none_is_refused(no_type_checks, history):
    """By the model of one structure too."""
    spec, key = make_spec(), jax.random.key(0)
    for call in (structure_kernel, lambda _, *arguments: make_model(*arguments)):
        with pytest.raises(TypeError, match=r"^history: expected a History, .*; got "):
            call(key, spec, history)
        with pytest.raises(TypeError, match=r"^spec: expected a SceneSpec, .*; got "):
            call(key, "room.json", history)
