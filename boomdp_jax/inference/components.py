"""Which bodies must be inferred together: screening of possible ties and contacts."""

import itertools
from collections.abc import Callable

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.touching import Touching
from boomdp_jax.physics.scene_spec import SceneSpec

# A pair whose best common pin misses by more than this [m], root mean square, is not
# tied: thirty times what a camera resolves.
TIE_TOLERANCE = 0.03


def independent_blocks(
    spec: SceneSpec, history: History, touching: Touching | None = None
) -> tuple[list[tuple[int, ...]], list[str]]:
    """Split the movable bodies of a scene into blocks that do not interact.

    Bodies that may have touched each other belong together, and so do all that may have
    touched anything of which the scene leaves a contact number open: it is one number
    for the whole scene. Known constraints tie bodies for certain.

    A pair that may be tied by an unknown pin
    (or a weld, which is a pin as well) is tested by the least-squares misfit of the
    best common anchors; one that may be tied by an unknown rod, by how much the
    distance of its centres varies beyond what the outlines' radii allow; by an unknown
    drawer, by how far the one leaves a line fixed in the other, or its angle.

    Args:
        spec: the scene.
        history: readings of all its bodies.
        touching: what may have touched; None: nothing collides.

    Returns:
        Blocks of body indices, ascending, static bodies left out; and a note on the
        pairs that were screened out.
    """
    movable = [i for i in range(spec.num_bodies) if not spec.is_static[i]]
    parent = {i: i for i in movable}

    def root(i: int) -> int:
        while parent[i] != i:
            i = parent[i]
        return i

    for constraint in spec.constraints:
        a, b = constraint.body_a, constraint.body_b
        if a in parent and b in parent:
            parent[root(a)] = root(b)
    if touching is not None:
        _join_touching(touching, parent, root)
    dropped = []
    can_pin = spec.unknown.get("revolute", 0) or spec.unknown.get("weld", 0)
    can_rod, can_slide = (spec.unknown.get(k, 0) for k in ("distance", "prismatic"))
    if (can_pin or can_rod or can_slide) and len(movable) > 1:
        rows = np.asarray(history.mask)
        state = np.asarray(history.state, float)[rows]
        seen = np.asarray(history.state_mask)[rows]
        for a, b in itertools.combinations(movable, 2):
            use = np.all(seen[:, [a, b], :3], axis=(1, 2))
            misfit = _pin_misfit(state[use, a], state[use, b])
            is_tied = bool(can_pin) and misfit < TIE_TOLERANCE
            if can_rod and not is_tied:
                is_tied = _may_be_rod(spec, state[use], a, b)
            if can_slide and not is_tied:
                reach = spec.bodies[a].reach
                miss = _slide_misfit(state[use, a], state[use, b], reach)
                is_tied = miss < TIE_TOLERANCE
            if is_tied:
                parent[root(a)] = root(b)
            else:
                dropped.append(f"{spec.names[a]}-{spec.names[b]} ({misfit:.3g} m)")
    blocks: dict[int, list[int]] = {}
    for i in movable:
        blocks.setdefault(root(i), []).append(i)
    notes = [f"pairs taken as not tied (best pin misses by): {', '.join(dropped)}"]
    return sorted(map(tuple, blocks.values())), notes if dropped else []


def _join_touching(touching: Touching, parent: dict, root: Callable) -> None:
    """Join bodies that may have touched, or that share an open contact number."""
    sharing = set()
    for a, b in np.argwhere(touching.pairs).tolist():
        if a in parent and b in parent:
            parent[root(a)] = root(b)
        if a in parent and touching.has_unknown(a, b):
            sharing.add(a)
    for a, b in itertools.pairwise(sorted(sharing)):
        parent[root(a)] = root(b)


def _pin_misfit(a: np.ndarray, b: np.ndarray) -> float:
    """Root mean square miss of the best common pin [m]; zero without data."""
    if len(a) == 0:
        return 0.0
    left, right = _rotations(a[:, 2]), _rotations(b[:, 2])
    matrix = np.concatenate([left, -right], axis=-1).reshape(-1, 4)
    offset = (a[:, :2] - b[:, :2]).reshape(-1)
    solution = np.linalg.lstsq(matrix, -offset, rcond=1e-6)[0]
    return float(np.sqrt(np.mean((matrix @ solution + offset) ** 2)))


def _slide_misfit(a: np.ndarray, b: np.ndarray, reach: float) -> float:
    """Root mean square miss of the best line fixed in b and angle [m].

    An angle counts by how far it moves the outline, which reaches so far.
    """
    if len(a) == 0:
        return 0.0
    place = np.einsum("tji,tj->ti", _rotations(b[:, 2]), a[:, :2] - b[:, :2])
    across = np.linalg.eigvalsh(np.cov(place.T, bias=True))[0]
    angle = a[:, 2] - b[:, 2]
    turn = np.abs(np.mean(np.exp(1j * angle)))
    return float(np.sqrt(max(across, 0.0) + reach**2 * 2.0 * (1.0 - turn)))


def _rotations(angle: np.ndarray) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def _may_be_rod(spec: SceneSpec, state: np.ndarray, a: int, b: int) -> bool:
    """Whether anchors inside reach could keep a distance.

    The distance of two anchors differs from that of the centres by at most both radii.
    """
    if len(state) == 0:
        return True
    distance = np.hypot(*(state[:, a, :2] - state[:, b, :2]).T)
    slack = 2.0 * (spec.bodies[a].reach + spec.bodies[b].reach)
    return bool(np.ptp(distance) < slack)
