"""Steps over collisions against closed forms, and the search for first touches."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.inference.hypotheses.contact_prediction import (
    ContactScene,
    contact_step,
    first_impact,
)
from boomdp_jax.inference.hypotheses.first_touch import (
    NEVER,
    PARTING,
    sort_pairs,
    touch_times,
)
from boomdp_jax.physics import Params, empty_params, scene_spec_from_dict, separation
from boomdp_jax.physics.state import State
from tests.inference.two_discs import (
    DT,
    RADIUS,
    approaching,
    discs_spec,
    state_at,
)

AREA = np.pi * RADIUS**2
STILL = jnp.zeros((2, 3))


class Case(NamedTuple):
    """A collision within the next step but so many."""

    start: np.ndarray
    numbers: tuple[float, float, float, float]
    touch: float


def cases(seed: int, num: int) -> list[Case]:
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(num):
        touch = rng.uniform(0.0, 3.0 * DT)
        masses = np.exp(0.7 * rng.standard_normal(2))
        numbers = (*masses, rng.uniform(0.1, 1.0), rng.uniform(0.0, 0.6))
        out.append(Case(approaching(rng, touch), numbers, touch))
    return out


def scene_of(case: Case) -> tuple[ContactScene, Params]:
    m, n, restitution, friction = case.numbers
    spec = discs_spec(
        density=(m / AREA[0], n / AREA[1]),
        contact={"friction": friction, "restitution": restitution},
    )
    world = ContactScene(
        spec.scene,
        jnp.zeros((0, 3)),
        sort_pairs([(0, 1)], np.array([True, True])),
        spec.scene,
    )
    return world, spec.params()


def stacked(each: list):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


@pytest.mark.slow
def test_steps_over_a_collision_agree_with_the_closed_form():
    tried = cases(1, 64)
    worlds, params = map(stacked, zip(*(scene_of(case) for case in tried), strict=True))
    state = jnp.stack([jnp.asarray(case.start) for case in tried])
    advance = jax.jit(
        jax.vmap(lambda w, p, s: contact_step(w, p, s, STILL, jnp.asarray(DT)))
    )
    for number in range(1, 6):
        state = advance(worlds, params, state)
        exact = [state_at(case.start, case.numbers, number * DT) for case in tried]
        miss = np.abs(np.asarray(state) - np.stack(exact))
        # They stay together for up to 0.04 ms, at up to 1.5 m/s, on centimetres.
        assert miss[..., :2].max() < 1.5e-4
        assert miss[..., 2].max() < 1e-3
        if number >= 3:
            assert miss[..., 3:5].max() < 1e-3
            assert miss[..., 5].max() < 2e-2


@pytest.mark.slow
@pytest.mark.parametrize("touch", [-0.04, 0.02, 0.5, 0.98, 1.04])
def test_neighbours_of_an_estimate_collide_when_it_does(touch):
    """What becomes of a state is smooth in it, wherever in a step it collides."""
    case = cases(2, 1)[0]
    start = approaching(np.random.default_rng(3), touch * DT)
    case = case._replace(start=start)
    world, params = scene_of(case)
    length = jnp.asarray(DT)
    impact = jnp.zeros((2, 2), bool)
    if touch < 1.0:
        impact = first_impact(world, params, jnp.asarray(start), STILL, length)
        assert bool(impact[0, 1])
    rng = np.random.default_rng(4)
    scale = np.array([1e-3, 1e-3, 5e-3, 4e-3, 4e-3, 2e-2])
    near = start + scale * rng.standard_normal((16, 2, 6))
    forward = jax.jit(
        jax.vmap(
            lambda s, i: contact_step(world, params, s, STILL, length, i), (0, None)
        )
    )
    after = forward(jnp.asarray(near), impact)
    if touch > 1.0:
        # The estimate collides at the beginning of the next step.
        base = np.stack([start[i, :3] + DT * start[i, 3:] for i in range(2)])
        middle = jnp.asarray(np.concatenate([base, start[:, 3:]], axis=-1))
        impact = first_impact(world, params, middle, STILL, length)
        assert bool(impact[0, 1])
    else:
        impact = jnp.zeros((2, 2), bool)
    after = np.asarray(forward(after, impact))
    exact = np.stack([state_at(s, case.numbers, 2.0 * DT) for s in near])
    miss = np.abs(after - exact)
    assert miss[..., :2].max() < 1.5e-4
    assert miss[..., 3:5].max() < 2e-3


@pytest.mark.slow
def test_a_disc_bounces_off_a_wall():
    """Against a wall the closed form is that of one disc."""
    contact = {"friction": 0.2, "restitution": 0.6}
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "bodies": [
                {
                    "name": "ball",
                    "shape": {"type": "circle", "radius": 0.1},
                    "contact": contact,
                    "density": 20.0,
                },
                {
                    "name": "wall",
                    "shape": {"type": "box", "half_extents": [0.05, 2.0]},
                    "pose": [1.0, 0.0, 0.0],
                    "contact": contact,
                    "static": True,
                },
            ],
        }
    )
    surface = spec.params().surface
    params = dataclasses.replace(empty_params(1, density=20.0), surface=surface)
    world = ContactScene(
        spec.scene,
        jnp.array([[1.0, 0.0, 0.0]]),
        sort_pairs([(0, 1)], np.array([True, False])),
        spec.scene,
    )
    # The wall's face is at 0.95; the ball meets it after 0.37 of the step.
    share, speed, along, spin = 0.37, 1.2, 0.9, 3.0
    begin = [0.85 - share * DT * speed, 0.3, 0.0, speed, along, spin]
    found = contact_step(
        world, params, jnp.array([begin]), jnp.zeros((1, 3)), jnp.asarray(DT)
    )
    # The point of contact slides at along + spin * r, more than friction can stop.
    rub = -0.2 * 1.6 * speed
    after = np.array([-0.6 * speed, along + rub, spin + rub * 0.1 / (0.5 * 0.1**2)])
    rest = (1.0 - share) * DT
    place = [0.85, 0.3 + share * DT * along, share * DT * spin]
    expected = np.concatenate([np.array(place) + rest * after, after])
    np.testing.assert_allclose(found[0], expected, atol=3e-4)


SHAPES = {
    "disc": {"type": "circle", "radius": 0.15},
    "box": {"type": "box", "half_extents": [0.2, 0.1]},
    "triangle": {"type": "polygon", "vertices": [[-0.2, -0.1], [0.2, -0.1], [0, 0.2]]},
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second"),
    [("disc", "disc"), ("disc", "box"), ("triangle", "box"), ("triangle", "disc")],
)
def test_outlines_are_in_touch_when_they_first_touch(first, second):
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": DT,
            "bodies": [
                {"name": name, "shape": SHAPES[shape], "density": 1.0}
                for name, shape in (("a", first), ("b", second))
            ],
        }
    )
    scene = spec.scene
    sorts = sort_pairs([(0, 1)], np.asarray(scene.radius) > 0)
    rng = np.random.default_rng(5)
    pose = np.zeros((64, 2, 3))
    pose[:, 1, 0] = 0.55
    pose[:, 1, 1] = rng.uniform(-0.1, 0.1, 64)
    pose[..., 2] = rng.uniform(-np.pi, np.pi, (64, 2))
    twist = rng.uniform(-0.2, 0.2, (64, 2, 3))
    twist[:, 0, 0] += 2.0

    def distance(place):
        return separation(scene, State(place, jnp.zeros_like(place)))[0, 1]

    time = jax.vmap(lambda p, v: touch_times(scene, p, v, 0.0 * v, sorts)[0, 1])(
        pose, twist
    )
    there = jax.vmap(distance)(pose + np.asarray(time)[:, None, None] * twist)
    # By half the way they are still apart: it is their first touch.
    half = jax.vmap(distance)(pose + 0.5 * np.asarray(time)[:, None, None] * twist)
    assert np.all((np.asarray(time) > 0.0) & (np.asarray(time) < 0.3))
    np.testing.assert_allclose(there, 0.0, atol=1e-6)
    assert np.all(np.asarray(half) > 1e-3)


def test_gravity_is_counted_in_when_a_disc_falls():
    spec = discs_spec(density=(1.0, 1.0))
    sorts = sort_pairs([(0, 1)], np.array([True, True]))
    pose = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]])
    twist = jnp.zeros((2, 3)).at[1, 1].set(-0.5)
    fall = jnp.zeros((2, 3)).at[1, 1].set(-9.81)
    time = float(touch_times(spec.scene, pose, twist, fall, sorts)[0, 1])
    assert 0.5 * time + 0.5 * 9.81 * time**2 == pytest.approx(0.2 - RADIUS.sum())


def test_outlines_that_part_or_rest_do_not_touch():
    spec = discs_spec(density=(1.0, 1.0))
    sorts = sort_pairs([(0, 1)], np.array([True, True]))
    pose = jnp.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])

    def time(speed):
        twist = jnp.zeros((2, 3)).at[1, 0].set(speed)
        return float(touch_times(spec.scene, pose, twist, 0.0 * twist, sorts)[0, 1])

    assert time(1.0) == PARTING
    assert time(0.0) == NEVER
    assert time(-1.0) == pytest.approx(0.3 - RADIUS.sum())
