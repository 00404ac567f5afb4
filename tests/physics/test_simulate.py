"""Simulated noise has the spread it was given, and none is none."""

import json
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from boomdp_jax.cli.main import main
from boomdp_jax.core.history_file import load_transitions
from boomdp_jax.physics import rollout, scene_spec_from_dict
from boomdp_jax.physics.simulate import SimulationNoise, simulate
from tests.physics.scenes import make_params, make_scene, make_state
from tests.reference.planar_dynamics import Pin, World

FALSE_ALARM = 1e-6
"""Chance that one comparison fails although all is right."""
ZERO = SimulationNoise(process=jnp.zeros(3), observation=jnp.zeros(4))
OBSERVATION = np.array([0.02, 0.05, 0.1, 0.3])
PER_CHANNEL = OBSERVATION[[0, 0, 1, 2, 2, 3]]
PAIR = World(
    [(0.3, 0.1), (0.2, 0.05)],
    [20.0, 30.0],
    gravity=(0.3, -9.81),
    pins=[Pin(0, (0.3, 0.0), (-0.4, 0.0), b=1)],
)
PAIR_START = make_state([[0.3, 0.0, 0.0], [1.0, 0.0, 0.0]])
PUSH = jnp.tile(jnp.asarray([[1.0, 0.5, 0.1], [0.0, -1.0, 0.2]]), (20, 1, 1))
LONE = World(
    [(0.3, 0.1)],
    [20.0],
    gravity=(0.3, -9.81),
    pins=[Pin(0, (-0.3, 0.0), (0.0, 0.0), viscous=0.1)],
)
LONE_START = make_state([[0.3, 0.0, 0.0]])
RUN, ROLLOUT = jax.jit(simulate), jax.jit(rollout)


def free_spec():
    """Two boxes that nothing holds, and a wall that they never come near."""

    def box(name, x, **fields):
        shape = {"type": "box", "half_extents": [0.3, 0.2]}
        return {"name": name, "pose": [x, 0, 0], "shape": shape, **fields}

    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [
                box("one", -1e5, density=10.0),
                box("wall", 0, static=True),
                box("two", 1e5, density=20.0, twist=[0.5, -0.3, 1.0]),
            ],
        }
    )


def assert_has_scale(draws: np.ndarray, scale: float) -> None:
    """Independent normals of mean zero have this standard deviation.

    Both bounds are exact quantiles: of the chi-square law of the sum of squares and of
    the normal law of the mean.
    """
    draws = np.ravel(draws) / scale
    square = np.sum(draws**2)
    low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], draws.size)
    assert low < square < high
    limit = -stats.norm.ppf(FALSE_ALARM / 2) / np.sqrt(draws.size)
    assert abs(np.mean(draws)) < limit


@pytest.mark.slow
def test_without_noise_it_is_rollout():
    scene, params = make_scene(PAIR), make_params(PAIR)
    expected, expected_info = ROLLOUT(scene, params, PAIR_START, PUSH)
    states, observations, info = RUN(
        jax.random.key(0), scene, params, PAIR_START, PUSH, ZERO
    )
    for found in (states, observations):
        np.testing.assert_allclose(found.array, expected.array, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(
        info.constraint_error, expected_info.constraint_error, atol=1e-12
    )
    assert np.all(info.is_finite)


@pytest.mark.slow
@pytest.mark.parametrize(
    "dt", [0.01, jnp.linspace(0.01, 0.03, 20)], ids=["one", "each"]
)
def test_other_steps_than_the_scenes_are_those_of_rollout(dt):
    scene, params, push = make_scene(LONE), make_params(LONE), PUSH[:, :1]
    expected, _ = ROLLOUT(scene, params, LONE_START, push, dt=dt)
    states, _, _ = RUN(jax.random.key(0), scene, params, LONE_START, push, ZERO, dt=dt)
    np.testing.assert_allclose(states.array, expected.array, rtol=1e-9, atol=1e-11)


@pytest.mark.slow
def test_a_lone_body_without_noise_does_as_rollout_does(precision):
    scene, params = make_scene(LONE), make_params(LONE)
    start, push = make_state([[0.3, 0.0, 0.0]]), jnp.asarray(PUSH[:, :1], float)
    quiet = SimulationNoise(process=jnp.zeros(3), observation=jnp.zeros(4))
    expected, _ = ROLLOUT(scene, params, start, push)
    states, _, _ = RUN(jax.random.key(0), scene, params, start, push, quiet)
    tolerance = precision.choose(single=1e-5, double=1e-11)
    np.testing.assert_allclose(states.array, expected.array, atol=tolerance)


@pytest.mark.slow
def test_contacts_without_noise_are_those_of_rollout_and_shaken_ones_hold():
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.01,
            "gravity": [0, -9.81],
            "bodies": [
                {
                    "name": "box",
                    "pose": [0, 0.11, 0],
                    "twist": [0.5, 0, 0],
                    "shape": {"type": "box", "half_extents": [0.2, 0.1]},
                    "density": 10.0,
                    "contact": {"friction": 0.4, "restitution": 0.0},
                },
                {
                    "name": "floor",
                    "pose": [0, -1, 0],
                    "shape": {"type": "box", "half_extents": [9, 1]},
                    "contact": {"friction": 0.4, "restitution": 0.0},
                    "static": True,
                },
            ],
        }
    )
    rest = (spec.scene, spec.params(), spec.initial_state(), jnp.zeros((60, 2, 3)))
    expected, expected_info = ROLLOUT(*rest)
    states, _, info = RUN(jax.random.key(0), *rest, ZERO)
    np.testing.assert_allclose(states.array, expected.array, rtol=1e-8, atol=1e-9)
    assert jax.tree.structure(info) == jax.tree.structure(expected_info)
    noise = SimulationNoise(
        process=jnp.array([0.01, 0.01, 0.05]), observation=jnp.zeros(4)
    )
    shaken, _, _ = RUN(jax.random.key(9), *rest, noise)
    assert np.max(np.abs(shaken.array - states.array)) > 1e-3
    assert np.min(shaken.pose[:, 0, 1]) > 0.095, "it sank into the floor"


