"""What inference says to arguments that are none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from boomdp_jax.core import make_history
from boomdp_jax.inference import OnlineBelief, infer, infer_batch
from boomdp_jax.inference.arguments import check_arguments, check_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.infer import padded_histories
from boomdp_jax.physics import scene_spec_from_dict

KEY = jax.random.key(0)
SPEC = scene_spec_from_dict(
    {
        "schema": "planar-scene-1",
        "dt": 0.02,
        "bodies": [{"name": "box", "shape": {"type": "circle", "radius": 0.2}}],
        "unknown": {"revolute": 1},
    }
)


def history_of(num_rows, num_bodies=1):
    state = np.zeros((num_rows, num_bodies, 6))
    return make_history(state, np.zeros((num_rows, num_bodies, 3)), state, 0.02)


@pytest.mark.parametrize("history", [None, "pushes.npz", np.zeros((4, 1, 6))])
def test_a_history_that_is_none_is_refused(history):
    with pytest.raises(TypeError, match=r"history: expected a History, .*; got "):
        check_history(SPEC, history)


def test_a_history_of_other_bodies_or_of_a_batch_is_refused():
    with pytest.raises(ValueError, match=r"history: expected 1 bodies, got 2"):
        check_history(SPEC, history_of(3, 2))
    batch = jax.tree.map(lambda leaf: leaf[None], history_of(3))
    with pytest.raises(
        ValueError, match=r"expected states \[time, body, 6\]; got .*1, 3"
    ):
        check_history(SPEC, batch)


@pytest.mark.parametrize("spec", ["room.json", {"bodies": []}, SPEC.scene])
def test_a_scene_that_is_none_is_refused(spec):
    with pytest.raises(TypeError, match=r"spec: expected a SceneSpec, .*; got "):
        check_arguments(KEY, [spec], [history_of(2)], None)


def test_keys_lists_and_meshes_are_told_apart():
    rows = history_of(2)
    with pytest.raises(TypeError, match=r"key: expected one such as .*; got 0"):
        check_arguments(0, [SPEC], [rows], None)
    with pytest.raises(TypeError, match=r"mesh: expected a jax.sharding.Mesh; got 4"):
        check_arguments(KEY, [SPEC], [rows], 4)
    with pytest.raises(TypeError, match=r"specs: expected a list; got SceneSpec"):
        check_arguments(KEY, SPEC, [rows], None)
    with pytest.raises(
        ValueError, match=r"histories: expected one per scene, 1, got 2"
    ):
        infer_batch(KEY, [SPEC], [rows, rows])


def test_a_belief_that_is_begun_without_a_key_is_refused(no_type_checks):
    belief = OnlineBelief(SPEC, capacity=32)
    with pytest.raises(TypeError, match=r"key: expected one such as .*; got 0"):
        belief.init(0)


@pytest.mark.parametrize(
    ("count", "message"),
    [
        ({"num_samples": 0}, "num_samples: expected at least 1, got 0"),
        ({"num_chains": 0}, "num_chains: expected at least 1, got 0"),
        ({"num_chains": -2}, "num_chains: expected at least 1, got -2"),
        ({"num_warmup": -1}, "num_warmup: expected at least 0, got -1"),
    ],
)
@pytest.mark.parametrize("method", ["rj", "nuts"])
def test_counts_that_are_too_small_are_refused_at_once(method, count, message):
    with pytest.raises(ValueError, match=message):
        infer(KEY, SPEC, history_of(2), method=method, **count)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "num_each"), [("enumerate", 2), ("smc", 1)])
def test_few_draws_are_returned_and_not_judged(method, num_each):
    """Of `smc` two draws of four chains are spread over sixteen islands."""
    posterior = infer(KEY, SPEC, history_of(0), method=method, num_samples=2)
    diagnostics = posterior.to_json()["diagnostics"]
    assert not diagnostics["ok"]
    assert (
        "box: too few draws to judge: expected at least 4 of each chain, got "
        f"{num_each}" in diagnostics["reasons"]
    )
    assert diagnostics["r_hat"] is None


def test_an_empty_table_has_room_for_a_row():
    (padded,) = padded_histories([history_of(0)])
    assert (padded.capacity, int(padded.num_transitions)) == (1, 0)


def test_an_empty_history_gives_the_prior():
    posterior = infer(
        KEY, SPEC, history_of(0), method="map", likelihood="one-step", num_samples=50
    )
    assert np.isfinite(posterior.log_evidence)


def test_a_block_of_no_rows_has_a_density():
    target = make_block(SPEC, (0,), history_of(0)).target
    first, z = jnp.asarray(0), jnp.zeros(target.dim)
    expected = target.log_prior_density(first, z)
    np.testing.assert_allclose(target.log_density(first, z), expected)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["svi", "nuts"])
def test_an_empty_history_gives_the_prior_of_one_structure(method):
    """Quantiles of the density, with the error of 300 independent draws."""
    posterior = infer(KEY, SPEC, history_of(0), method=method, structure={})
    density = np.asarray(posterior.params.density[:, 0])
    slack = scipy.stats.norm.isf(1e-4) * np.sqrt(0.25 / 300)
    for p in (0.1, 0.5, 0.9):
        quantile = scipy.stats.lognorm(1.5, scale=30.0).ppf(p)
        assert np.mean(density < quantile) == pytest.approx(p, abs=slack)
