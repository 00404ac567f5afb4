"""Fisher information against the joint normal density, and what cannot be seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.fits.fit import FitSettings
from boomdp_jax.inference.pushes.identifiability import identifiability
from boomdp_jax.physics import rollout
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.joint_normal import joint_normal
from tests.inference.recordings import DT, MASS, NOISE, SIZE, box_scene, free_box

QUICK = FitSettings(num_draws=16, num_starts=2, num_iterations=6)
# Prior sd of a density's logarithm.
SPREAD = 1.5


@pytest.mark.slow
def test_information_about_a_mass_is_that_of_the_joint_density():
    history = free_box(np.random.default_rng(3), 40)
    (found,) = identifiability(jax.random.key(0), box_scene(), history, settings=QUICK)
    assert found.names == ("box.density",)
    joint = joint_normal(history)
    noise = np.concatenate([found.reading_noise[0], found.impulse_noise[0]])
    variance = noise[joint.latent] ** 2
    slope = np.asarray(joint.slope)
    covariance = slope * variance @ slope.T + np.diag(noise[joint.group] ** 2)
    # Of the logarithm of the mass, by which the mean falls.
    change = SPREAD * np.asarray(joint.response) / MASS
    expected = change @ np.linalg.solve(covariance, change)
    # Forty readings tell the noise, which the weights follow, to a tenth or so.
    np.testing.assert_allclose(found.information[0, 0], expected, rtol=0.2)
    np.testing.assert_allclose(found.contraction[0], 1.0, atol=1e-3)
    assert not found.insensitive


def at_rest(num_rows: int):
    """A box that nobody pushes."""
    rng = np.random.default_rng(0)
    reading = NOISE * rng.normal(size=(num_rows + 1, 1, 6))
    action = np.zeros((num_rows, 1, 3))
    return make_history(reading[:-1], action, reading[1:], DT)


@pytest.mark.slow
def test_nothing_is_told_of_the_mass_of_a_box_at_rest():
    (found,) = identifiability(
        jax.random.key(0), box_scene(), at_rest(12), settings=QUICK
    )
    assert found.insensitive == ("box.density",)
    assert found.contraction[0] < 0.05
    assert found.unseen == [{"box.density": pytest.approx(1.0)}]


def pendulum(constraints: list[dict], **body):
    """A box that gravity pulls at."""
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, -9.81],
            "dt": DT,
            "bodies": [
                {
                    "name": "box",
                    "shape": {"type": "box", "half_extents": SIZE},
                    "pose": [0.0, 0.0, 0.3],
                    **body,
                }
            ],
            "constraints": constraints,
            "unknown": {"revolute": 1},
        },
        source="test",
    )


@pytest.mark.slow
def test_a_swing_tells_where_the_pin_is_and_nothing_of_the_mass():
    """Gravity and friction are in proportion to it: it drops out."""
    place = np.array([0.2, 0.1])
    cos, sin = np.cos(0.3), np.sin(0.3)
    turned = [cos * 0.2 - sin * 0.1, sin * 0.2 + cos * 0.1]
    pin = {"type": "revolute", "a": "box", "b": "world", "anchor_b": turned}
    truth = pendulum([{**pin, "anchor_a": place.tolist()}], density=12.0)
    num_rows = 30
    wrench = jnp.zeros((num_rows, 1, 3))
    start = truth.initial_state()
    states, _ = rollout(truth.scene, truth.params(), start, wrench)
    path = np.concatenate([np.asarray(start.array)[None], np.asarray(states.array)])
    path = path + NOISE * np.random.default_rng(1).normal(size=path.shape)
    history = make_history(path[:-1], wrench, path[1:], DT)
    (found,) = identifiability(
        jax.random.key(0), pendulum([]), history, {"box": ["revolute"]}, settings=QUICK
    )
    contraction = dict(zip(found.names, found.contraction, strict=True))
    # That there is next to no friction may go for viscous or for dry friction, of which
    # the other then tells nothing.
    frictions = {"box.revolute.viscous_rate", "box.revolute.dry_share"}
    assert set(found.insensitive) - frictions <= {"box.density"}
    assert max(contraction[name] for name in frictions) > 0.3
    assert abs(contraction["box.density"]) < 0.05
    anchors = [value for name, value in contraction.items() if "anchor" in name]
    assert len(anchors) == 2
    assert min(anchors) > 0.99
    # Where it is in the world follows from that, up to what a camera resolves.
    offsets = [value for name, value in contraction.items() if "offset" in name]
    assert len(offsets) == 2
    assert min(offsets) > 0.9


def test_a_history_without_transitions_is_refused():
    with pytest.raises(ValueError, match="at least one transition"):
        identifiability(jax.random.key(0), box_scene(), at_rest(0))
