"""A belief that is warmed up compiles nothing when transitions come."""

import itertools

import jax
import numpy as np
import pytest

from boomdp_jax.core.compile_time import CompileClock
from boomdp_jax.inference import OnlineBelief
from boomdp_jax.inference.online.warm_up import walk
from boomdp_jax.physics import scene_spec_from_dict, step


def scene(**more):
    box = {"name": "box", "shape": {"type": "box", "half_extents": [0.3, 0.2]}, **more}
    wall = {
        "name": "wall",
        "static": True,
        "pose": [2.0, 0.0, 0.0],
        "shape": {"type": "box", "half_extents": [0.1, 1.0]},
    }
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.05,
            "bodies": [box, wall],
            "unknown": {"revolute": 1, "ground": 1},
        }
    )


def test_what_it_is_tried_on_can_happen():
    spec = scene()
    rows = list(itertools.islice(walk(spec), 5))
    for before, wrench, after in rows:
        assert np.all(np.isfinite(before.array)) & np.all(np.isfinite(wrench))
        assert np.any(before.pose[0] != after.pose[0])
        np.testing.assert_array_equal(before.array[1], after.array[1])
        np.testing.assert_array_equal(wrench[1], 0.0)
    for (_, _, one), (other, _, _) in itertools.pairwise(rows):
        np.testing.assert_array_equal(one.array, other.array)


@pytest.mark.slow
def test_nothing_is_compiled_after_it():
    spec = scene()
    settings = {"capacity": 32, "num_particles": 64, "num_noise_levels": 1}
    belief_filter = OnlineBelief(spec, **settings)
    with CompileClock() as first:
        belief_filter.warm_up()
    truth, key = scene(density=20.0).params(), jax.random.key(3)
    state = next(walk(spec))[0]
    advance = jax.jit(step)
    rows = []
    for number in range(10):
        wrench = 4.0 * jax.random.normal(jax.random.fold_in(key, number), (2, 3))
        after, _ = advance(spec.scene, truth, state, wrench)
        rows.append((state, wrench, after))
        state = after
    with CompileClock() as later:
        belief = belief_filter.init(key)
        for number, row in enumerate(rows):
            belief, _ = belief_filter.step(belief, *row)
            if number >= 5:
                belief, _ = belief_filter.refit(belief)
        belief_filter.sample_params(key, belief, 8)
    assert first.seconds > 1.0
    assert later.seconds < 0.05 * first.seconds
    with CompileClock() as again:
        OnlineBelief(spec, **settings).warm_up()
    assert again.seconds < 0.05 * first.seconds
