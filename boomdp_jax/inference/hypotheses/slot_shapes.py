"""Numbers of one slot of each kind of constraint, as `Params` has them."""

JOINT_SHAPES: dict[str, dict[str, tuple[int, ...]]] = {
    "revolute": {
        "active": (),
        "anchor_a": (2,),
        "anchor_b": (2,),
        "viscous": (),
        "dry": (),
    },
    "distance": {"active": (), "anchor_a": (2,), "anchor_b": (2,), "length": ()},
    "prismatic": {
        "active": (),
        "anchor_a": (2,),
        "anchor_b": (2,),
        "axis": (),
        "angle": (),
        "viscous": (),
        "dry": (),
    },
    "weld": {"active": (), "anchor_a": (2,), "anchor_b": (2,), "angle": ()},
}
"""Of joints, by kind and field."""

BODY_SHAPES: dict[str, dict[str, tuple[int, ...]]] = {
    "wheel": {
        "active": (),
        "position": (2,),
        "heading": (),
        "viscous": (2,),
        "dry": (2,),
        "half_track": (),
    },
    "ground": {
        "active": (),
        "dry": (),
        "viscous": (),
        "torque_share": (),
        "load_shift": (2,),
        "stance_scale": (2,),
        "corner_share": (),
        "diagonal_share": (),
    },
}
"""Of what a body has of its own: wheels and floors."""
