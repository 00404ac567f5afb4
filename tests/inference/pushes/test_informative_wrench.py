"""Expected information against the mutual information of two known hypotheses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, signal, stats

from boomdp_jax.inference.posteriors.random_motion import add_impulse
from boomdp_jax.inference.pushes.informative_wrench import informative_wrench
from boomdp_jax.inference.pushes.reading_law import law_after
from boomdp_jax.physics import State, empty_params, step
from boomdp_jax.physics.params import Actuator
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.made_posteriors import (
    draws_like,
    make_posterior,
    table_posterior,
    table_spec,
)
from tests.inference.recordings import AREA, DT, response, transition_matrix

NUM_DRAWS = 1000
NOISE = 1e-3


def two_boxes(densities=(10.0, 20.0), *, noise=(NOISE,) * 4, impulse=None, **fields):
    """A posterior of two equally likely densities and nothing else open."""
    spec = table_spec()
    density = np.repeat(densities, NUM_DRAWS // 2)[:, None]
    params = draws_like(empty_params(1), NUM_DRAWS, density=jnp.asarray(density))
    if impulse is not None:
        fields["impulse_scale"] = jnp.tile(jnp.asarray(impulse), (NUM_DRAWS, 1, 1))
    return make_posterior(spec, params, params, noise_scale=noise, **fields)


def two_delays(delays, gain):
    """A box of 10 kg/m² that a known force acts on, and commands after one of two."""
    params = draws_like(empty_params(1, density=10.0), NUM_DRAWS)
    actuator = Actuator(
        gain=jnp.full((NUM_DRAWS, 1), gain),
        bias=jnp.tile(jnp.array([0.7, -0.2, 0.1]), (NUM_DRAWS, 1, 1)),
        delay=jnp.repeat(jnp.asarray(delays), NUM_DRAWS // 2)[:, None],
    )
    params = eqx.tree_at(
        lambda p: p.actuator, params, actuator, is_leaf=lambda leaf: leaf is None
    )
    return make_posterior(table_spec(), params, params, noise_scale=(NOISE,) * 4)


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


def told(posterior, candidates, *, seed=0, **options):
    """What candidates tell from the scene's own start on, by all draws."""
    state = posterior.spec.initial_state()
    options = {"num_draws": NUM_DRAWS} | options
    return informative_wrench(
        jax.random.key(seed), posterior, state, candidates, **options
    )


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
    found = told(posterior, jnp.asarray(candidates))
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
    found = told(posterior, candidates, num_steps=3, seed=1)
    assert found.best == 1
    np.testing.assert_array_equal(found.wrench, candidates[1])
    # All that there is to learn; one draw of the prior counts beside the other 999.
    np.testing.assert_allclose(found.gain, [0.0, np.log(2.0)], atol=0.01)
    np.testing.assert_allclose(found.structure_gain, found.gain, atol=3e-3)


PUSHES = np.array([[[10.0, 0, 0]], [[0, 0, 1.0]], [[0, 0, 0]]])


def structure_gain(posterior, num_draws):
    at_rest = State(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    told = informative_wrench(
        jax.random.key(1),
        posterior,
        at_rest,
        PUSHES,
        num_steps=10,
        num_draws=num_draws,
    )
    return np.asarray(told.structure_gain)


def boxes(spread, *, seed=0, noise=(1e-3, 1e-3, 5e-3, 5e-3), spec=None, **slots):
    """Boxes of unknown mass, the logs of their densities normal."""
    rng = np.random.default_rng(seed)
    num = 2 * NUM_DRAWS
    spec = table_spec() if spec is None else spec
    counts = {f"num_{kind}": spec.unknown.get(kind, 0) for kind in spec.unknown}
    density = jnp.asarray(20.0 * np.exp(spread * rng.normal(size=(num, 1))))
    slots = {name: np.asarray(make(rng, num)) for name, make in slots.items()}
    params = draws_like(empty_params(1, **counts), num, density=density, **slots)
    return make_posterior(spec, params, params, noise_scale=noise)


@pytest.mark.parametrize("num_draws", [pytest.param(64, marks=pytest.mark.slow), 256])
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_what_no_push_can_tell_is_not_told(num_draws, scale):
    """A wheel that brakes nothing, however well readings tell draws from each other."""
    posterior = boxes(
        0.3,
        noise=tuple(scale * np.array([1e-3, 1e-3, 5e-3, 5e-3])),
        wheel_active=lambda _, num: (np.arange(num) % 4 == 0)[:, None, None],
        wheel_viscous=lambda *_: 0.0,
        wheel_dry=lambda *_: np.inf,
    )
    np.testing.assert_allclose(structure_gain(posterior, num_draws), 0.0, atol=0.03)


def pins(_, num):
    """Where they are on the box, and in the world, since it lies at the origin."""
    rng = np.random.default_rng(1)
    return np.array([0.25, 0.1]) + 0.03 * rng.normal(size=(num, 1, 2))


def test_which_slot_a_pin_is_in_is_no_structure():
    spec = scene_spec_from_dict(table_spec().to_dict() | {"unknown": {"revolute": 2}})
    posterior = boxes(
        0.1,
        spec=spec,
        revolute_active=lambda _, num: np.arange(num)[:, None] % 2 == [0, 1],
        revolute_anchor_a=pins,
        revolute_anchor_b=pins,
        revolute_dry=lambda *_: np.inf,
    )
    assert list(posterior.structure_probabilities()) == ["pin"]
    np.testing.assert_allclose(structure_gain(posterior, 128), 0.0, atol=1e-6)


def test_a_push_tells_whether_a_box_of_unknown_mass_is_pinned():
    """All of log 2, of which an estimate from few draws keeps most.

    With exact masses 256 draws keep 0.68, and more draws more of it.
    """
    posterior = boxes(
        0.3,
        revolute_active=lambda _, num: np.arange(num)[:, None] % 2 == 0,
        revolute_anchor_a=pins,
        revolute_anchor_b=pins,
        revolute_dry=lambda *_: np.inf,
    )
    gain = structure_gain(posterior, 256)
    assert np.all((gain[:2] > 0.58) & (gain[:2] <= np.log(2) + 1e-6))
    assert gain[2] == pytest.approx(0.0, abs=0.03)


def test_a_push_that_impulses_drown_tells_nothing():
    noise, impulse, num_steps = (1e-3, 1e-3, 0.05, 1e-3), (0.01, 0.5), 5
    posterior = two_boxes(noise=noise, impulse=impulse)
    wrenches = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.3]])
    found = told(posterior, wrenches[:, None], num_steps=num_steps)
    # A free box is linear: a kick changes the twist at once, whatever the mass.
    move, kick = transition_matrix(), np.array(impulse)[[0, 0, 1]]
    covariance, gap = np.zeros((6, 6)), np.zeros((3, 6))
    for _ in range(num_steps):
        covariance[3:, 3:] += np.diag(kick**2)
        covariance = move @ covariance @ move.T
        push = response(10.0 * AREA) - response(20.0 * AREA)
        gap = gap @ move.T + wrenches @ push.T
    covariance += np.diag(np.array(noise)[[0, 0, 1, 2, 2, 3]] ** 2)
    square = np.sum(gap * np.linalg.solve(covariance, gap.T).T, axis=1)
    expected = np.array([mutual_information(d) for d in np.sqrt(square)])
    assert expected[1] > 0.1 > 0.01 > expected[2]
    assert found.best == 1
    gaps = np.abs(np.asarray(found.gain) - expected)
    assert np.all(gaps < 4.0 * np.asarray(found.error) + 0.01)


