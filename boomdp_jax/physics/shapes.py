"""Area, centroid and second moments of convex outlines, and where they stand."""

import dataclasses

import numpy as np
from jaxtyping import Float

_ANGLE_TOLERANCE = 1e-9
"""Turn at a corner that still counts as straight [rad]; covers rounding in files."""


@dataclasses.dataclass(frozen=True, eq=False)
class ShapeMoments:
    """What a uniform density makes of an outline, per unit of density."""

    area: float
    """Area of the outline [m²]."""
    centroid: Float[np.ndarray, "2"]
    """Centre of the area, outline frame [m]."""
    covariance: Float[np.ndarray, "2 2"]
    """Mean of the outer product of positions about the centroid [m²]."""
    reach: float
    """Mean distance from the centroid [m]."""

    @property
    def gyration(self) -> float:
        """Squared radius of gyration about the centroid, inertia over mass [m²]."""
        return float(np.trace(self.covariance))


def polygon_moments(vertices: Float[np.ndarray, "vertex 2"]) -> ShapeMoments:
    r"""Integrate over a polygon, as a fan of triangles from its first corner.

    With corners $p_i$ relative to the first one and $c_i = p_i \times p_{i+1}$,
    $$A = \tfrac12 \sum_i c_i, \quad A\,\bar p = \tfrac16 \sum_i c_i (p_i + p_{i+1}),
    \quad \int p\,p^T = \tfrac1{24} \sum_i c_i
        (2 p_i p_i^T + 2 p_{i+1} p_{i+1}^T + p_i p_{i+1}^T + p_{i+1} p_i^T).$$

    Args:
        vertices: corners, counter-clockwise [m].

    Returns:
        The moments of the polygon.
    """
    p = vertices - vertices[0]
    q = np.roll(p, -1, axis=0)
    c = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    area = 0.5 * np.sum(c)
    centre = np.einsum("i,ij->j", c, p + q) / (6.0 * area)
    second = 2.0 * _weighted_outer(c, p, p) + 2.0 * _weighted_outer(c, q, q)
    second = second + _weighted_outer(c, p, q) + _weighted_outer(c, q, p)
    covariance = second / (24.0 * area) - np.outer(centre, centre)
    return ShapeMoments(
        float(area), vertices[0] + centre, covariance, _mean_distance(p - centre, area)
    )


def _mean_distance(corners: Float[np.ndarray, "vertex 2"], area: float) -> float:
    r"""Mean distance of a polygon's points from the origin, which lies within.

    Over the triangle of the origin and an edge at distance h from it, whose points have
    coordinates t along it: $\tfrac h3 \int \sqrt{h^2 + t^2}\,dt$.
    """
    ends = np.roll(corners, -1, axis=0)
    along = (ends - corners) / np.linalg.norm(ends - corners, axis=1, keepdims=True)
    height = corners[:, 0] * along[:, 1] - corners[:, 1] * along[:, 0]

    def integral(t: np.ndarray) -> np.ndarray:
        return t * np.hypot(height, t) + height**2 * np.arcsinh(t / height)

    begin, end = (np.sum(p * along, axis=1) for p in (corners, ends))
    return float(np.sum(height * (integral(end) - integral(begin))) / (6.0 * area))


def circle_moments(radius: float) -> ShapeMoments:
    r"""Moments of a disc: $A = \pi r^2$, $r^2/4$ along each axis, reach $2r/3$.

    Args:
        radius: radius of the disc [m].

    Returns:
        The moments of the disc.
    """
    return ShapeMoments(
        float(np.pi * radius**2),
        np.zeros(2),
        np.eye(2) * radius**2 / 4.0,
        2.0 * radius / 3.0,
    )


def box_outline(half_extents: Float[np.ndarray, "2"]) -> Float[np.ndarray, "4 2"]:
    """Corners of a rectangle about the origin, counter-clockwise.

    Args:
        half_extents: half of its width and of its height [m].

    Returns:
        The corners, from the lower left one [m].
    """
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return signs * half_extents


def check_outline(vertices: Float[np.ndarray, "vertex 2"]) -> None:
    """Make sure that an outline is convex, counter-clockwise and has an area.

    Corners on a straight edge are allowed, corners that coincide are not.

    Args:
        vertices: corners of the outline [m].

    Raises:
        ValueError: what the outline is instead.
    """
    if len(vertices) < 3:
        raise ValueError(f"expected at least 3 corners, got {len(vertices)}")
    edges = np.roll(vertices, -1, axis=0) - vertices
    lengths = np.hypot(edges[:, 0], edges[:, 1])
    if not np.all(lengths > 0):
        corner = int(np.argmin(lengths))
        raise ValueError(
            f"expected distinct corners, got {vertices[corner].tolist()} twice"
        )
    before, after = edges / lengths[:, None], np.roll(edges / lengths[:, None], -1, 0)
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.arctan2(cross, np.sum(before * after, axis=-1))
    if np.isclose(np.sum(turn), -2.0 * np.pi) and np.all(turn <= _ANGLE_TOLERANCE):
        raise ValueError("expected corners counter-clockwise, got them clockwise")
    is_left = (turn >= -_ANGLE_TOLERANCE) & (turn < np.pi - _ANGLE_TOLERANCE)
    if not np.all(is_left):
        corner = (int(np.argmin(is_left)) + 1) % len(vertices)
        raise ValueError(
            "expected a convex outline, counter-clockwise, got one that turns in at "
            f"corner {corner}, {vertices[corner].tolist()}"
        )
    if not np.isclose(np.sum(turn), 2.0 * np.pi):
        raise ValueError("expected a convex outline, got one that winds more than once")


