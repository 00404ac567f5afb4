"""Contact against closed forms: resting, sliding, bouncing, stacking, stopping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import Params, rollout, step
from tests.physics.contact_scenes import FLOOR, body, fixed, run, spec_of

G = 9.81


def test_box_on_a_floor_stands_still(precision):
    spec = spec_of(
        FLOOR,
        body("box", (0.25, 0.25), (0.0, 0.25, 0.0)),
        body("far", (0.1, 0.1), (5.0, 0.1, 0.0)),
    )
    states, info, _ = run(spec, 120)
    assert np.all(info.is_finite)
    moved = np.abs(states.pose - np.asarray(spec.initial_state().pose))
    assert np.max(moved) < 2e-4
    assert np.max(np.abs(states.twist[-1])) < 1e-4
    assert np.max(info.overlap) < 2e-4
    assert not np.any(info.overflow)


@pytest.mark.slow
def test_tower_of_five_boxes_stands_for_ten_seconds():
    boxes = [
        body(f"box{i}", (0.25, 0.25), (0.0, 0.25 + 0.5 * i, 0.0)) for i in range(5)
    ]
    spec = spec_of(FLOOR, *boxes)
    states, info, last = run(spec, 600)
    moved = np.abs(states.pose - np.asarray(spec.initial_state().pose))
    # The first impulses are not known: it sinks a little while they build up.
    assert np.max(moved[..., :2]) < 5e-3
    assert np.max(moved[..., 2]) < 2e-3
    assert np.max(np.abs(last.twist)) < 1e-3
    assert np.max(info.overlap[-60:]) < 2e-3
    # And nothing creeps.
    assert np.max(np.abs(states.pose[-1] - states.pose[-301])) < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "slides"), [(0.5, False), (0.2, True)])
def test_box_on_a_slope_follows_coulombs_law(friction, slides):
    angle = np.deg2rad(20.0)
    up = np.array([-np.sin(angle), np.cos(angle)])
    along = np.array([np.cos(angle), np.sin(angle)])
    slope = fixed("slope", (20.0, 0.5), (*(-0.5 * up), angle), friction=friction)
    box = body("box", (0.3, 0.1), (*(0.1 * up), angle), friction=friction)
    spec = spec_of(slope, box, body("far", 0.1, (9.0, 9.0, 0.0)))
    states, _, _ = run(spec, 60)
    gone = -(states.pose[:, 1, :2] - states.pose[0, 1, :2]) @ along
    if not slides:
        assert np.max(np.abs(gone)) < 1e-3
        return
    acceleration = G * (np.sin(angle) - friction * np.cos(angle))
    speed = -states.twist[-1, 1, :2] @ along
    assert speed == pytest.approx(acceleration, rel=0.02)
    assert gone[-1] == pytest.approx(0.5 * acceleration, rel=0.04)
    assert np.max(np.abs(states.pose[:, 1, 2] - angle)) < 2e-3


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_two_balls_collide_by_newtons_law(restitution, precision):
    contact = {"friction": 0.0, "restitution": restitution}
    first = body("first", 0.1, (-0.5, 0.0, 0.0), (2.0, 0.0, 0.0), **contact)
    second = body("second", 0.2, (0.5, 0.0, 0.0), (-1.0, 0.0, 0.0), **contact)
    spec = spec_of(first, second, body("far", 0.1, (9.0, 9.0, 0.0)), gravity=(0.0, 0.0))
    states, _, last = run(spec, 60)
    scene, params = spec.scene, spec.params()
    mass = np.asarray(params.density * scene.area)
    before = np.array([2.0, -1.0])
    centre = np.sum(mass[:2] * before) / np.sum(mass[:2])
    expected = centre - restitution * (before - centre)
    tolerance = precision.choose(single=1e-4, double=1e-9)
    assert np.allclose(last.twist[:2, 0], expected, atol=tolerance)
    momentum = np.einsum("b,tbk->tk", mass[:2], states.twist[:, :2, :2])
    assert np.allclose(momentum, momentum[0], rtol=10 * tolerance, atol=tolerance)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 1e-5, 1e-3, 0.01])
@pytest.mark.parametrize(
    ("order", "num_thrown", "heading"),
    [([0, 1, 2, 3, 4], 1, 0.0), ([4, 3, 2, 1, 0], 2, 0.0), ([3, 1, 4, 0, 2], 3, 2.0)],
)
def test_cradle_of_five_hands_the_speed_on(order, num_thrown, heading, gap):
    direction = np.array([np.cos(heading), np.sin(heading)])
    place = (0.2 + gap) * np.arange(5.0)
    speed = np.where(np.arange(5) < num_thrown, 2.0, 0.0)
    # They arrive in the middle of a substep.
    place = np.where(speed > 0.0, place - 0.4533, place)
    balls = [
        body(
            f"ball{i}",
            0.1,
            (*(place[i] * direction), 0.0),
            (*(speed[i] * direction), 0.0),
            friction=0.0,
            restitution=1.0,
        )
        for i in order
    ]
    _, _, last = run(spec_of(*balls, gravity=(0.0, 0.0)), 60)
    along = (last.twist[:, :2] @ direction)[np.argsort(order)]
    # Equal balls exchange velocities: as many fly off as came. Those that came together
    # overlap a little when they hit, and are parted meanwhile.
    atol = 1e-6 if num_thrown == 1 else 0.05
    np.testing.assert_allclose(along, speed[::-1], atol=atol)
    assert np.sum(along**2) == pytest.approx(np.sum(speed**2), rel=2e-3)


@pytest.mark.slow
def test_ball_bounces_to_the_height_that_restitution_allows():
    contact = {"friction": 0.0, "restitution": 0.8}
    ball = body("ball", 0.1, (0.0, 1.1, 0.0), **contact)
    spec = spec_of(FLOOR, ball, body("far", 0.1, (9.0, 0.1, 0.0)), dt=1 / 240)
    states, _, _ = run(spec, 240)
    height = states.pose[:, 1, 1] - 0.1
    landed = int(np.argmin(height[:150]))
    assert np.max(height[landed:]) == pytest.approx(0.64, rel=0.03)


def test_friction_at_an_impact_turns_a_ball():
    # A disc of e = 0 that hits a floor sliding slowly rolls afterwards: 2/3 of its
    # speed, since its inertia is half of m r^2.
    ball = body("ball", 0.1, (0.0, 0.3, 0.0), (1.0, -3.0, 0.0), friction=2.0)
    floor = fixed("floor", (20.0, 0.5), (0.0, -0.5, 0.0), friction=2.0)
    spec = spec_of(floor, ball, body("far", 0.1, (9.0, 9.0, 0.0)), gravity=(0.0, 0.0))
    _, _, last = run(spec, 60)
    assert last.twist[1, 0] == pytest.approx(2 / 3, rel=1e-3)
    assert last.twist[1, 2] == pytest.approx(-2 / 3 / 0.1, rel=1e-3)
    assert last.twist[1, 1] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("speed", [5.0, 50.0, 200.0])
def test_fast_small_body_does_not_tunnel(speed):
    wall = fixed("wall", (0.01, 1.0), (1.0, 0.0, 0.0))
    bullet = body("bullet", 0.02, (0.0, 0.1, 0.0), (speed, 0.0, 0.0))
    chip = body("chip", (0.02, 0.02), (0.0, -0.5, 0.3), (speed, 0.0, 0.0))
    states, _, _ = run(spec_of(wall, bullet, chip, gravity=(0.0, 0.0)), 60)
    assert np.max(states.pose[:, 1:, 0]) < 1.0


def test_pushed_along_a_wall_a_box_neither_sticks_nor_shakes():
    wall = fixed("wall", (20.0, 0.5), (0.0, 0.75, 0.0), friction=0.2)
    box = body("box", (0.4, 0.25), (0.0, 0.0, 0.0), friction=0.2)
    spec = spec_of(wall, box, body("far", 0.1, (9.0, -9.0, 0.0)), gravity=(0.0, 0.0))
    mass = 20.0 * 0.8 * 0.5
    wrench = np.zeros((3, 3))
    wrench[1] = [6.0, 10.0, 0.0]
    states, _, last = run(spec, 60, wrench)
    # Pressed with 10 N, it is held back by 2 N.
    assert last.twist[1, 0] == pytest.approx(4.0 / mass, rel=0.02)
    assert np.max(np.abs(states.pose[:, 1, 1])) < 1e-3
    assert np.max(np.abs(states.twist[20:, 1, 1:])) < 5e-3


def test_groups_and_filters_let_bodies_pass():
    def moving(name, x, speed, group):
        entry = body(name, 0.1, (x, 0.0, 0.0), (speed, 0.0, 0.0))
        entry["contact"]["group"] = group
        return entry

    ghost = spec_of(
        moving("a", -0.5, 2.0, "ghosts"),
        moving("b", 0.5, 0.0, "ghosts"),
        body("far", 0.1, (9.0, 9.0, 0.0)),
        gravity=(0.0, 0.0),
    )
    _, info, last = run(ghost, 60)
    assert np.allclose(last.twist[:2, 0], [2.0, 0.0])
    assert np.all(info.overlap == 0.0)


def test_mass_ratio_of_a_hundred_to_one_holds():
    heavy = body("heavy", (0.25, 0.25), (0.0, 0.75, 0.0), density=2000.0)
    light = body("light", (0.25, 0.25), (0.0, 0.25, 0.0))
    spec = spec_of(FLOOR, light, heavy)
    states, info, last = run(spec, 300)
    assert np.max(np.abs(states.pose - np.asarray(spec.initial_state().pose))) < 0.05
    assert np.max(np.abs(last.twist)) < 1e-2
    # A contact gives way in proportion to its load over the lighter mass: 0.2 mm for a
    # box under its like.
    assert np.max(info.overlap[-60:]) < 0.02


@pytest.mark.slow
def test_polygons_of_eight_corners_roll_and_rest():
    turns = 2 * np.pi * np.arange(8) / 8
    corners = 0.2 * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    # Density over mass does not matter; a slope of ten degrees turns it over.
    octagon = body(
        "octagon", corners.tolist(), (0.0, 0.2 * np.cos(np.pi / 8), np.pi / 8)
    )
    spec = spec_of(FLOOR, octagon, body("far", 0.1, (9.0, 0.1, 0.0)))
    states, info, _ = run(spec, 60)
    assert np.max(np.abs(states.pose[:, 1] - np.asarray(octagon["pose"]))) < 1e-3
    assert np.max(info.overlap) < 1e-3


def test_far_apart_bodies_move_as_in_a_scene_without_contact(precision):
    entry = body("box", (0.2, 0.1), (0.0, 3.0, 0.3), (1.0, 2.0, 3.0))
    other = body("other", 0.1, (9.0, 9.0, 0.0))
    with_contact = spec_of(FLOOR, entry, other)
    states, _, _ = run(with_contact, 30)
    t = np.arange(1, 31) / 60
    expected = np.stack([t, 3.0 + 2.0 * t - 0.5 * G * t**2, 0.3 + 3.0 * t], axis=-1)
    tolerance = precision.choose(single=2e-5, double=1e-9)
    assert np.allclose(states.pose[:, 1], expected, atol=tolerance)


@pytest.mark.slow
def test_batch_agrees_with_one_by_one_and_repeats_bit_for_bit():
    spec = spec_of(
        FLOOR,
        body("box", (0.25, 0.25), (0.0, 0.6, 0.4)),
        body("ball", 0.1, (0.1, 1.2, 0.0), restitution=0.5),
    )
    scene, params, state = spec.scene, spec.params(), spec.initial_state()
    wrenches = jnp.zeros((30, 3, 3))
    shifts = 0.01 * jnp.arange(5.0)

    def one(shift):
        start = type(state)(state.pose.at[1, 0].add(shift), state.twist)
        return rollout(scene, params, start, wrenches)

    batched = jax.jit(jax.vmap(one))
    states, _ = batched(shifts)
    again, _ = batched(shifts)
    assert np.array_equal(states.pose, again.pose)
    single = jax.jit(one)
    for i, shift in enumerate(shifts):
        assert np.allclose(single(shift)[0].pose, states.pose[i], atol=1e-9)


@pytest.mark.slow
def test_step_by_step_with_the_cache_is_the_rollout():
    spec = spec_of(
        FLOOR,
        body("low", (0.25, 0.25), (0.0, 0.25, 0.0)),
        body("high", (0.25, 0.25), (0.0, 0.75, 0.0)),
    )
    scene, params, state = spec.scene, spec.params(), spec.initial_state()
    wrench = jnp.zeros((3, 3))
    states, _, _ = run(spec, 10)
    advance = jax.jit(step)
    cache = None
    for t in range(10):
        state, info = advance(scene, params, state, wrench, cache=cache)
        cache = info.cache
        assert np.allclose(state.pose, states.pose[t], atol=1e-12)
    # Without it the stack sags more.
    state = spec.initial_state()
    for _ in range(10):
        state, _ = advance(scene, params, state, wrench)
    assert state.pose[2, 1] < states.pose[9, 2, 1] - 1e-5


def test_contact_wrenches_bear_the_weight_of_what_stands():
    lower = body("lower", (0.25, 0.25), (0.0, 0.25, 0.0))
    upper = body("upper", (0.25, 0.25), (0.1, 0.75, 0.0))
    spec = spec_of(FLOOR, lower, upper)
    _, info, _ = run(spec, 120)
    mass = np.asarray(spec.scene.area) * np.asarray(spec.params().density)
    push = np.asarray(info.contact_wrench[-1])
    # At rest every body is held up against its own weight, with no torque left over.
    assert push[1:, 1] == pytest.approx(mass[1:] * G, rel=1e-3)
    assert np.abs(push[1:, 2]).max() < 1e-3 * mass[1] * G
    assert np.abs(push[1:, 0]).max() < 1e-3 * mass[1] * G
    assert np.all(push[0] == 0)


def test_params_without_a_surface_are_refused():
    spec = spec_of(FLOOR, body("box", (0.2, 0.2), (0.0, 0.2, 0.0)))
    params = spec.params()
    bare = Params(**{**vars(params), "surface": None})
    with pytest.raises(ValueError, match="expected params with a surface"):
        step(spec.scene, bare, spec.initial_state(), jnp.zeros((2, 3)))
