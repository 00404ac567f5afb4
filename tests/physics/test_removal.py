"""Bodies and structures are data: one trace serves all; what is off is not there."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.physics import Params, State, remove_bodies, rollout
from boomdp_jax.physics.scene_spec import scene_spec_from_dict


def make_spec(names):
    """Some of a floor, a box on it, a box that falls onto that, and a pinned bar."""
    boxes = {
        "floor": {"pose": [0, -0.1, 0], "static": True},
        "low": {"pose": [0, 0.1, 0]},
        "high": {"pose": [0.05, 0.45, 0.1]},
        "bar": {"pose": [0.6, 0.5, 0]},
    }
    halves = {"floor": [3, 0.1], "low": [0.2, 0.1], "high": [0.2, 0.1]}
    bodies = [
        {
            "name": name,
            "shape": {"type": "box", "half_extents": halves.get(name, [0.3, 0.02])},
            "density": 10.0,
            "contact": {"friction": 0.5},
            **boxes[name],
        }
        for name in names
    ]
    pin = {
        "type": "revolute",
        "a": "bar",
        "b": "world",
        "anchor_a": [-0.3, 0.0],
        "anchor_b": [0.3, 0.5],
    }
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0, -9.81],
            "dt": 0.02,
            "bodies": bodies,
            "constraints": [pin] if "bar" in names else [],
        }
    )


ALL = ("floor", "low", "high", "bar")


def run(scene, params, state, num_steps=30):
    """Trajectory without wrenches."""
    wrenches = jnp.zeros((num_steps, scene.num_bodies, 3))
    return rollout(scene, params, state, wrenches)[0].array


@pytest.mark.slow
def test_a_removed_body_is_not_there_and_nothing_is_traced_again():
    spec = make_spec(ALL)
    num_traces = 0

    @jax.jit
    def without(is_removed):
        nonlocal num_traces
        num_traces += 1
        scene, params = remove_bodies(spec.scene, spec.params(), is_removed)
        return run(scene, params, spec.initial_state())

    found = {}
    for gone in ((), ("low",), ("bar",), ("low", "bar")):
        is_removed = np.isin(ALL, gone)
        found[gone] = np.asarray(without(jnp.asarray(is_removed)))
    assert num_traces == 1
    for gone, states in found.items():
        kept = [name for name in ALL if name not in gone]
        alone = make_spec(kept)
        expected = run(alone.scene, alone.params(), alone.initial_state())
        index = [ALL.index(name) for name in kept]
        # Pairs take turns in another order, on which twists after an impact depend.
        np.testing.assert_allclose(states[:, index, :3], expected[..., :3], atol=5e-3)
        start = np.asarray(spec.initial_state().pose)
        for name in gone:
            np.testing.assert_array_equal(
                states[:, ALL.index(name), :3],
                np.broadcast_to(start[ALL.index(name)], (30, 3)),
            )


@pytest.mark.slow
def test_a_removed_body_might_as_well_be_far_away():
    spec, gone = make_spec(ALL), ALL.index("low")
    scene, params = remove_bodies(
        spec.scene, spec.params(), jnp.arange(len(ALL)) == gone
    )
    start = spec.initial_state()
    away = State(start.pose.at[gone, :2].set(500.0), start.twist)
    move = jax.jit(lambda state: run(scene, params, state))
    others = [i for i in range(len(ALL)) if i != gone]
    np.testing.assert_array_equal(move(start)[:, others], move(away)[:, others])


def test_structures_are_masks_and_nothing_is_traced_again():
    spec = make_spec(("bar",))
    num_traces = 0

    @jax.jit
    @jax.vmap
    def end(is_pinned):
        nonlocal num_traces
        num_traces += 1
        params = spec.params()
        pin = params.revolute
        pin = type(pin)(**{**vars(pin), "active": is_pinned[None]})
        params = Params(**{**vars(params), "revolute": pin})
        return run(spec.scene, params, spec.initial_state())[-1]

    for flags in ([True, False, True], [False, False, True]):
        states = np.asarray(end(jnp.asarray(flags)))
        falls = 0.5 - 0.5 * 9.81 * (30 * 0.02) ** 2
        for flag, state in zip(flags, states, strict=True):
            is_fallen = abs(state[0, 1] - falls) < 1e-9
            assert is_fallen != flag
    assert num_traces == 1


@pytest.mark.slow
def test_a_removed_partner_frees_its_joint():
    content = make_spec(("bar", "low")).to_dict()
    content["constraints"][0] |= {"b": "low", "anchor_b": [0.3, 0.4]}
    spec = scene_spec_from_dict(content)
    is_removed = jnp.asarray([False, True])
    scene, params = remove_bodies(spec.scene, spec.params(), is_removed)
    assert not np.any(np.asarray(params.revolute.active))
    states = run(scene, params, State(*jax.tree.leaves(spec.initial_state())))
    falls = 0.5 - 0.5 * 9.81 * (30 * 0.02) ** 2
    np.testing.assert_allclose(states[-1, 0, 1], falls, atol=1e-9)
