"""Recognition of a kind by what it does, and pins that hold a thing where it stands."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.models import KnownKinds
from boomdp_jax.models.known_kinds import pinned_where_it_is
from boomdp_jax.physics import State, scene_spec_from_dict, step

from .worlds import cart, learn, only, part, ride

KEY = jax.random.key(0)


def three_kinds():
    """A cart as it is, one with its wheel at the other end, and a heavier one."""
    truth = cart().params()
    turned = dataclasses.replace(
        truth, wheel=dataclasses.replace(truth.wheel, position=-truth.wheel.position)
    )
    heavy = dataclasses.replace(truth, density=1.1 * truth.density)
    kinds = [turned, truth, heavy]
    return KnownKinds(cart().scene, jax.tree.map(lambda *x: jnp.stack(x), *kinds))


def test_a_kind_is_known_by_what_it_does():
    model = three_kinds()
    learnt = learn(model, part(ride(40), 0, 20))
    belief = model.sample(KEY, learnt, 3)
    np.testing.assert_allclose(belief.weight, [0.0, 1.0, 0.0], atol=1e-6)
    drawn = model.sample(KEY, learnt, 2).hypotheses
    np.testing.assert_array_equal(drawn.density[:, 0], 10.0)


def test_the_order_of_steps_does_not_matter_and_gaps_do_not_count():
    model = three_kinds()
    rows = part(ride(40), 0, 12)
    weight = model.log_weight(learn(model, rows))
    backwards = jax.tree.map(lambda leaf: leaf[::-1], rows)
    np.testing.assert_allclose(
        model.log_weight(learn(model, backwards)), weight, rtol=1e-9
    )
    first = model.log_weight(learn(model, part(rows, 0, 5)))
    np.testing.assert_allclose(
        model.log_weight(learn(model, only(rows, 5))), first, rtol=1e-12
    )
    none = model.log_weight(model.init(KEY))
    np.testing.assert_allclose(none, none[0])


def test_a_pin_holds_a_thing_where_it_stands():
    pin = {"type": "revolute", "a": "box", "b": "world"}
    spec = scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": 0.1,
            "bodies": [
                {
                    "name": "box",
                    "pose": [0.0, 0.0, 0.0],
                    "shape": {"type": "box", "half_extents": [0.5, 0.3]},
                    "density": 10.0,
                }
            ],
            "constraints": [{**pin, "anchor_a": [0.3, 0.2], "anchor_b": [0.3, 0.2]}],
        }
    )
    still = State(jnp.array([[2.0, -1.0, 0.7]]), jnp.zeros((1, 3)))
    placed = pinned_where_it_is(spec.params(), still)
    nothing = jnp.zeros((1, 3))
    after, _ = step(spec.scene, placed, still, nothing)
    np.testing.assert_allclose(after.array, still.array, atol=1e-9)
    # As it was, the pin would have pulled it across the room.
    torn, _ = step(spec.scene, spec.params(), still, nothing)
    assert np.abs(np.asarray(torn.pose - still.pose)).max() > 0.5
