import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import touched_sectors
from boomdp_jax.models.outline_contact import condition_number
from boomdp_jax.physics import State, scene_spec_from_dict, separation


def room():
    """A box, a triangle, a disc, and a wall."""

    def box(name, pose, half, **more):
        shape = {"type": "box", "half_extents": half}
        return {"name": name, "pose": pose, "shape": shape, "density": 1.0, **more}

    corners = [[-0.3, -0.2], [0.4, -0.2], [0.0, 0.5]]
    bodies = [
        box("box", [0.0, 0.0, 0.0], [0.5, 0.3]),
        {
            "name": "triangle",
            "pose": [1.2, 0.1, 0.4],
            "shape": {"type": "polygon", "vertices": corners},
            "density": 1.0,
        },
        {
            "name": "disc",
            "pose": [-0.3, 1.0, 0.0],
            "shape": {"type": "circle", "radius": 0.3},
            "density": 1.0,
        },
        box("wall", [0.0, -0.6, 0.0], [2.0, 0.1], static=True),
    ]
    for body in bodies:
        if body.get("static"):
            del body["density"]
    return scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": 0.1, "bodies": bodies}
    )


def outline(scene, state, body):
    """Corners in the world; of a circle, many."""
    x, y, angle = np.asarray(state.pose[body])
    if scene.radius[body] > 0:
        turn = (np.arange(400) + 0.3) * 2 * np.pi / 400
        local = float(scene.radius[body]) * np.exp(1j * turn)
    else:
        corners = np.asarray(scene.vertices[body])[np.asarray(scene.vertex_mask[body])]
        local = corners[:, 0] + 1j * corners[:, 1]
    return x + 1j * y + local * np.exp(1j * angle)


def crossings(start, stop, corners):
    """Where a segment meets the sides of an outline, as shares of the segment."""
    found, run = [], stop - start
    for a, b in zip(corners, np.roll(corners, -1), strict=True):
        side = b - a
        cross = (np.conj(run) * side).imag
        if cross == 0:
            continue
        share = (np.conj(a - start) * side).imag / cross
        place = (np.conj(a - start) * run).imag / cross
        if 0 <= place <= 1 and 0 <= share <= 1:
            found.append(share)
    return found


def slow_sectors(scene, state, body, radius, num_sectors, num_rays):
    x, y, angle = np.asarray(state.pose[body])
    touched = np.zeros(num_sectors, bool)
    for sector in range(num_sectors):
        for ray in range(num_rays):
            share = (ray + 0.5) / num_rays - 0.5
            heading = angle + 2 * np.pi / num_sectors * (sector + share)
            way = np.exp(1j * heading)
            own = (
                max(
                    crossings(
                        x + 1j * y, x + 1j * y + 20 * way, outline(scene, state, body)
                    )
                )
                * 20
            )
            start = x + 1j * y + own * way
            for other in range(scene.num_bodies):
                if other != body:
                    corners = outline(scene, state, other)
                    touched[sector] |= bool(
                        crossings(start, start + radius * way, corners)
                    )
    return touched


@pytest.mark.slow
@pytest.mark.parametrize("num_sectors", [4, pytest.param(3, marks=pytest.mark.slow)])
def test_rays_meet_what_brute_force_says(num_sectors):
    spec = room()
    scene, rng = spec.scene, np.random.default_rng(0)
    start, num_touched, num_rays = spec.initial_state(), 0, 5
    fast = jax.jit(
        lambda state, body: touched_sectors(
            scene,
            state,
            body,
            radius=0.4,
            num_sectors=num_sectors,
            num_rays=num_rays,
        )
    )
    tried = 0
    while tried < 4:
        pose = start.pose + jnp.asarray(rng.normal(size=(4, 3)) * [0.1, 0.1, 1.0])
        state = State(pose, start.twist)
        # Crossings tell all only of outlines that do not overlap.
        if jnp.min(separation(scene, state)) < 0:
            continue
        tried += 1
        for body in range(3):
            slow = slow_sectors(scene, state, body, 0.4, num_sectors, num_rays)
            np.testing.assert_array_equal(fast(state, body), slow)
            num_touched += slow.sum()
    assert num_touched > 10


def test_sides_are_counted_from_the_front_against_the_clock():
    scene = room().scene
    pose = jnp.array([[0, 0, 0], [9, 9, 0], [0, 0.65, 0], [0, -5, 0]], float)
    state = State(pose, jnp.zeros((4, 3)))
    touched = jax.jit(lambda state: touched_sectors(scene, state, 0, radius=0.1))
    sectors = touched(state)
    np.testing.assert_array_equal(sectors, [False, True, False, False])
    assert int(condition_number(sectors)) == 2
    turned = State(pose.at[0, 2].set(np.pi / 2), state.twist)
    # What was on the left is ahead, and as near once the long side points at it.
    sectors = touched(turned)
    np.testing.assert_array_equal(sectors, [True, False, False, False])
    assert int(condition_number(sectors)) == 1


def test_bodies_that_may_not_touch_are_not_met():
    scene = room().scene
    pose = jnp.array([[0, 0, 0], [9, 9, 0], [0, 0.65, 0], [0, -5, 0]], float)
    state = State(pose, jnp.zeros((4, 3)))
    apart = jnp.zeros((4, 4), bool)
    scene = type(scene)(**{**vars(scene), "collides": apart})
    assert not np.any(touched_sectors(scene, state, 0, radius=0.1))
