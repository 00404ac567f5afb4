"""A film as one HTML page that needs no network: its player, and all data as JSON."""

import importlib.resources
import json
import os
from typing import Any

import numpy as np

from boomdp_jax.core.atomic import atomic_write
from boomdp_jax.physics.constraint_spec import JOINTS
from boomdp_jax.viz.film import Film, nearest_states
from boomdp_jax.viz.joint_marks import wheel_corners
from boomdp_jax.viz.style import BODY, BY_KIND, EDGE, GRID, PREDICTION, STATIC, WHEEL

_PLACE_OF_PROGRAM = "/* player */"
_PLACE_OF_DATA = "/* data */"
_DIGITS = 7
"""Significant digits of lengths, angles and times: finer than any screen."""


def write_player(path: str | os.PathLike, film: Film) -> None:
    """Write the page.

    Args:
        path: file to write.
        film: what to show.
    """
    parts = importlib.resources.files("boomdp_jax.viz")
    page, program = (
        parts.joinpath(name).read_text(encoding="utf-8")
        for name in ("player.html", "player.js")
    )
    # Data last: what a body is called must not be taken for a place to fill.
    page = page.replace(_PLACE_OF_PROGRAM, program, 1)
    page = page.replace(_PLACE_OF_DATA, json_in_page(film_data(film)), 1)
    atomic_write(path, page.encode("utf-8"))


def json_in_page(value: Any) -> str:
    r"""Write JSON that no part of can end the script that holds it.

    Every `<`, `>` and `&` (in a string, as JSON has none elsewhere) becomes an escape
    such as `\u003c`, which reads back as the same text.

    Args:
        value: what JSON can hold.

    Returns:
        The text, in ASCII.
    """
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text


def film_data(film: Film) -> dict[str, Any]:
    """What the player reads.

    Args:
        film: what to show.

    Returns:
        What JSON can hold: bodies with outlines about their centres of mass, joints,
        wheels, colours, and for each frame its time and the poses of all bodies in a
        row.
    """
    shown = np.unique(nearest_states(film.times, 1.0 / film.fps))
    poses = film.poses[shown].reshape(len(shown), -1)
    return {
        "title": film.title,
        "trail": film.has_trail,
        "bounds": _rounded(film.bounds),
        "bodies": [
            {
                "name": body.name,
                "isStatic": body.is_static,
                "radius": float(body.radius),
                "vertices": _rounded(body.vertices),
            }
            for body in film.spec.bodies
        ],
        "links": [
            {
                "kind": link.kind,
                "a": link.body_a,
                "b": link.body_b,
                "anchorA": _rounded(link.anchor_a),
                "anchorB": _rounded(link.anchor_b),
            }
            for link in film.marks.links
        ],
        "wheels": [
            {"body": wheel.body, "corners": _rounded(corners)}
            for wheel in film.marks.wheels
            for corners in wheel_corners(wheel, film.spec)
        ],
        "colours": {
            **{kind: BY_KIND[kind] for kind in JOINTS},
            "wheel": WHEEL,
            "body": BODY,
            "static": STATIC,
            "edge": EDGE,
            "grid": GRID,
            "trail": PREDICTION,
        },
        "times": _rounded(film.times[shown]),
        "poses": _rounded(poses),
    }


def _rounded(array: np.ndarray) -> Any:
    """Nested lists of numbers, no longer than they need be."""

    def shorten(value: Any) -> Any:
        if isinstance(value, list):
            return [shorten(part) for part in value]
        return float(f"{value:.{_DIGITS}g}")

    return shorten(array.tolist())
