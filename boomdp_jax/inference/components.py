"""Which bodies must be inferred together: screening of possible ties and contacts."""

import itertools
from collections.abc import Callable

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.tie_misfit import pin_misfit, rod_range, slide_misfit
from boomdp_jax.inference.touching import Touching
from boomdp_jax.physics.scene_spec import SceneSpec

# A pair whose best common pin misses by more than this [m], root mean square, is not
# tied: thirty times what a camera resolves. Coarser readings are allowed for besides
# (`tie_misfit`).
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
        run = np.asarray(history.episode)[rows]
        for a, b in itertools.combinations(movable, 2):
            use = np.all(seen[:, [a, b], :3], axis=(1, 2))
            pair = state[use, a], state[use, b]
            misfit = pin_misfit(*pair, run[use])
            is_tied = bool(can_pin) and misfit.may_be(TIE_TOLERANCE)
            if can_rod and not is_tied:
                is_tied = _may_be_rod(spec, state[use], a, b, run[use])
            if can_slide and not is_tied:
                miss = slide_misfit(*pair, spec.bodies[a].reach, run[use])
                is_tied = miss.may_be(TIE_TOLERANCE)
            if is_tied:
                parent[root(a)] = root(b)
            else:
                names = f"{spec.names[a]}-{spec.names[b]}"
                dropped.append(f"{names} ({misfit.raw:.3g} m)")
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


def _may_be_rod(
    spec: SceneSpec, state: np.ndarray, a: int, b: int, run: np.ndarray
) -> bool:
    """Whether anchors inside reach could keep a distance.

    The distance of two anchors differs from that of the centres by at most both radii.
    """
    slack = 2.0 * (spec.bodies[a].reach + spec.bodies[b].reach)
    return rod_range(state[:, a], state[:, b], run) < slack or len(state) == 0
