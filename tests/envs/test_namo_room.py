"""What a room is made of, and what is none."""

import math

import numpy as np
import pytest

from boomdp_jax.envs import check_room, make_world, room_scene
from boomdp_jax.envs.namo_room import KINDS, room_params, thing_scene
from boomdp_jax.physics.quantities import mass_and_inertia
from tests.envs.namo_rooms import room, thing


def all_kinds():
    """A room with one thing of each kind."""
    return room(
        things=tuple(
            thing(name=kind, kind=kind, axle=(0.1, 0.0, 0.2), pin=(0.2, 0.1))
            for kind in KINDS
        )
    )


def test_each_kind_is_held_by_what_its_name_says():
    one = all_kinds()
    spec = room_scene(one)
    params = room_params(one, spec)
    held = {
        "ground": {KINDS[i] for i in np.flatnonzero(params.ground.active[:, 0])},
        "wheel": {KINDS[i] for i in np.flatnonzero(params.wheel.active[:, 0])},
        "pin": {
            KINDS[int(body)]
            for body, is_on in zip(
                params.revolute.body_a, params.revolute.active, strict=True
            )
            if is_on
        },
    }
    wanted = {"ground": {"free", "heavy"}, "wheel": {"wheels"}, "pin": {"revolute"}}
    assert held == wanted
    is_static = np.asarray(spec.scene.is_static)
    np.testing.assert_array_equal(is_static[:5], [k == "fixed" for k in KINDS])
    assert not is_static[5]
    assert is_static[6:].all()
    # A pin holds a thing where the thing is.
    one = room(thing(kind="revolute", pin=(0.2, 0.1), pose=(2.0, 1.0, math.pi / 2)))
    params = room_params(one, room_scene(one))
    np.testing.assert_allclose(params.revolute.anchor_b[0], [1.9, 1.2])
    assert not params.weld.active.any()


def test_masses_are_those_of_densities_and_the_robots_own():
    one = all_kinds()
    spec = room_scene(one)
    mass, inertia = mass_and_inertia(spec.scene, room_params(one, spec))
    np.testing.assert_allclose(mass[0], 40.0 * 0.6 * 0.5)
    assert abs(one.things[0].mass - float(mass[0])) < 1e-12
    np.testing.assert_allclose(inertia[0], mass[0] * (0.3**2 + 0.25**2) / 3.0)
    np.testing.assert_allclose(mass[5], one.robot.mass)
    disc = thing(outline=(0.5,))
    assert abs(disc.mass - 40.0 * math.pi * 0.25) < 1e-12
    assert disc.reach == 0.5


def test_nothing_that_is_told_of_a_thing_tells_its_kind_or_numbers():
    told = [
        thing_scene(thing(kind=kind, density=density, friction=friction))
        for kind, density, friction in zip(KINDS, range(1, 6), range(1, 6), strict=True)
    ]
    assert all(spec.to_dict() == told[0].to_dict() for spec in told)


def test_rooms_that_are_some_are_let_through():
    assert check_room(all_kinds()) == all_kinds()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"walls": room().walls[:3]}, r"walls: expected four .* at least, got 3"),
        (
            {"walls": (*room().walls, (1.0, 1.0, 1.0, 2.0))},
            r"walls\[6\]: expected greatest x and y above the least, got \(1\.0",
        ),
        (
            {"things": (thing(kind="sticky"),)},
            "'box': kind: expected one .*'sticky'",
        ),
        ({"things": (thing(label="bed"),)}, "'box': label: expected one of .*'bed'"),
        (
            {"things": (thing(outline=(0.3, -0.2)),)},
            r"'box': outline: expected a radius or two half extents.*-0\.2",
        ),
        ({"things": (thing(outline=(1.0, 1.0, 1.0)),)}, "'box': outline: expected"),
        (
            {"things": (thing(density=0.0),)},
            r"'box': density: expected a positive number, got 0\.0",
        ),
        (
            {"things": (thing(friction=math.inf),)},
            "'box': friction: expected a positive number, got inf",
        ),
        ({"things": (thing(), thing())}, "'box': name: expected one of its own"),
        ({"things": (thing(name="robot"),)}, "'robot': name: expected one of its own"),
        (
            {"robot": room().robot._replace(force=0.0)},
            r"robot: force: expected a positive number, got 0\.0",
        ),
        ({"start": (-1.0, 2.0)}, r"start: expected a place between .* got \[-1\.0"),
        ({"goal": (1.0, 4.5)}, r"goal: expected a place between .* got \[1\.0, 4\.5"),
        (
            {"things": (thing(pose=(5.5, math.nan, 0.0)),)},
            r"'box': pose: expected finite numbers, got \(5\.5, nan, 0\.0\)",
        ),
        (
            {"things": (thing(kind="wheels", axle=(math.nan, 0.0, 0.0)),)},
            r"'box': axle: expected finite numbers, got \(nan, 0\.0, 0\.0\)",
        ),
        (
            {"things": (thing(pose=(7.0, 0.5, 0.0)),)},
            r"'box': pose: expected its middle between \[0\.0, 0\.0\] .* got \[7\.0",
        ),
        (
            {"things": (thing(pose=(1.5, 2.0, 0.0)),)},
            r"'box': pose: expected 0\.35 m from the robot's start at .* got 0\.2 m",
        ),
        (
            {"start": (0.2, 2.0)},
            r"start: expected the robot's radius of 0\.35 m .* 0\.2 m from walls\[0\]",
        ),
        (
            {"goal": (3.1, 1.0)},
            r"goal: expected the robot's .* got -0\.1 m from wa",
        ),
        (
            {"walls": tuple(room().walls[i] for i in (2, 3, 0, 1, 4, 5))},
            r"^walls: expected left, bottom, right and top first, .* got \[6\.2, 4",
        ),
    ],
)
def test_what_is_no_room_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_world(room(**changes))