@pytest.mark.slow
def test_readings_err_by_what_was_asked_and_the_motion_does_not():
    spec = free_spec()
    noise = SimulationNoise(process=jnp.zeros(3), observation=jnp.asarray(OBSERVATION))
    wrenches = jnp.zeros((2000, 3, 3))
    states, observations, _ = RUN(
        jax.random.key(1),
        spec.scene,
        spec.params(),
        spec.initial_state(),
        wrenches,
        noise,
    )
    quiet, _ = rollout(spec.scene, spec.params(), spec.initial_state(), wrenches)
    np.testing.assert_allclose(states.array, quiet.array, rtol=1e-9, atol=1e-11)
    errors = np.asarray(observations.array - states.array)
    np.testing.assert_array_equal(errors[:, 1], 0.0)
    for channel, scale in enumerate(PER_CHANNEL):
        for body in (0, 2):
            assert_has_scale(errors[:, body, channel], scale)
    moving = errors[:, [0, 2]].reshape(2000, 12)
    # Between normals, Fisher's z of a correlation is normal of variance 1 / (n - 3).
    limit = -stats.norm.ppf(FALSE_ALARM / 2 / 66) / np.sqrt(2000 - 3)
    correlation = np.corrcoef(moving.T)[np.triu_indices(12, 1)]
    assert np.max(np.abs(np.arctanh(correlation))) < limit


@pytest.mark.parametrize("is_per_body", [False, True], ids=["shared", "per body"])
def test_twists_are_shaken_by_what_was_asked(is_per_body):
    spec = free_spec()
    scales = np.tile([0.1, 0.2, 0.3], (3, 1))
    if is_per_body:
        scales[2] = [0.5, 0.0, 0.05]
    noise = SimulationNoise(
        process=jnp.asarray(scales if is_per_body else scales[0]),
        observation=jnp.zeros(4),
    )
    start = spec.initial_state()
    states, observations, _ = RUN(
        jax.random.key(2),
        spec.scene,
        spec.params(),
        start,
        jnp.zeros((2000, 3, 3)),
        noise,
    )
    np.testing.assert_array_equal(observations.array, states.array)
    twists = np.concatenate([start.twist[None], states.twist])
    np.testing.assert_array_equal(twists[:, 1], 0.0)
    np.testing.assert_array_equal(states.pose[:, 1], np.zeros((2000, 3)))
    # Nothing holds the boxes: what changes a twist is the shake alone.
    shakes = np.diff(twists, axis=0)
    for body in (0, 2):
        for axis in range(3):
            if scales[body, axis] > 0:
                assert_has_scale(shakes[:, body, axis], scales[body, axis])
            else:
                np.testing.assert_allclose(shakes[:, body, axis], 0.0, atol=1e-12)


