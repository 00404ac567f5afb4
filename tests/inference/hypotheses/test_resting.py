"""Coordinates of drawers and welds, and what a scene may leave open of known ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core import make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.blocks.model_sites import block_sites
from boomdp_jax.inference.fits.fit_starts import Guesses
from boomdp_jax.inference.hypotheses.layout import block_layout
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel, extended_filter
from boomdp_jax.inference.readings.components import independent_blocks
from boomdp_jax.physics import scene_spec_from_dict, step
from boomdp_jax.physics.state import state_from_array
from tests.inference.joint_recordings import (
    AXIS,
    CONSTRAINTS,
    HALF,
    NOISE,
    POSE,
    UNKNOWN,
    joint,
    recorded,
    scene,
    turned,
)

RADIUS = float(np.hypot(*HALF))
ALONG = np.array([np.cos(AXIS), np.sin(AXIS)])
ACROSS = np.array([-ALONG[1], ALONG[0]])


def seen(spec, slides=(-0.3, 0.0, 0.3), turns=0):
    """A history of one row for each place on the drawer's line."""
    state = np.zeros((len(slides), 1, 6))
    state[:, 0, :2] = POSE[:2] + np.outer(slides, ALONG)
    state[:, 0, 2] = POSE[2] + 2.0 * np.pi * turns * np.arange(len(slides))
    return make_block(spec, (0,), make_history(state, state[..., :3], state, 0.05))


def decode(block, z):
    coordinates = block.target.log_likelihood.coordinates
    return coordinates(jnp.asarray(z), jnp.ones(len(block.layout.slots), bool))


def part(block, kind):
    """Coordinates of the block's slot of a kind."""
    slots = block.layout.slots + block.layout.known_slots
    (slot,) = (slot for slot in slots if slot.kind == kind)
    return slice(slot.start, slot.start + {"prismatic": 5, "weld": 3}[kind])


def test_a_drawer_is_its_direction_its_line_and_its_angle():
    block = seen(scene(unknown=UNKNOWN))
    z = np.random.default_rng(0).uniform(-1.0, 1.0, block.layout.dim)
    params = decode(block, z)
    guide = jax.tree.map(np.asarray, params.prismatic)
    mass = float(params.density[0]) * 4.0 * HALF[0] * HALF[1]
    axis = guide.axis[0]
    arm = turned(guide.angle[0], guide.anchor_a[0])
    across = np.array([-np.sin(axis), np.cos(axis)])
    found = [
        axis - AXIS,
        np.arcsinh(across @ (guide.anchor_b[0] - arm - POSE[:2]) / (0.01 * RADIUS)),
        np.arcsinh((guide.angle[0] - POSE[2]) / 0.01),
        np.log(guide.viscous[0] / mass / 0.1) / 2.0,
        np.log(guide.dry[0] / (mass * 9.81) / 0.03) / 2.0,
    ]
    np.testing.assert_allclose(found, z[part(block, "prismatic")], atol=1e-9)


def test_a_weld_is_the_pose_of_its_body():
    block = seen(scene(unknown=UNKNOWN), turns=1)
    z = np.random.default_rng(1).uniform(-1.0, 1.0, block.layout.dim)
    weld = jax.tree.map(np.asarray, decode(block, z).weld)
    place = weld.anchor_b[0] - turned(weld.angle[0], weld.anchor_a[0])
    # Readings that differ by whole turns are of one angle.
    off = [*(place - POSE[:2]) / (0.01 * RADIUS), (weld.angle[0] - POSE[2]) / 0.01]
    np.testing.assert_allclose(np.arcsinh(off), z[part(block, "weld")], atol=1e-9)