_FEET_ABREAST = 3
"""Feet along each principal axis."""
_RING = 0.681
"""Radius of the ring over that of the disc, which is 3/2 of its reach: the one that is
nearest to the friction of slow motions of all ratios of spin to speed (1.2 % off, root
mean square; three by three feet 1.6 %)."""
CORNER_FEET = np.array([0, 2, 6, 8])
"""Which of `support_feet` are the outermost ones."""
_FOOT_PLACE = 0.95
"""Where they stand, over the middles of equal parts of a box of the same moments."""


def support_feet(
    moments: ShapeMoments, *, is_round: bool = False
) -> tuple[Float[np.ndarray, "9 2"], float]:
    """Nine feet that rub almost as the whole area does under an even pressure.

    They stand about the middles of three by three equal parts of the outline, in a disc
    in a ring and in its middle, and are so large that under equal loads the friction
    torque of a pure spin is that of the whole area. Friction of slow motions, of all
    ratios of spin to speed, is then 1 to 2 % off for discs and boxes of up to 2 to 1,
    root mean square, and 3 % for triangles and boxes of 4 to 1. (Six feet: 2 to 4 %.
    Four: 3 to 6 %. Four points with the moments of the outline: 10 to 16 %. Of sixteen
    discs and boxes under an even pressure, pushed until they slip, twelve had a wheel
    for certain by those points, none by nine feet.) Used where a body gives no feet.

    Args:
        moments: moments of the outline.
        is_round: whether it is a disc.

    Returns:
        The feet about the centre of mass, along the outline's axes, and the size of
        each (`Scene.foot_size`) [m].
    """
    squares, axes = np.linalg.eigh(moments.covariance)
    half = np.sqrt(3.0 * np.maximum(squares, 0.0))
    middles = (2.0 * np.arange(_FEET_ABREAST) + 1.0) / _FEET_ABREAST - 1.0
    grid = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    feet = _FOOT_PLACE * grid * half
    if is_round:
        far = np.hypot(*grid.T)
        feet = _RING * 1.5 * moments.reach * grid / np.maximum(far, 1e-9)[:, None]
    square = np.sum(feet**2, axis=1)
    # What they are too short of, by bisection: the mean grows with the size.
    least, most = 0.0, moments.reach
    for _ in range(60):
        size = 0.5 * (least + most)
        is_less = np.mean(np.sqrt(square + size**2)) < moments.reach
        least, most = (size, most) if is_less else (least, size)
    return feet @ axes.T, least


def foot_loads(feet: Float[np.ndarray, "foot 2"]) -> Float[np.ndarray, " foot"]:
    """Shares of the weight that balance about the centre of mass.

    Of all shares whose centre is the centre of mass, the most even ones (least sum of
    squares); a foot that would have to pull carries nothing. Where no shares balance
    (the body leans on something else as well) all feet carry the same.

    Args:
        feet: feet relative to the centre of mass [m].

    Returns:
        The shares, which sum to one.
    """
    num_feet, reach = len(feet), np.max(np.abs(feet), initial=1e-12)
    rows = np.concatenate([np.ones((num_feet, 1)), feet / reach], axis=1).T
    carries = np.ones(num_feet, bool)
    while np.any(carries):
        load = np.zeros(num_feet)
        load[carries] = np.linalg.pinv(rows[:, carries]) @ np.array([1.0, 0.0, 0.0])
        if not np.allclose(rows @ load, [1.0, 0.0, 0.0], atol=1e-9):
            break
        if np.all(load >= -1e-12):
            return np.maximum(load, 0.0) / np.sum(np.maximum(load, 0.0))
        carries[np.argmin(load)] = False
    return np.full(num_feet, 1.0 / num_feet)


def diagonal_loads(
    feet: Float[np.ndarray, "foot 2"], load: Float[np.ndarray, " foot"]
) -> Float[np.ndarray, " foot"]:
    r"""How loads may change as those of a table do that rocks on its four legs.

    Of all changes that leave the sum of the loads and their centre as they are, the one
    nearest to one that goes as the product of the coordinates along the feet's own
    axes; four legs have no other.

    Args:
        feet: feet relative to the centre of mass [m].
        load: shares of the weight on them.

    Returns:
        The change over the load, at most one in size; all zero where there is none.
    """
    carries = load > 1e-9
    places = feet[carries] - load @ feet
    none = np.zeros(len(feet))
    if len(places) < 4:
        return none
    reach = np.max(np.abs(places))
    rows = np.concatenate([np.ones((len(places), 1)), places / reach], axis=1).T
    _, axes = np.linalg.eigh(places.T @ (load[carries, None] * places))
    along = places @ axes
    wanted = load[carries] * along[:, 0] * along[:, 1] / reach**2
    if len(places) == 4:
        wanted = np.linalg.svd(rows)[2][-1]
    change = wanted - np.linalg.pinv(rows) @ (rows @ wanted)
    if not np.max(np.abs(change)) > 1e-6 * np.max(load):
        return none
    none[carries] = change / load[carries]
    return none / none[np.argmax(np.abs(none))]


def longer_axis(moments: ShapeMoments) -> float:
    """Direction of the longer principal axis of an outline [rad].

    Args:
        moments: moments of the outline.
    """
    (xx, xy), (_, yy) = moments.covariance
    if np.hypot(xx - yy, 2.0 * xy) < 1e-9 * (xx + yy):
        return 0.0
    return 0.5 * float(np.arctan2(2.0 * xy, xx - yy))


def _weighted_outer(
    weight: Float[np.ndarray, " vertex"],
    left: Float[np.ndarray, "vertex 2"],
    right: Float[np.ndarray, "vertex 2"],
) -> Float[np.ndarray, "2 2"]:
    return np.einsum("i,ij,ik->jk", weight, left, right)