@pytest.mark.slow
def test_shaken_joints_hold():
    scene, params = make_scene(PAIR), make_params(PAIR)
    noise = SimulationNoise(
        process=jnp.array([0.2, 0.2, 1.0]), observation=jnp.zeros(4)
    )
    states, _, info = RUN(jax.random.key(3), scene, params, PAIR_START, PUSH, noise)
    quiet, _ = ROLLOUT(scene, params, PAIR_START, PUSH)
    assert np.max(np.abs(states.twist - quiet.twist)) > 0.1
    assert np.max(info.constraint_error) < 1e-4
    assert np.all(info.is_finite)


def test_the_same_key_gives_the_same_bits_and_another_one_others():
    spec = free_spec()
    noise = SimulationNoise(process=jnp.full(3, 0.1), observation=jnp.full(4, 0.1))
    run = jax.jit(
        partial(
            simulate,
            scene=spec.scene,
            params=spec.params(),
            state=spec.initial_state(),
            wrenches=jnp.zeros((5, 3, 3)),
            noise=noise,
        )
    )
    first, again, other = (run(jax.random.key(seed))[:2] for seed in (4, 4, 5))
    assert jax.tree.all(jax.tree.map(np.array_equal, first, again))
    assert not np.any(first[0].twist[:, 0] == other[0].twist[:, 0])
    # Shakes and readings are drawn apart: errors are not the shakes over again.
    errors = np.asarray(first[1].twist - first[0].twist)[:, 0]
    shakes = np.diff(np.asarray(first[0].twist)[:, 0], axis=0, prepend=0.0)
    assert not np.any(np.isclose(errors, shakes))


def test_many_runs_are_one_batch():
    noise = SimulationNoise(process=jnp.full(3, 0.1), observation=jnp.full(4, 0.1))
    keys = jax.random.split(jax.random.key(6), 3)
    rest = (make_scene(LONE), make_params(LONE), LONE_START, PUSH[:, :1], noise)
    together = jax.jit(jax.vmap(simulate, in_axes=(0, *(None,) * 5)))(keys, *rest)
    alone = RUN(keys[2], *rest)
    for many, one in zip(
        jax.tree.leaves(together), jax.tree.leaves(alone), strict=True
    ):
        np.testing.assert_allclose(many[2], one, atol=1e-10)


@pytest.mark.slow
def test_gradients_by_scale_and_density_are_those_of_finite_differences():
    scene, params = make_scene(LONE), make_params(LONE)

    @jax.jit
    def end(scale, density):
        noise = SimulationNoise(
            process=scale * jnp.array([0.2, 0.2, 1.0]), observation=jnp.full(4, scale)
        )
        known = eqx.tree_at(lambda p: p.density, params, density[None])
        _, observations, _ = simulate(
            jax.random.key(7), scene, known, LONE_START, PUSH[:5, :1], noise
        )
        return jnp.sum(jnp.sin(observations.array))

    at = (jnp.asarray(0.3), jnp.asarray(20.0))
    slopes = jax.jit(jax.grad(end, argnums=(0, 1)))(*at)
    step = 1e-5
    for argument, slope in enumerate(slopes):
        ahead, behind = (
            [x + sign * step * (i == argument) for i, x in enumerate(at)]
            for sign in (1, -1)
        )
        expected = (end(*ahead) - end(*behind)) / (2 * step)
        np.testing.assert_allclose(slope, expected, rtol=1e-4)
        assert abs(float(slope)) > 1e-4


@pytest.mark.slow
def test_readings_are_those_of_the_command_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = free_spec()
    (tmp_path / "scene.json").write_text(json.dumps(spec.to_dict()))
    action = np.zeros((10, 3, 3))
    action[:, 0] = [3.0, -2.0, 0.4]
    np.savez("a.npz", action=action)
    scales = " ".join(map(str, OBSERVATION))
    command = (
        f"simulate scene.json --actions a.npz --out o.npz --noise {scales} --seed 8"
    )
    assert main(command.split()) == 0
    noise = SimulationNoise(process=jnp.zeros(3), observation=jnp.asarray(OBSERVATION))
    _, observations, _ = simulate(
        jax.random.key(8),
        spec.scene,
        spec.params(),
        spec.initial_state(),
        jnp.asarray(action),
        noise,
    )
    np.testing.assert_allclose(
        observations.array, load_transitions("o.npz").next_state, rtol=1e-9, atol=1e-11
    )


def test_process_noise_for_another_number_of_bodies_is_refused():
    spec = free_spec()
    noise = SimulationNoise(process=jnp.zeros((2, 3)), observation=jnp.zeros(4))
    with pytest.raises(ValueError, match=r"has shape \(2, 3\); give one row of 3 for"):
        simulate(
            jax.random.key(0),
            spec.scene,
            spec.params(),
            spec.initial_state(),
            jnp.zeros((5, 3, 3)),
            noise,
        )
