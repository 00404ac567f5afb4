"""Expected information against the mutual information of two known hypotheses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from boomdp_jax.inference.informative_wrench import informative_wrench
from boomdp_jax.physics import State, empty_params
from tests.inference.posteriors import draws_like, make_posterior, table_spec
from tests.inference.recordings import AREA, DT

NUM_DRAWS = 1000
NOISE = 1e-3


def two_boxes(densities=(10.0, 20.0)):
    """A posterior of two equally likely densities and nothing else open."""
    spec = table_spec()
    density = np.repeat(densities, NUM_DRAWS // 2)[:, None]
    params = draws_like(empty_params(1), NUM_DRAWS, density=jnp.asarray(density))
    return make_posterior(spec, params, params, noise_scale=(NOISE,) * 4)


def two_structures():
    """A posterior that cannot say whether a box has a wheel along its length."""
    spec = table_spec()
    one = empty_params(1, num_wheel=1)
    has_wheel = np.arange(NUM_DRAWS)[:, None, None] < NUM_DRAWS // 2
    shape = (NUM_DRAWS, 1, 1)
    params = draws_like(
        one,
        NUM_DRAWS,
        density=jnp.full((NUM_DRAWS, 1), 10.0),
        wheel_active=jnp.asarray(has_wheel),
        wheel_viscous=jnp.broadcast_to(jnp.array([0.0, 1e4]), (*shape, 2)),
        wheel_dry=jnp.full((*shape, 2), jnp.inf),
    )
    return make_posterior(spec, params, params, noise_scale=(NOISE,) * 4)


def mutual_information(distance: float) -> float:
    """Of which of two unit normals so far apart a number is drawn from [nats]."""

    def integrand(y):
        return stats.norm.pdf(y) * np.logaddexp(0.0, distance * y - distance**2 / 2)

    return np.log(2.0) - integrate.quad(integrand, -12, 12)[0]


@pytest.mark.slow
def test_two_densities_are_told_apart_as_theory_says():
    posterior = two_boxes()
    force = np.array([0.0, 0.15, 0.3, 0.6, 5.0])
    candidates = np.zeros((len(force), 1, 3))
    candidates[:, 0, 0] = force
    found = informative_wrench(
        jax.random.key(0),
        posterior,
        posterior.spec.initial_state(),
        jnp.asarray(candidates),
        num_draws=NUM_DRAWS,
    )
    mass = np.array([10.0, 20.0]) * AREA
    # A force held over a step moves a free body by F dt²/2m and speeds it by F dt/m.
    gap = force * abs(1.0 / mass[0] - 1.0 / mass[1])
    distance = gap * np.hypot(0.5 * DT**2, DT) / NOISE
    expected = [mutual_information(d) for d in distance]
    assert 0.03 < expected[1] < expected[2] < expected[3] < expected[4]
    np.testing.assert_allclose(found.gain, expected, atol=0.05)
    # Four standard errors, and some nats' hundredths for the bound's own bias.
    gaps = np.abs(np.asarray(found.gain) - expected)
    assert np.all(gaps < 4.0 * np.asarray(found.error) + 0.01)
    assert found.best == 4
    assert abs(found.gain[0]) < 1e-12
    # There is one structure, of which nothing can be learnt.
    np.testing.assert_allclose(found.structure_gain, 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_push_across_a_wheel_tells_whether_there_is_one():
    posterior = two_structures()
    candidates = jnp.asarray([[[5.0, 0.0, 0.0]], [[0.0, 5.0, 0.0]]])
    found = informative_wrench(
        jax.random.key(1),
        posterior,
        posterior.spec.initial_state(),
        candidates,
        num_draws=NUM_DRAWS,
        num_steps=3,
    )
    assert found.best == 1
    np.testing.assert_array_equal(found.wrench, candidates[1])
    assert found.structure_gain[1] == pytest.approx(np.log(2.0), abs=1e-3)
    assert found.structure_gain[0] < 0.01
    np.testing.assert_allclose(found.gain, found.structure_gain, atol=1e-9)


@pytest.mark.parametrize(
    ("candidates", "options", "message"),
    [
        (np.zeros((2, 3)), {}, r"shape \[candidate, 1, 3\].*got \(2, 3\)"),
        (np.zeros((0, 1, 3)), {}, "with one at least"),
        (np.full((1, 1, 3), np.nan), {}, "finite wrenches, got one at 0"),
        (np.zeros((1, 1, 3)), {"num_steps": 0}, "num_steps: expected at least 1"),
        (np.zeros((1, 1, 3)), {"num_steps": True}, "num_steps: expected a whole"),
        (np.zeros((1, 1, 3)), {"num_draws": 0}, "num_draws: expected at least 1"),
    ],
)
def test_bad_input_is_refused(candidates, options, message):
    posterior = two_boxes()
    state = posterior.spec.initial_state()
    with pytest.raises(ValueError, match=message):
        informative_wrench(
            jax.random.key(0), posterior, state, jnp.asarray(candidates), **options
        )


NOWHERE = np.array([[0.0, np.nan, 0.0]])


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ((np.zeros((2, 3)), np.zeros((2, 3))), r"state.pose: .*\(1, 3\).*\(2, 3\)"),
        ((NOWHERE, np.zeros((1, 3))), "state: body 'table': expected finite"),
        ((np.zeros((1, 3)), NOWHERE), "state: body 'table': expected finite"),
        (np.zeros((1, 6)), "state: expected a State, got ndarray; state_from_array"),
    ],
)
@pytest.mark.usefixtures("no_type_checks")
def test_a_bad_state_is_refused(state, message):
    state = State(*state) if isinstance(state, tuple) else state
    candidates = np.zeros((1, 1, 3))
    with pytest.raises((TypeError, ValueError), match=message):
        informative_wrench(jax.random.key(0), two_boxes(), state, candidates)
