"""Pins and rods from where the bodies were seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from boomdp_jax.core import make_history
from boomdp_jax.inference.hypotheses.layout import SlotKey
from boomdp_jax.inference.hypotheses.meeting import (
    anchor_scale,
    meeting_frame,
    met_at,
    rod_length,
)
from boomdp_jax.inference.infer import infer_batch
from boomdp_jax.physics import scene_spec_from_dict, step
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.state import state_from_array
from tests.inference.joint_recordings import turned

NOBODY = np.zeros((2, 3))
PLACE, ANCHOR = np.array([0.4, -0.3]), np.array([0.2, 0.1])


def slot(kind, partner=WORLD):
    return SlotKey(kind, 0, partner, 0, 0, -1)


def pinned_poses(angles, partner):
    """Body 0 turns about a point that is fixed in body 1."""
    poses = np.zeros((len(angles), 2, 3))
    poses[:, 1] = partner
    poses[:, 0, 2] = angles
    for pose in poses:
        pin = pose[1, :2] + turned(pose[1, 2], PLACE)
        pose[0, :2] = pin - turned(pose[0, 2], ANCHOR)
    return poses


def frame_of(kind, partner, poses):
    return jnp.asarray(meeting_frame(slot(kind, partner), poses, NOBODY))


@pytest.mark.parametrize("partner", [WORLD, 1])
def test_a_pin_is_where_all_readings_have_it(partner):
    angles = np.linspace(-1.0, 2.5, 7)
    still = partner == WORLD
    base = np.zeros(3) if still else np.random.default_rng(0).normal(size=(7, 3))
    poses = pinned_poses(angles, base)
    # A reading that lacks the angle tells nothing.
    poses[3, 0, 2] = np.nan
    frame = frame_of("revolute", partner, poses)
    np.testing.assert_allclose(met_at(frame, jnp.asarray(ANCHOR)), PLACE, atol=1e-6)


def test_a_rod_is_as_long_as_its_anchors_were_apart_at_first():
    poses = pinned_poses(np.array([0.7, 2.0]), np.array([1.0, 2.0, 0.5]))
    end = np.array([0.3, 0.4])
    frame = frame_of("distance", 1, poses)
    length = rod_length(frame, jnp.asarray(ANCHOR), jnp.asarray(end), jnp.asarray(0.3))
    assert float(length) == pytest.approx(np.hypot(*(PLACE - end)), abs=1e-5)


def test_without_readings_bodies_are_where_the_scene_has_them():
    default = pinned_poses(np.array([0.7]), np.array([1.0, 2.0, 0.5]))[0]
    nothing = np.full((3, 2, 3), np.nan)
    frame = jnp.asarray(meeting_frame(slot("revolute", 1), nothing, default))
    np.testing.assert_allclose(met_at(frame, jnp.asarray(ANCHOR)), PLACE, atol=1e-6)


def test_the_anchor_of_a_tie_is_near_both_bodies():
    """The product of a normal density about each, by quadrature on a grid."""
    poses = pinned_poses(np.array([0.9]), np.array([0.2, -0.5, 0.4]))
    frame = frame_of("revolute", 1, poses)
    reach = np.array([0.5, 0.2])
    mean, unit = anchor_scale(slot("revolute", 1), frame, jnp.asarray(reach))
    line = np.linspace(-2.0, 2.0, 401)
    points = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    x, y, cos, sin = np.asarray(frame, float)
    there = np.array([x, y]) + points @ np.array([[cos, sin], [-sin, cos]])
    square = (points**2).sum(-1) / reach[0] ** 2 + (there**2).sum(-1) / reach[1] ** 2
    density = np.exp(-0.5 * square)

    def integral(values):
        return scipy.integrate.simpson(scipy.integrate.simpson(values, line), line)

    total = integral(density)
    found = [integral(density * points[..., axis]) / total for axis in (0, 1)]
    np.testing.assert_allclose(mean, found, atol=1e-5)
    spread = integral(density * ((points - found) ** 2).sum(-1)) / total
    assert float(unit) == pytest.approx(np.sqrt(spread / 2.0), rel=1e-4)


def short_run(seed):
    """Ten pushes of a box on a pin, by the engine at a twentieth of the step."""
    body = {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}}
    pin = {
        "type": "revolute",
        "a": "box",
        "b": "world",
        "anchor_a": [-0.25, 0.05],
        "anchor_b": [-0.25, 0.05],
    }
    scene = {"schema": "planar-scene-1", "gravity": [0.0, 0.0]}
    truth = scene_spec_from_dict(
        {
            **scene,
            "dt": 0.0025,
            "bodies": [{**body, "density": 30.0}],
            "constraints": [pin],
        }
    )
    unknown = {"revolute": 1, "wheel": 1, "ground": 1}
    spec = scene_spec_from_dict(
        {**scene, "dt": 0.05, "bodies": [body], "unknown": unknown}
    )
    rng = np.random.default_rng(seed)
    params = truth.params()
    move = jax.jit(lambda state, wrench: step(truth.scene, params, state, wrench)[0])
    state = state_from_array(jnp.zeros((1, 6)))
    pushes = rng.normal(size=(10, 1, 3)) * [4.0, 4.0, 0.8]
    path = [np.asarray(state.array)]
    for push in pushes:
        for _ in range(20):
            state = move(state, jnp.asarray(push))
        path.append(np.asarray(state.array))
    noise = 1e-3 * np.array([1.0, 1.0, 1.0, 4.0, 4.0, 4.0])
    path = np.stack(path) + noise * rng.normal(size=(11, 1, 6))
    return spec, make_history(path[:-1], pushes, path[1:], 0.05)


@pytest.mark.slow
def test_a_pin_is_found_in_ten_rows():
    """A prior as wide as the scene made wheels of four of the six, one with 0.98."""
    specs, histories = zip(*map(short_run, range(6)), strict=True)
    found = infer_batch(jax.random.key(0), specs, histories, progress=False)
    shares = [
        posterior.structure_probabilities().get("pin", 0.0) for posterior in found
    ]
    assert min(shares) > 0.5
    assert np.mean(shares) > 0.9
    for posterior in found:
        mass = 0.24 * np.asarray(posterior.params.density[:, 0])
        low, high = np.quantile(mass, [0.005, 0.995])
        assert low < 7.2 < high