@pytest.mark.slow
def test_a_drawer_turned_by_pi_is_the_same_drawer():
    block = seen(scene(unknown=UNKNOWN))
    z = np.random.default_rng(2).uniform(-0.5, 0.5, block.layout.dim)
    z[[s.start for s in block.layout.slots if s.kind == "prismatic"]] = 0.3
    first = part(block, "prismatic").start
    turned_z = z.copy()
    turned_z[first] += np.pi
    turned_z[first + 1] *= -1.0
    active = [s.kind in ("prismatic", "ground") for s in block.layout.slots]
    coordinates = block.target.log_likelihood.coordinates
    state = state_from_array(jnp.asarray([[*POSE, 0.3, -0.2, 0.5]]))
    ends = [
        step(coordinates.scene, params, state, jnp.ones((1, 3)))[0].array
        for params in (
            coordinates(jnp.asarray(each), jnp.asarray(active))
            for each in (z, turned_z)
        )
    ]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)
    assert block.layout.period()[first] == pytest.approx(np.pi)


def test_model_sites_and_coordinates_are_inverses():
    block = seen(scene(unknown=UNKNOWN))
    z = np.random.default_rng(3).uniform(-1.5, 1.5, block.layout.dim)
    sites = {site.name: site for site in block_sites(block, ("box",))}
    for site in sites.values():
        found = site.to_coordinates(site.from_coordinates(jnp.asarray(z)))
        np.testing.assert_allclose(found, z[list(site.coordinates)], atol=1e-6)
    guide = decode(block, z).prismatic
    for name in ("axis", "angle"):
        value = sites[f"box.prismatic.{name}"].from_coordinates(jnp.asarray(z))
        assert float(value) == pytest.approx(float(getattr(guide, name)[0]))
    # Half a turn more is the same direction.
    site = sites["box.prismatic.axis"]
    more = site.from_coordinates(jnp.asarray(z)) + np.pi
    np.testing.assert_allclose(
        site.to_coordinates(more), z[list(site.coordinates)], atol=1e-6
    )


@pytest.mark.parametrize(
    "given",
    [
        {"anchor_a": [None, None], "anchor_b": [0.5, -0.2]},
        {"anchor_a": [0.1, 0.05], "anchor_b": [None, None]},
        {"anchor_a": [0.1, None], "anchor_b": [None, 0.2]},
        {"anchor_a": [None, None], "anchor_b": [None, None]},
    ],
)
def test_numbers_that_a_scene_gives_of_a_drawer_stay_and_the_line_is_one(given):
    known = joint("prismatic", axis=None, angle=None, viscous=None, dry=2.0, **given)
    block = seen(scene(known))
    z = np.random.default_rng(4).uniform(-1.0, 1.0, block.layout.dim)
    guide = jax.tree.map(np.asarray, decode(block, z).prismatic)
    assert float(guide.dry[0]) == 2.0
    for name, numbers in given.items():
        for number, value in zip(numbers, getattr(guide, name)[0], strict=True):
            assert number is None or value == pytest.approx(number)
    if None not in given["anchor_b"] or given["anchor_b"] == [None, None]:
        # Whichever anchor is open, the centre of mass slides on the same line.
        axis = guide.axis[0]
        across = np.array([-np.sin(axis), np.cos(axis)])
        place = guide.anchor_b[0] - turned(guide.angle[0], guide.anchor_a[0])
        offset = across @ (place - POSE[:2]) / (0.01 * RADIUS)
        assert np.arcsinh(offset) == pytest.approx(z[part(block, "prismatic")][1])


def test_a_weld_with_a_null_angle_is_inferred_and_the_rest_is_given():
    known = joint("weld", anchor_a=[0.1, 0.0], anchor_b=[1.0, 2.0], angle=None)
    block = seen(scene(known))
    weld = decode(block, np.full(block.layout.dim, 0.5)).weld
    np.testing.assert_allclose(weld.anchor_b[0], [1.0, 2.0])
    np.testing.assert_allclose(weld.anchor_a[0], [0.1, 0.0])
    assert float(weld.angle[0]) == pytest.approx(POSE[2] + 0.01 * np.sinh(0.5))


