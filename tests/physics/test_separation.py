"""Distances between outlines: against two other methods, and by their symmetries."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pymunk
import pytest

from boomdp_jax.physics import Scene, State, scene_spec_from_dict
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.separation import pair_separation, separation
from tests.reference.minkowski import signed_distance

NUM_CASES = 256
ALL_SEPARATIONS = jax.jit(jax.vmap(separation, in_axes=(None, 0)))


def polygon(num: int, seed: int) -> dict:
    """Corners on an ellipse, which are convex whatever they are."""
    rng = np.random.default_rng(seed)
    shares = np.cumsum(rng.uniform(0.5, 1.5, num))
    angle = 2.0 * np.pi * shares / shares[-1]
    corners = np.stack([0.5 * np.cos(angle), 0.3 * np.sin(angle)], axis=-1)
    return {"type": "polygon", "vertices": corners.tolist()}


def spec_of(*shapes: dict) -> SceneSpec:
    bodies = [{"name": f"body {i}", "shape": shape} for i, shape in enumerate(shapes)]
    return scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": 0.02, "bodies": bodies}
    )


BOX = {"type": "box", "half_extents": [0.4, 0.2]}
CIRCLE, PEBBLE = ({"type": "circle", "radius": radius} for radius in (0.3, 0.05))
MIXED = spec_of(polygon(7, 1), BOX, polygon(3, 2), CIRCLE, PEBBLE, polygon(5, 3))


def poses_of(num_bodies: int, num_cases: int = NUM_CASES) -> np.ndarray:
    """Random poses, as often overlapping as not."""
    rng = np.random.default_rng(5)
    scale = [0.6, 0.6, 3.0]
    return rng.uniform(-1.0, 1.0, (num_cases, num_bodies, 3)) * scale


def state_at(pose) -> State:
    pose = jnp.asarray(pose, float)
    return State(pose=pose, twist=jnp.zeros_like(pose))


def placed(corners: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Corners in the world; the centre alone for a circle, which has none."""
    corners = corners if len(corners) else np.zeros((1, 2))
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    return corners @ np.array([[cos, sin], [-sin, cos]]) + pose[:2]


def by_differences(spec: SceneSpec, pose: np.ndarray, a: int, b: int) -> float:
    one, other = spec.bodies[a], spec.bodies[b]
    corners = placed(one.vertices, pose[a]), placed(other.vertices, pose[b])
    radius = one.radius + other.radius
    if len(corners[0]) == len(corners[1]) == 1:
        return float(np.hypot(*(corners[0] - corners[1])[0])) - radius
    return signed_distance(*corners, radius)


def test_distances_and_depths_are_those_of_the_set_of_differences(precision):
    spec, poses = MIXED, poses_of(MIXED.num_bodies)
    found = np.asarray(ALL_SEPARATIONS(spec.scene, state_at(poses)))
    num = spec.num_bodies
    for a in range(num):
        for b in range(a):
            expected = [by_differences(spec, pose, a, b) for pose in poses]
            assert min(expected) < -0.02, "no case overlaps"
            assert max(expected) > 0.2, "no case is apart"
            np.testing.assert_allclose(
                found[:, a, b],
                expected,
                atol=precision.choose(single=2e-6, double=1e-13),
                err_msg=f"bodies {a} and {b}",
            )
    np.testing.assert_array_equal(found, np.swapaxes(found, 1, 2))
    assert np.all(np.isposinf(found[:, np.arange(num), np.arange(num)]))


def pymunk_shape(
    spec: SceneSpec, body: int, pose: np.ndarray
) -> tuple[pymunk.Body, pymunk.Shape]:
    """A shape and its body, which the shape does not keep alive."""
    own = pymunk.Body(1.0, 1.0)
    own.position, own.angle = tuple(pose[:2]), pose[2]
    if spec.bodies[body].radius:
        shape: pymunk.Shape = pymunk.Circle(own, spec.bodies[body].radius)
    else:
        shape = pymunk.Poly(own, spec.bodies[body].vertices.tolist())
    shape.cache_bb()
    return own, shape


def test_circles_are_as_far_from_polygons_as_in_another_engine():
    spec, poses = MIXED, poses_of(MIXED.num_bodies)
    found = np.asarray(ALL_SEPARATIONS(spec.scene, state_at(poses)))
    for body in (0, 1, 2, 5):
        expected = []
        for pose in poses:
            _, shape = pymunk_shape(spec, body, pose[body])
            expected.append(shape.point_query(tuple(pose[3, :2])).distance)
        np.testing.assert_allclose(
            found[:, body, 3], np.array(expected) - 0.3, atol=1e-9
        )


def test_what_overlaps_and_how_deep_is_as_in_another_engine():
    spec, poses = MIXED, poses_of(MIXED.num_bodies)
    found = np.asarray(ALL_SEPARATIONS(spec.scene, state_at(poses)))
    for case, pose in enumerate(poses):
        for a, b in ((0, 1), (0, 5), (2, 1), (2, 5), (3, 4)):
            space = pymunk.Space()
            space.add(*pymunk_shape(spec, b, pose[b]))
            _, shape = pymunk_shape(spec, a, pose[a])
            hits = space.shape_query(shape)
            depths = [
                point.distance for hit in hits for point in hit.contact_point_set.points
            ]
            assert (min(depths, default=1.0) < 0) == (found[case, a, b] < 0)
            if depths:
                # It clips features, whose deepest point is the depth to its tolerance.
                assert min(depths) == pytest.approx(found[case, a, b], abs=1e-6)


