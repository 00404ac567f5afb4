"""What lies, rolls or has done bouncing keeps its depth and has no speed left."""

import numpy as np
import pytest

from tests.physics.contact_scenes import FLOOR, body, fixed, run, spec_of

G, RADIUS = 9.81, 0.1
SUBSTEPS = 4
"""Those of a scene that does not say."""


def fall(acceleration: float, dt: float) -> float:
    """How far a body at rest falls in a substep [m]."""
    return 0.5 * acceleration * (dt / SUBSTEPS) ** 2


@pytest.mark.parametrize("spin", [-50.0, 5.0])
def test_without_friction_a_disc_that_spins_lies_as_one_that_does_not(spin, precision):
    smooth = {"friction": 0.0}
    spec = spec_of(
        FLOOR,
        body("spinning", RADIUS, (0.0, RADIUS, 0.0), (5.0, 0.0, spin), **smooth),
        body("still", RADIUS, (-1.0, RADIUS, 0.0), **smooth),
    )
    states, _, last = run(spec, 120)
    height = states.pose[:, 1:, 1]
    # In single precision points lie where they do to a micrometre.
    np.testing.assert_allclose(height[:, 0], height[:, 1], rtol=0, atol=5e-6)
    assert np.max(RADIUS - height) < fall(G, 1 / 60)
    np.testing.assert_allclose(last.twist[1], (5.0, 0.0, spin), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("upper", [RADIUS, (0.2, RADIUS)])
def test_without_friction_a_disc_spins_under_what_lies_on_it(upper):
    smooth = {"friction": 0.0}
    spec = spec_of(
        FLOOR,
        body("lower", RADIUS, (0.0, RADIUS, 0.0), (0.0, 0.0, 40.0), **smooth),
        body("upper", upper, (0.0, 3 * RADIUS, 0.0), **smooth),
    )
    states, _, last = run(spec, 60)
    for of, height in ((1, RADIUS), (2, 3 * RADIUS)):
        np.testing.assert_allclose(states.pose[:, of, 1], height, rtol=0, atol=1e-3)
    np.testing.assert_allclose(last.twist[1:, 1], 0.0, rtol=0, atol=2e-3)
    assert last.twist[1, 2] == pytest.approx(40.0, rel=1e-9)


def test_disc_rolls_down_a_slope_with_two_thirds_of_its_pull(precision):
    # Its inertia is half of m r^2. The slope is level, and gravity leans.
    angle, dt, num = 0.4, 1 / 60, 120
    pull, weight = G * np.sin(angle), G * np.cos(angle)
    spec = spec_of(
        FLOOR,
        body("disc", RADIUS, (0.0, RADIUS, 0.0)),
        body("far", RADIUS, (-9.0, RADIUS, 0.0)),
        gravity=(pull, -weight),
        dt=dt,
    )
    states, _, last = run(spec, num)
    speed = 2 / 3 * pull * num * dt
    # The speed of its centre is that of the spin at a lever shorter by its depth.
    assert last.twist[1, 0] == pytest.approx(speed, rel=1e-3)
    assert last.twist[1, 2] == pytest.approx(-speed / RADIUS, rel=1e-3)
    assert last.twist[1, 1] == pytest.approx(0.0, abs=1e-4)
    assert np.max(RADIUS - states.pose[:, 1, 1]) < fall(weight, dt)


@pytest.mark.parametrize(
    ("dt", "restitution", "height"),
    [(1 / 60, 0.5, 1.0), (1 / 30, 0.5, 1.0), (1 / 30, 0.8, 0.5), (0.1, 0.3, 0.5)],
)
def test_ball_that_has_done_bouncing_lies_still_on_the_floor(dt, restitution, height):
    contact = {"friction": 0.0, "restitution": restitution}
    ball = body("ball", RADIUS, (0.0, RADIUS + height, 0.0), **contact)
    spec = spec_of(FLOOR, ball, body("far", RADIUS, (9.0, RADIUS, 0.0)), dt=dt)
    states, _, _ = run(spec, int(10.0 / dt))
    # No impact is left that makes it as deep as that.
    depth = RADIUS - states.pose[-20:, 1, 1]
    assert np.all((depth >= 0.0) & (depth < fall(G, dt)))
    np.testing.assert_allclose(depth, depth[0], rtol=0, atol=1e-7)
    np.testing.assert_allclose(states.twist[-20:, 1], 0.0, rtol=0, atol=1e-6)


@pytest.mark.parametrize("restitution", [0.3, 0.8])
def test_ball_pressed_onto_the_floor_lies_still(restitution):
    contact = {"friction": 0.0, "restitution": restitution}
    spec = spec_of(
        FLOOR,
        body("ball", RADIUS, (0.0, 2 * RADIUS, 0.0), **contact),
        body("far", RADIUS, (9.0, RADIUS, 0.0)),
    )
    push, mass = 10.0 * G, 20.0 * np.pi * RADIUS**2
    wrench = np.zeros((3, 3))
    wrench[1, 1] = -push * mass
    states, _, _ = run(spec, 240, wrench)
    depth = RADIUS - states.pose[-20:, 1, 1]
    assert np.all((depth >= 0.0) & (depth < fall(G + push, 1 / 60)))
    np.testing.assert_allclose(states.twist[-20:, 1], 0.0, rtol=0, atol=1e-6)


def test_boxes_that_bounce_stand_on_each_other_in_the_end():
    bouncing, dt = {"restitution": 0.8}, 1 / 30
    spec = spec_of(
        FLOOR,
        body("lower", (0.2, 0.1), (0.0, 0.1, 0.0), **bouncing),
        body("upper", (0.2, 0.1), (0.0, 0.302, 0.0), **bouncing),
        dt=dt,
    )
    states, info, last = run(spec, 240)
    # Two weights on the lower contact.
    assert np.max(info.overlap[-30:]) < 2.0 * fall(G, dt)
    np.testing.assert_allclose(last.twist, 0.0, rtol=0, atol=1e-5)
    np.testing.assert_allclose(states.pose[-1, 1:, [0, 2]], 0.0, rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.3, 0.8])