@pytest.mark.slow
def test_guesses_lie_where_the_readings_say():
    block = make_block(scene(unknown=UNKNOWN), (0,), recorded("drawer"))
    guess = Guesses.of(stack_blocks([block]))
    where = part(block, "prismatic")
    assert guess.has[0][where].tolist() == [True, True, True, False, False]
    guide = decode(block, guess.z[0]).prismatic
    assert float(guide.axis[0]) == pytest.approx(AXIS, abs=0.01)
    assert float(guide.angle[0]) == pytest.approx(POSE[2], abs=1e-3)
    off = ACROSS @ (np.asarray(guide.anchor_b[0]) - POSE[:2])
    assert off == pytest.approx(0.0, abs=1e-3)


def test_a_filter_learns_nothing_new_of_a_welded_body():
    block = make_block(scene(CONSTRAINTS["fixed"]), (0,), recorded("fixed"))
    likelihood = block.target.log_likelihood
    params = decode(block, np.zeros(block.layout.dim))
    reading = NOISE[[0, 2, 3, 5]][None]
    noise = NoiseLevel(jnp.asarray(reading), jnp.asarray(reading[:, 2:]))
    found = extended_filter(
        likelihood.coordinates.scene, params, likelihood.data, noise
    )
    # Whatever was read, it is where it was: no gain, and noise of one reading.
    np.testing.assert_allclose(found.gains.last, 0.0, atol=1e-12)
    expected = np.broadcast_to(np.diag(1.0 / NOISE), found.gains.last.shape)
    np.testing.assert_allclose(found.gains.last_whitening, expected, rtol=1e-9)


def pair(unknown, constraints=()):
    """Two boxes, the first in the frame of the second."""
    body = {"shape": {"type": "box", "half_extents": list(HALF)}}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.05,
            "bodies": [{"name": name, **body} for name in ("drawer", "cabinet")],
            "unknown": unknown,
            "constraints": list(constraints),
        }
    )


def moving_pair(*, is_sliding: bool):
    """The cabinet drifts and turns; the drawer slides in it, or goes its own way."""
    time = np.linspace(0.0, 1.0, 30)
    cabinet = np.stack([0.3 * time, -0.2 * time, 0.8 * time], -1)
    slide = 0.2 * np.sin(6.0 * time)
    local = np.array([0.1, 0.4]) + np.outer(slide, ALONG)
    place = [c[:2] + turned(c[2], p) for c, p in zip(cabinet, local, strict=True)]
    angle = cabinet[:, 2] + (0.3 if is_sliding else 0.3 + 0.9 * np.sin(5.0 * time))
    state = np.zeros((30, 2, 6))
    state[:, 0, :3] = np.column_stack([place, angle])
    state[:, 1, :3] = cabinet
    return make_history(state, state[..., :3], state, 0.05)


def test_a_drawer_in_a_body_is_measured_in_the_frame_of_that_body():
    spec = pair({"prismatic": 1})
    block = make_block(spec, (0, 1), moving_pair(is_sliding=True))
    (tie,) = (slot for slot in block.layout.slots if slot.body_b == 1)
    guide = decode(block, np.zeros(block.layout.dim)).prismatic
    assert float(guide.axis[tie.index]) == pytest.approx(AXIS)
    assert float(guide.angle[tie.index]) == pytest.approx(0.3)
    off = ACROSS @ (np.asarray(guide.anchor_b[tie.index]) - np.array([0.1, 0.4]))
    assert off == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("kind", ["prismatic", "weld"])
def test_pairs_that_may_slide_are_inferred_together(kind):
    spec = pair({kind: 1})
    sliding, apart = (moving_pair(is_sliding=flag) for flag in (True, False))
    assert independent_blocks(spec, apart)[0] == [(0,), (1,)]
    expected = [(0, 1)] if kind == "prismatic" else [(0,), (1,)]
    assert independent_blocks(spec, sliding)[0] == expected


def test_slots_and_coordinates_of_drawers_and_welds_do_not_overlap():
    spec = pair({"prismatic": 1, "weld": 1})
    layout = block_layout(spec, (0, 1))
    counts = np.bincount(layout.slot_of_coordinate()[2:])
    sizes = {"prismatic": 5, "weld": 3}
    assert counts.tolist() == [sizes[slot.kind] for slot in layout.slots]
    assert np.count_nonzero(layout.period()) == 3
