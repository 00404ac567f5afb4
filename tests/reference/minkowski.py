"""Signed distance of convex outlines by another road than the engine's.

Two sets overlap where the set of all differences of their points holds the origin; the
origin's distance from that set's rim is the distance between the two, or the depth.
"""

import numpy as np
from scipy.spatial import ConvexHull


def signed_distance(
    corners_a: np.ndarray, corners_b: np.ndarray, radius: float = 0.0
) -> float:
    """Distance between two outlines, or minus their depth, less a radius [m].

    Corners are in the world; a circle is its centre, its radius part of `radius`. At
    least one outline must be a polygon.
    """
    differences = (corners_a[:, None] - corners_b[None]).reshape(-1, 2)
    hull = ConvexHull(differences)
    inside = float(np.max(hull.equations[:, 2]))
    if inside <= 0:
        return inside - radius
    nearest = min(_from_segment(*hull.points[ends]) for ends in hull.simplices)
    return nearest - radius


def _from_segment(start: np.ndarray, end: np.ndarray) -> float:
    """Distance of the origin from a segment."""
    along = end - start
    share = np.clip(-start @ along / (along @ along), 0.0, 1.0)
    return float(np.hypot(*(start + share * along)))
