"""The flat's furniture: what each piece is, and what an agent is told of it.

Where pieces stand is measured from the picture of Scholz et al. (2014), a pixel being a
centimetre; where they belong was not published. Goals are far enough apart that a piece
fits whichever way its neighbours are turned.
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict


class Piece(NamedTuple):
    """One piece of furniture, a box."""

    name: str
    half_extents: tuple[float, float]
    start: tuple[float, float]
    goal: tuple[float, float]
    density: float
    """[kg/m²]"""
    rate: float
    """Of the floor: force per speed and mass [1/s]."""
    wheels: float | None = None
    """Where fixed wheels are, along the piece [m]."""
    pin: tuple[float, float] | None = None
    """Where it is pinned to the floor, in its own frame [m]."""


_CHAIR = (0.22, 0.22)
PIECES = (
    Piece("piano", (0.75, 0.35), (5.10, 0.89), (4.35, 0.93), 120.0, 20.0),
    Piece("couch", (1.0, 0.45), (3.61, 2.35), (3.1, 2.5), 60.0, 20.0),
    Piece("bed", (0.8, 1.0), (7.27, 2.04), (7.1, 1.35), 45.0, 20.0),
    Piece("dining table", (0.75, 0.45), (1.58, 4.39), (2.1, 4.2), 20.0, 15.0, -0.55),
    Piece("dining chair 1", _CHAIR, (0.45, 4.42), (0.85, 4.2), 25.0, 25.0),
    Piece("dining chair 2", _CHAIR, (3.22, 4.42), (3.4, 4.0), 25.0, 25.0),
    Piece("dining chair 3", _CHAIR, (1.92, 5.28), (2.3, 5.5), 25.0, 25.0),
    Piece("kitchen chair 1", _CHAIR, (1.82, 6.04), (1.2, 6.1), 20.0, 25.0),
    Piece("kitchen chair 2", _CHAIR, (0.88, 6.90), (0.6, 7.4), 20.0, 25.0),
    Piece(
        "kitchen table",
        (0.43, 0.43),
        (1.80, 6.90),
        (2.30, 6.80),
        20.0,
        15.0,
        pin=(0.3, 0.2),
    ),
    Piece("office chair", (0.3, 0.3), (7.14, 6.75), (6.2, 7.2), 20.0, 20.0),
    Piece("desk", (0.75, 0.35), (7.18, 7.95), (7.5, 7.4), 25.0, 15.0, -0.6),
)
WALLS = (
    (4.25, -0.1, 4.45, 0.1),
    (4.25, 8.6, 4.45, 0.1),
    (-0.1, 4.25, 0.1, 4.45),
    (8.6, 4.25, 0.1, 4.45),
)
"""Middle and half extents [m]."""
WHEEL_VISCOUS = (5.0, 900.0)
"""Force per speed, rolling and across [N s/m]."""
VISCOUS_PRIOR = {
    "wheel.lateral_limit": {"center": 100.0},
    "wheel.dry_ratio": {"center": 0.0},
    "wheel.half_track": {"center": 0.02},
    "ground.friction": {"center": 30.0},
    "ground.knee_speed": {"center": 30.0},
}
"""Of the agent: wheels and floor resist in proportion to speed, as in the papers."""
_TIME_STEP = 0.2
_SURFACE = {"friction": 0.3, "restitution": 0.0}


def piece_scene(piece: Piece) -> SceneSpec:
    """What an agent is told of a piece: its outline, and that it stands on a floor."""
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": _TIME_STEP,
            "bodies": [
                {
                    "name": piece.name,
                    "pose": [*piece.start, 0.0],
                    "shape": {"type": "box", "half_extents": list(piece.half_extents)},
                    "density": None,
                }
            ],
            "constraints": [
                {"type": "ground", "a": piece.name, "viscous": None, "dry": None}
            ],
            "unknown": {"revolute": 1, "wheel": 1},
            "prior": VISCOUS_PRIOR,
        },
        piece.name,
    )


def room_scene() -> SceneSpec:
    """The world: all pieces with their true numbers, and four walls."""
    bodies, constraints = [], []
    for piece in PIECES:
        wide, high = piece.half_extents
        bodies.append(
            {
                "name": piece.name,
                "pose": [*piece.start, 0.0],
                "shape": {"type": "box", "half_extents": [wide, high]},
                "density": piece.density,
                "contact": _SURFACE,
            }
        )
        mass = piece.density * 4.0 * wide * high
        constraints.append(
            {"type": "ground", "a": piece.name, "viscous": piece.rate * mass}
        )
        if piece.wheels is not None:
            constraints.append(
                {
                    "type": "wheel",
                    "a": piece.name,
                    "pose": [piece.wheels, 0.0, 0.0],
                    "viscous": list(WHEEL_VISCOUS),
                }
            )
        if piece.pin is not None:
            at = np.add(piece.start, piece.pin).tolist()
            constraints.append(
                {
                    "type": "revolute",
                    "a": piece.name,
                    "b": "world",
                    "anchor_a": list(piece.pin),
                    "anchor_b": at,
                }
            )
    for index, (x, y, wide, high) in enumerate(WALLS):
        bodies.append(
            {
                "name": f"wall {index}",
                "static": True,
                "pose": [x, y, 0.0],
                "shape": {"type": "box", "half_extents": [wide, high]},
                "contact": _SURFACE,
            }
        )
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": _TIME_STEP,
            "bodies": bodies,
            "constraints": constraints,
        },
        "living room",
    )
