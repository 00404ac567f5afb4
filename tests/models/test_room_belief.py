"""What is believed of things: their kinds, their masses, and who never changes."""

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.envs.namo_room import thing_scene
from boomdp_jax.models import FixedRoom, kind_shares
from boomdp_jax.physics.scene_spec import STANDARD_GRAVITY
from tests.envs.namo_rooms import lone_params, room, thing

FORCE = 250.0
WEIGHT = STANDARD_GRAVITY * thing().mass


def needing(force):
    """Friction of a thing that slides under so much force."""
    return thing(kind="free", friction=force / WEIGHT)


def stacked(things):
    parts = [lone_params(one) for one in things]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)


def test_kinds_are_told_by_joints_and_by_the_force_that_it_takes():
    things = [
        needing(0.49 * FORCE),
        needing(0.51 * FORCE),
        needing(0.99 * FORCE),
        needing(1.01 * FORCE),
        thing(kind="wheels", friction=9e9),
        thing(kind="revolute", friction=9e9),
    ]
    weight = np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    scene = thing_scene(thing()).scene
    shares = kind_shares(stacked(things), scene, FORCE, weight)
    wanted = {"free": 1, "heavy": 6, "fixed": 8, "wheels": 16, "revolute": 32}
    assert shares.keys() == wanted.keys()
    for kind, number in wanted.items():
        assert abs(shares[kind] - number / 63.0) < 1e-12


def test_a_fixed_belief_tells_shares_and_mass_and_never_changes():
    things = [thing(density=20.0), thing(density=40.0, kind="wheels")]
    one = room()
    believer = FixedRoom(one, [stacked(things)])
    assert abs(believer.mass(0) - 0.5 * (things[0].mass + things[1].mass)) < 1e-9
    before = believer.belief(0), believer.version(0)
    believer.update(jax.random.key(0), 0, [])
    assert before[0] is believer.belief(0)
    assert before[1] == believer.version(0)
    shares = believer.shares(0)
    assert shares["free"] == shares["wheels"] == 0.5