def test_boxes_apart_along_an_axis_or_a_diagonal_have_textbook_distances():
    scene = spec_of(BOX, BOX).scene

    def apart(x, y):
        state = state_at([[0.0, 0.0, 0.0], [x, y, 0.0]])
        return float(separation(scene, state)[0, 1])

    assert apart(1.0, 0.1) == pytest.approx(0.2)
    assert apart(0.8 + 0.3, 0.4 + 0.4) == pytest.approx(0.5)
    assert apart(0.8, 0.0) == pytest.approx(0.0, abs=1e-12)
    # Pushed out through the nearest side, which is the short way up.
    assert apart(0.3, 0.15) == pytest.approx(-0.25)


def test_moving_and_turning_the_whole_world_changes_no_distance(precision):
    scene, poses = MIXED.scene, poses_of(MIXED.num_bodies, 64)
    cos, sin = np.cos(1.1), np.sin(1.1)
    turned = poses[..., :2] @ np.array([[cos, sin], [-sin, cos]]) + [3.0, -7.0]
    moved = np.concatenate([turned, poses[..., 2:] + 1.1], axis=-1)
    np.testing.assert_allclose(
        ALL_SEPARATIONS(scene, state_at(moved)),
        ALL_SEPARATIONS(scene, state_at(poses)),
        atol=precision.choose(single=5e-6, double=1e-13),
    )


def test_more_room_for_corners_changes_nothing():
    scene, states = MIXED.scene, state_at(poses_of(MIXED.num_bodies, 64))
    last = jnp.repeat(scene.vertices[:, -1:], 3, axis=1)
    roomy = eqx.tree_at(
        lambda s: s.vertices, scene, jnp.concatenate([scene.vertices, last], axis=1)
    )
    np.testing.assert_allclose(
        ALL_SEPARATIONS(roomy, states), ALL_SEPARATIONS(scene, states), atol=1e-15
    )


def test_a_pair_alone_is_its_entry_of_the_table():
    state = state_at(poses_of(MIXED.num_bodies, 1)[0])
    table = jax.jit(separation)(MIXED.scene, state)
    pair = jax.jit(pair_separation)
    for a, b in ((1, 0), (3, 4), (4, 2)):
        alone = pair(MIXED.scene, state, a, b)
        np.testing.assert_allclose(alone, table[a, b], atol=1e-15)


@pytest.mark.slow
def test_jit_equals_eager_and_vmap_equals_a_loop():
    states = state_at(poses_of(MIXED.num_bodies, 4))
    together = ALL_SEPARATIONS(MIXED.scene, states)
    for case in range(4):
        state = jax.tree.map(lambda leaf, case=case: leaf[case], states)
        np.testing.assert_allclose(
            together[case], separation(MIXED.scene, state), atol=1e-15
        )


def test_a_single_body_is_near_nothing():
    assert np.isposinf(separation(spec_of(BOX).scene, state_at([[0.0, 0.0, 0.0]])))


def total(pose, scene: Scene):
    table = separation(scene, State(pose=pose, twist=jnp.zeros_like(pose)))
    return jnp.sum(jnp.where(jnp.isfinite(table), jnp.sin(table), 0.0))


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences():
    poses = jnp.asarray(poses_of(MIXED.num_bodies, 32))
    tangents = jax.random.normal(jax.random.key(0), poses.shape)
    value = jax.jit(jax.vmap(total, in_axes=(0, None)))
    gradient = jax.jit(jax.vmap(jax.grad(total), in_axes=(0, None)))
    slopes = jnp.sum(gradient(poses, MIXED.scene) * tangents, axis=(1, 2))
    step = 1e-6
    ahead, behind = (
        value(poses + sign * step * tangents, MIXED.scene) for sign in (1, -1)
    )
    np.testing.assert_allclose(slopes, (ahead - behind) / (2 * step), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("reverse", [True, False], ids=["reverse", "forward"])
def test_gradients_are_finite_where_distances_are_not_smooth(reverse, precision):
    shapes = spec_of(BOX, BOX, CIRCLE, CIRCLE).scene
    poses = [
        [[0.0, 0.0, 0.0]] * 4,  # Everything at one place.
        [[0.0, 0.0, 0.0], [0.8, 0.4, 0.0], [0.7, 0.0, 0.0], [1.3, 0.0, 0.0]],
        [[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [0.4, 0.2, 0.0], [0.4, 0.2, 1.0]],
    ]
    derivative = jax.jit((jax.jacrev if reverse else jax.jacfwd)(total))
    for pose in poses:
        assert np.all(np.isfinite(derivative(jnp.asarray(pose, float), shapes)))
    by_scene = jax.jit(jax.grad(total, argnums=1, allow_int=True))
    slopes = by_scene(jnp.asarray(poses[0], float), shapes)
    assert np.all(np.isfinite(slopes.vertices))
    assert np.all(np.isfinite(slopes.radius))