def test_tower_of_bouncing_boxes_stands(restitution):
    boxes = [
        body(
            f"box{i}", (0.2, 0.1), (0.0, 0.1 + 0.202 * i, 0.0), restitution=restitution
        )
        for i in range(5)
    ]
    states, info, last = run(spec_of(FLOOR, *boxes), 720)
    # Every second without the impulses of the one before: it sinks a little each time.
    assert np.max(info.overlap[-60:]) < 2e-3
    assert np.max(np.abs(last.twist)) < 1e-3
    standing = 0.1 + 0.2 * np.arange(5)
    np.testing.assert_allclose(states.pose[-1, 1:, 1], standing, rtol=0, atol=5e-3)


@pytest.mark.parametrize("density", [80.0, 200.0])
def test_what_hits_a_box_on_a_floor_bounces_as_off_a_free_one(density):
    """The floor answers the blow after it: from eight heights, by the closed form."""
    restitution, heights = 0.6, np.linspace(0.3, 0.5, 8)
    floor = fixed("floor", (60.0, 0.5), (0.0, -0.5, 0.0), friction=0.5)
    bodies = [floor]
    for number, height in enumerate(heights):
        x = 4.0 * number - 14.0
        lower = body(
            f"box{number}",
            (0.3, 0.1),
            (x, 0.1, 0.0),
            restitution=restitution,
            density=density,
        )
        start = (x, 0.3 + height, 0.0)
        bodies += [lower, body(f"disc{number}", RADIUS, start, restitution=restitution)]
    spec = spec_of(*bodies, dt=1 / 60)
    states, _, _ = run(spec, 36)
    mass = np.array([one.area for one in spec.bodies]) * np.asarray(
        spec.params().density
    )
    light, heavy = mass[2], mass[1]
    share = (restitution * heavy - light) / (light + heavy)
    found = []
    for number, height in enumerate(heights):
        place = states.pose[:, 2 + 2 * number, 1]
        rises = states.twist[:, 2 + 2 * number, 1] > 0.02
        apex = np.max(place[np.argmax(rises) :]) - 0.3
        found.append(apex / (share**2 * height))
    assert np.mean(found) == pytest.approx(1.0, abs=0.05)
    assert np.all(np.abs(np.array(found) - 1.0) < 0.12)
