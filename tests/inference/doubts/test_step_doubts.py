"""Steps that are too long for the motion that they are to explain: what is said."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.doubts.residual import ResidualCheck, check_residuals
from boomdp_jax.inference.doubts.step_doubts import StepError, step_reason
from boomdp_jax.inference.infer import infer
from boomdp_jax.inference.likelihoods.filtered_likelihood import FilteredLikelihood
from boomdp_jax.inference.online.belief import OnlineBelief
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.physics import scene_spec_from_dict, state_from_array, step
from boomdp_jax.physics.scene_spec import SceneSpec

DT, ROWS, MASS = 0.05, 60, 3.0
NOISE = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
NAMES = ["box"]


def box(*, has_density: bool = True, has_pin: bool = True) -> SceneSpec:
    """A box on a pin, or one of which some of that is to be inferred."""
    body = {
        "name": "box",
        "shape": {"type": "box", "half_extents": [0.3, 0.2]},
        "pose": [0, 0, 0],
        **({"density": MASS / 0.24} if has_density else {}),
    }
    anchors = {"anchor_a": [0.2, 0.1], "anchor_b": [0.2, 0.1]}
    pin = {"type": "revolute", "a": "box", "b": "world", **anchors}
    content = {
        "schema": "planar-scene-1",
        "dt": DT,
        "bodies": [body],
        **({"constraints": [pin]} if has_pin else {"unknown": {"revolute": 1}}),
    }
    return scene_spec_from_dict(content, source="test")


def turning(speed: float, *, num_substeps: int = 64) -> History:
    """Noisy readings of the box under smooth pushes; at 1 it turns by 4 to 7 rad/s.

    Args:
        speed: of all motion, with pushes that it takes.
        num_substeps: in which the truth takes a row.
    """
    spec = box()
    scene = dataclasses.replace(spec.scene, num_substeps=num_substeps)
    params, rng = spec.params(), np.random.default_rng(0)
    time = speed * DT * np.arange(ROWS)
    rates, phases = rng.uniform(1, 4, (3, 3)), rng.uniform(0, 2 * np.pi, (3, 3))
    action = np.sin(time[:, None, None] * rates + phases).sum(axis=-1)
    action = speed**2 * action * np.array([8.0, 8.0, 1.5])
    action[:, 2] += speed**2 * 0.6 * np.sign(np.sin(2 * np.pi * time / 6.0))

    def advance(state, wrench):
        after, _ = step(scene, params, state_from_array(state), wrench)
        return after.array, after.array

    rest = jnp.zeros((1, 6))
    _, states = jax.lax.scan(advance, rest, jnp.asarray(action[:, None]))
    states = np.concatenate([np.zeros((1, 1, 6)), np.asarray(states)])
    states = states + NOISE * rng.standard_normal(states.shape)
    return make_history(states[:-1], action[:, None], states[1:], DT)


def check(history: History, *, num_substeps: int = 2) -> ResidualCheck:
    """At the truth, its pin known, the mass alone inferred."""
    spec = box(has_density=False)
    block = make_block(spec, (0,), history)
    likelihood = block.target.log_likelihood
    assert isinstance(likelihood, FilteredLikelihood)
    coordinates = likelihood.coordinates
    scene = dataclasses.replace(coordinates.scene, num_substeps=num_substeps)
    coordinates = dataclasses.replace(coordinates, scene=scene)
    likelihood = dataclasses.replace(likelihood, coordinates=coordinates)
    target = dataclasses.replace(block.target, log_likelihood=likelihood)
    targets = stack_blocks([block._replace(target=target)])
    z = np.zeros(block.layout.dim)
    active = block.target.structures[0]
    moved = np.eye(len(z))[0]
    density = [
        float(np.log(coordinates(jnp.asarray(each), active).density[0]))
        for each in (z, moved)
    ]
    z[0] = (np.log(MASS / 0.24) - density[0]) / (density[1] - density[0])
    draws = BlockDraws(
        structure=np.zeros((1, 2), int),
        z=np.tile(z, (1, 2, 1)),
        log_density=np.zeros((1, 2)),
        noise_scale=np.tile(NOISE[[0, 2, 3, 5]], (1, 2, 1, 1)),
        impulse_scale=np.full((1, 2, 1, 2), 1e-3),
        log_evidence=np.zeros(1),
        evidence=None,
        diagnostics=[],
        chain_index=np.zeros(1, int),
    )
    (found,) = check_residuals(targets, draws)
    return found


def reason_of(found: ResidualCheck) -> str | None:
    assert found.step is not None
    numbers = [f"number {place}" for place in range(len(found.step.shift))]
    return step_reason(found.step, NAMES, numbers)


@pytest.fixture(scope="module")
def fast() -> History:
    """It turns fast, and its truth is fine."""
    return turning(1.5)


def test_coarse_steps_of_a_fast_pinned_box_are_doubted(fast):
    found = check(fast)
    assert found.step is not None
    assert found.step.num_parts == 2
    assert found.step.length == pytest.approx(DT)
    # It is the mass that would be another in finer steps.
    assert np.argmax(np.abs(found.step.shift)) == 0
    assert 1.5 < np.abs(found.step.shift[0]) < 8.0
    reason = reason_of(found)
    assert reason is not None
    assert reason.startswith("box: steps of 0.05 s in 2 parts are too long")
    assert "number 0 would move by" in reason
    assert reason.endswith('or give "substeps": 8 in the scene')


def test_with_enough_parts_there_is_no_doubt(fast):
    found = check(fast, num_substeps=16)
    assert found.step is not None
    assert found.step.num_parts == 16
    assert np.max(np.abs(found.step.shift)) < 0.3
    assert reason_of(found) is None


def test_slow_motion_is_not_doubted():
    found = check(turning(0.2))
    assert found.step is not None
    assert np.max(np.abs(found.step.shift)) < 0.3
    assert reason_of(found) is None


def test_a_world_that_steps_as_the_model_does_is_not_doubted():
    """As where an agent acts in the engine itself: readings tell that it is so."""
    found = check(turning(1.5, num_substeps=2))
    assert found.step is not None
    assert np.max(np.abs(found.step.shift)) > 1.0
    assert found.step.gain < -5.0
    assert reason_of(found) is None


def test_nothing_is_said_of_what_moves_little():
    few = StepError(2, DT, np.array([0.9, -0.9]), np.zeros((1, 4)), 0.0)
    assert step_reason(few, NAMES, ["a", "b"]) is None
    reason = step_reason(few._replace(shift=np.array([0.9, -1.1])), NAMES, ["a", "b"])
    assert reason is not None
    assert "b would move by 1.1 posterior sds" in reason


@pytest.mark.slow
def test_an_online_belief_of_a_fast_box_is_doubted(fast):
    """Its steps are not cut by turns; those of `infer` are, and move less."""
    spec = box(has_pin=False, has_density=False)
    online = OnlineBelief(spec, capacity=64, num_particles=512)
    belief = online.init(jax.random.key(0), fast)
    posteriors = online.posterior(belief), infer(jax.random.key(0), spec, fast)
    shifts = [each.diagnostics["residual"][0]["step_shift"] for each in posteriors]
    assert shifts[0] > 2.0 * shifts[1]
    assert not posteriors[0].diagnostics["ok"]
    assert any("are too long" in line for line in posteriors[0].diagnostics["reasons"])