@pytest.mark.slow
def test_noise_of_the_motion_of_a_pinned_table_is_that_of_many_motions():
    posterior = table_posterior(2)
    scene, state = posterior.spec.scene, State(jnp.zeros((1, 3)), jnp.zeros((1, 3)))
    params = jax.tree.map(lambda leaf: leaf[:1], posterior.params)
    wrench, impulse = jnp.array([[3.0, 5.0, 1.0]]), jnp.array([[0.02, 0.04]])
    noise, share = posterior.noise_scale[:1], jnp.ones((4, 1, 3))
    law = law_after(
        scene, params, noise, impulse[None], state, wrench, share, bodies=(0,)
    )
    one = jax.tree.map(lambda leaf: leaf[0], params)

    def moved(key):
        def advance(state, key):
            state = add_impulse(key, state, impulse, scene.is_static)
            return step(scene, one, state, wrench)[0], None

        return jax.lax.scan(advance, state, jax.random.split(key, 4))[0].array[0]

    states = jax.jit(jax.vmap(moved))(jax.random.split(jax.random.key(0), 20_000))
    covariance = np.cov(np.asarray(states).T)
    sd = np.sqrt(np.diag(covariance))
    assert np.all(sd > 5e-5)
    drift = np.asarray(law.mean[0]) - np.mean(states, axis=0)
    assert np.all(np.abs(drift) < 0.05 * sd)
    error = (np.asarray(law.covariance[0]) - covariance) / np.outer(sd, sd)
    assert np.abs(error).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("impulse", [None, (2.0 * NOISE, 0.0)])
def test_readings_with_outliers_tell_as_much_as_theory_says(impulse):
    posterior = two_boxes(
        noise=(1e3, 1e3, NOISE, 1e3),
        impulse=impulse,
        diagnostics={"ok": True, "reasons": [], "degrees_of_freedom": 4.0},
    )
    force = 0.6
    found = told(posterior, np.array([[[force, 0.0, 0.0]]]))
    # In units of the noise; of a velocity, since nothing else is read well.
    width = 0.005
    y = width * np.arange(-40_000, 40_001)
    density = stats.t.pdf(y, 4.0)
    if impulse is not None:
        near = width * np.arange(-4000, 4001)
        blur = width * stats.norm.pdf(near, scale=impulse[0] / NOISE)
        density = signal.fftconvolve(density, blur, mode="same")
    gap = force * DT * (1.0 / (10.0 * AREA) - 1.0 / (20.0 * AREA)) / NOISE
    shifted = np.interp(y - gap, y, density)
    expected = np.log(2.0) - width * np.sum(density * np.log1p(shifted / density))
    assert expected > 0.05
    error = 4.0 * float(found.error[0]) + 0.005
    assert float(found.gain[0]) == pytest.approx(expected, abs=error)


@pytest.mark.slow
def test_commands_take_effect_late_and_tell_of_the_delay():
    delays, gain, num_steps = np.array([0.02, 0.06]), 2.0, 5
    posterior = two_delays(delays, gain)
    force = np.array([0.0, 0.02, 5.0])
    candidates = np.zeros((3, 1, 3))
    candidates[:, 0, 0] = force
    found = told(posterior, candidates, num_steps=num_steps)
    acting = num_steps * DT - delays
    per_force = gain * np.array([np.diff(0.5 * acting**2), np.diff(acting)])
    distance = force * np.hypot(*per_force[:, 0]) / (10.0 * AREA * NOISE)
    expected = [mutual_information(d) for d in distance]
    assert 0.02 < expected[1] < 0.5 < expected[2]
    assert found.best == 2
    gaps = np.abs(np.asarray(found.gain) - expected)
    assert np.all(gaps < 4.0 * np.asarray(found.error) + 0.01)


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
