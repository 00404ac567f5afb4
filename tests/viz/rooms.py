"""A room with boxes, a ball and a wall, and a motion in it, for tests of pictures."""

import jax.numpy as jnp

from boomdp_jax.physics import State, scene_spec_from_dict

EVIL = "</script><b>& \\u003c"
"""A name that would end the script that holds it."""


def box(name, x, y, **fields):
    shape = {"type": "box", "half_extents": [0.3, 0.2]}
    return {"name": name, "pose": [x, y, 0], "shape": shape, **fields}


def room_spec(constraints=(), wall="wall"):
    """Two boxes, a ball and a wall."""
    ball = {"shape": {"type": "circle", "radius": 0.25}}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "dt": 0.02,
            "bodies": [
                box("table", 0, 0),
                box("cart", 2, 0),
                {**box("ball", 0, 1.5), **ball},
                box(wall, 1, -1, static=True),
            ],
            "constraints": list(constraints),
        },
        "room.json",
    )


KNOWN = [
    {"type": "revolute", "a": "table", "b": "world"}
    | {"anchor_a": [0.1, 0.0], "anchor_b": [0.1, 0.0]},
    {"type": "distance", "a": "cart", "b": "ball"}
    | {"anchor_a": [0, 0.2], "anchor_b": [0, 0], "length": 2.4},
    {"type": "wheel", "a": "cart", "pose": [-0.1, 0, 1.2], "viscous": [0.1, 9]},
    {"type": "wheel", "a": "table", "pose": None, "viscous": [0.1, 9]},
]


def moving(spec, num_states: int, dt: float = 0.02) -> State:
    """The table goes right at 1 m/s, the cart turns; nothing else moves."""
    time = dt * jnp.arange(num_states)
    pose = jnp.tile(spec.initial_state().pose, (num_states, 1, 1))
    pose = pose.at[:, 0, 0].set(time).at[:, 1, 2].set(3.0 * time)
    return State(pose=pose, twist=jnp.zeros_like(pose))
