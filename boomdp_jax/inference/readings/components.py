"""Which bodies must be inferred together: screening of possible ties and contacts."""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from boomdp_jax.core.history import History
from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.readings.tie_misfit import (
    pin_distances,
    pin_misfit,
    rod_range,
    slide_misfit,
)
from boomdp_jax.inference.readings.tie_tracks import Tracks, bridged_tracks
from boomdp_jax.inference.readings.touching import Touching
from boomdp_jax.inference.readings.untold_ties import Untold, find_untold, untold_notes
from boomdp_jax.physics.constraint_spec import JOINTS
from boomdp_jax.physics.scene_spec import SceneSpec

# A pair whose best common pin misses by more than this [m], root mean square, is not
# tied: thirty times what a camera resolves. Coarser readings are allowed for besides
# (`tie_misfit`).
TIE_TOLERANCE = 0.03
# Without angles pins are looked for up to so many times as far from a centre as its
# outline reaches: a hinge beside a door, and room for doubt.
_WIDEST_SPAN = 2.0
# Sds, of where a pin is expected about a centre, beyond which there is none: of two
# numbers one in 3,000 is farther off.
_FARTHEST_PIN = 4.0


class _Tested(NamedTuple):
    """What readings say of a tie between two bodies."""

    is_tied: bool
    """Whether there may be one."""
    misfit: float | None = None
    """What the best pin misses by [m]; None: only their distance could be looked at."""
    far: float | None = None
    """How far from a centre the best pin is [m], if that rules it out."""


class _Link(NamedTuple):
    """Two bodies that are inferred together, and why."""

    body_a: int
    body_b: int
    why: str


def independent_blocks(
    spec: SceneSpec,
    history: History,
    touching: Touching | None = None,
    *,
    is_complete: bool = True,
) -> tuple[list[tuple[int, ...]], list[str]]:
    """Split the movable bodies of a scene into blocks that do not interact.

    Bodies that may have touched each other belong together, and so do all that may have
    touched anything of which the scene leaves a contact number open: it is one number
    for the whole scene. Known constraints tie bodies for certain.

    A pair that may be tied by an unknown pin (or a weld, which is a pin as well) is
    tested by the least-squares misfit of the best common anchors, and where one of the
    two is at rest by how far those are from the centres; one that may be tied by an
    unknown rod, by how much the distance of its centres varies beyond what the
    outlines' radii allow; by an unknown drawer, by how far the one leaves a line fixed
    in the other, or its angle. Where the two were read in turn, poses between readings
    are tested as well (`tie_tracks`); where an angle was never read, whether the
    centres are too far apart for a pin.

    No pair is tied where the prior has no ties, and none of which no reading could tell
    a tie (`untold_ties`).

    Args:
        spec: the scene.
        history: readings of all its bodies.
        touching: what may have touched; None: nothing collides.
        is_complete: whether no more readings will come: pairs of which nothing tells
            are then not tied.

    Returns:
        Blocks of body indices, ascending, static bodies left out; and notes on the
        pairs that were screened out.
    """
    movable = [i for i in range(spec.num_bodies) if not spec.is_static[i]]
    parent = {i: i for i in movable}

    def root(i: int) -> int:
        while parent[i] != i:
            i = parent[i]
        return i

    untold = find_untold(spec, history) if is_complete and _has_ties(spec) else None
    links, notes = _find_links(spec, history, touching, untold)
    for link in links:
        parent[root(link.body_a)] = root(link.body_b)
    grouped: dict[int, list[int]] = {}
    for i in movable:
        grouped.setdefault(root(i), []).append(i)
    blocks = sorted(map(tuple, grouped.values()))
    if untold is not None:
        notes += untold_notes(spec, untold, blocks)
    return blocks, notes


def why_joined(
    spec: SceneSpec,
    bodies: tuple[int, ...],
    history: History,
    touching: Touching | None = None,
) -> str:
    """Say why bodies are one block and what would part them, for messages.

    Args:
        spec: the scene.
        bodies: of one block.
        history: readings of all bodies.
        touching: what may have touched; None: nothing collides.

    Returns:
        Their names, pairs by reason, and what helps.
    """
    untold = find_untold(spec, history) if _has_ties(spec) else None
    pairs: dict[str, list[str]] = {}
    for link in _find_links(spec, history, touching, untold)[0]:
        if link.body_a in bodies and link.body_b in bodies:
            names = f"{spec.names[link.body_a]}-{spec.names[link.body_b]}"
            pairs.setdefault(link.why, []).append(names)
    reasons = [f"{', '.join(names)} {why}" for why, names in pairs.items()]
    text = f"the block is {', '.join(spec.names[i] for i in bodies)}"
    text = "; ".join([text, *reasons])
    if not _has_ties(spec):
        return text
    return (
        f"{text}; bodies are parted by readings of both in which one moves against the "
        'other, and by "prior": {"probability": {"tie": 0}}, which asks for no ties'
    )


def _has_ties(spec: SceneSpec) -> bool:
    """Whether pairs may be tied in ways that the scene does not say."""
    is_open = any(spec.unknown.get(kind, 0) for kind in JOINTS)
    return is_open and read_prior(spec.prior, spec.source).probability["tie"] > 0


def _find_links(
    spec: SceneSpec,
    history: History,
    touching: Touching | None,
    untold: Untold | None,
) -> tuple[list[_Link], list[str]]:
    """Pairs that are inferred together, and notes on those that were screened out."""
    movable = [i for i in range(spec.num_bodies) if not spec.is_static[i]]
    links = [
        _Link(constraint.body_a, constraint.body_b, "are tied by the scene")
        for constraint in spec.constraints
        if constraint.body_a in movable and constraint.body_b in movable
    ]
    if touching is not None:
        links += _links_of_touching(touching, movable)
    if not _has_ties(spec) or len(movable) < 2:
        return links, []
    dropped, strayed, far = [], [], []
    screen = _Screen.of(spec, history)
    joined = {frozenset(link[:2]) for link in links}
    for a, b in itertools.combinations(movable, 2):
        if frozenset((a, b)) in joined or (untold is not None and untold.has(a, b)):
            continue
        names = f"{spec.names[a]}-{spec.names[b]}"
        rests = untold is not None and bool(np.any(untold.is_at_rest[[a, b]]))
        tested = screen.test(a, b, rests)
        if tested.is_tied:
            links.append(_Link(a, b, "may be tied by all that was read"))
        elif tested.far is not None:
            strayed.append(f"{names} ({tested.far:.3g} m)")
        elif tested.misfit is None:
            far.append(names)
        else:
            dropped.append(f"{names} ({tested.misfit:.3g} m)")
    notes = []
    if dropped:
        notes.append(
            f"pairs taken as not tied (best pin misses by): {', '.join(dropped)}"
        )
    if strayed:
        notes.append(
            "pairs taken as not tied (so far from a centre is the best pin): "
            f"{', '.join(strayed)}"
        )
    if far:
        notes.append(
            "pairs taken as not tied (an angle was never read, centres are over "
            f"{_WIDEST_SPAN:g} times as far apart as outlines reach): {', '.join(far)}"
        )
    return links, notes


def _links_of_touching(touching: Touching, movable: list[int]) -> list[_Link]:
    """Bodies that may have touched, or that share an open contact number."""
    sharing = set()
    links = []
    for a, b in np.argwhere(touching.pairs).tolist():
        if a < b and a in movable and b in movable:
            links.append(_Link(a, b, "may have touched"))
        if a in movable and touching.has_unknown(a, b):
            sharing.add(a)
    why = "share an open number of contact"
    return links + [_Link(*pair, why) for pair in itertools.pairwise(sorted(sharing))]


class _Screen(NamedTuple):
    """Poses that pairs are tested by."""

    spec: SceneSpec
    state: Float[np.ndarray, "row body 3"]
    """At the starts of rows."""
    is_seen: Bool[np.ndarray, "row body"]
    run: Int[np.ndarray, " row"]
    tracks: Tracks | None
    """With what lies between readings; None where none is missing."""

    @classmethod
    def of(cls, spec: SceneSpec, history: History) -> "_Screen":
        """Of the readings of a scene."""
        rows = np.asarray(history.mask)
        is_seen = np.all(np.asarray(history.state_mask)[rows][..., :3], axis=-1)
        is_whole = bool(np.all(is_seen | np.asarray(spec.is_static)))
        return cls(
            spec,
            np.asarray(history.state, float)[rows][..., :3],
            is_seen,
            np.asarray(history.episode)[rows],
            None if is_whole else bridged_tracks(history),
        )

    def test(self, a: int, b: int, rests: bool) -> _Tested:
        """Whether two bodies, one of which is at rest or not, may be tied."""
        two = [a, b]
        use = np.all(self.is_seen[:, two], axis=1)
        pose, run = self.state[use][:, two], self.run[use]
        tested = self._fits(a, b, pose, run, rests=rests)
        if not tested.is_tied or self.tracks is None:
            return tested
        pose, error = self.tracks.pose[:, two], self.tracks.error[:, two]
        whole = np.all(np.isfinite(pose), axis=(1, 2))
        has_more = np.any(whole) and not np.any(use)
        if has_more or np.any(error[whole] > 0.0):
            reach = np.array([self.spec.bodies[i].reach for i in two])
            arm = np.stack([np.ones(2), np.ones(2), _WIDEST_SPAN * reach], axis=1)
            off = np.sqrt(np.mean(np.sum((arm * error[whole]) ** 2, axis=(1, 2))))
            run = self.tracks.run[whole]
            return self._fits(a, b, pose[whole], run, rests=rests, off=float(off))
        if not np.any(use):
            seen = np.all(np.isfinite(pose[..., :2]), axis=(1, 2))
            if np.any(seen):
                run = self.tracks.run[seen]
                return _Tested(self._is_near(a, b, pose[seen], run))
        return tested

    def _fits(
        self,
        a: int,
        b: int,
        pose: np.ndarray,
        run: np.ndarray,
        *,
        rests: bool,
        off: float = 0.0,
    ) -> _Tested:
        """The same of poses `[reading, 2, 3]` that are off by so much [m]."""
        can_pin, can_rod, can_slide = _open_ties(self.spec)
        tolerance = math.hypot(TIE_TOLERANCE, off)
        pair = pose[:, 0], pose[:, 1]
        misfit = pin_misfit(*pair, run)
        is_tied, far = can_pin and misfit.may_be(tolerance), None
        if is_tied and rests and len(pose):
            # A door swings about its hinge, which may be in the world or anywhere in
            # what stays still. Of two that move a tie that fits is no coincidence.
            scale = [
                self.spec.bodies[i].reach + float(np.hypot(*each[:, :2].std(axis=0)))
                for i, each in zip((a, b), pair, strict=True)
            ]
            distance = pin_distances(*pair, (scale[0], scale[1]), tolerance)
            if np.any(distance > _FARTHEST_PIN * np.array(scale)):
                is_tied, far = False, float(np.max(distance))
        if can_rod and not is_tied:
            is_tied = _may_be_rod(self.spec, pose, a, b, run, off)
        if can_slide and not is_tied:
            miss = slide_misfit(*pair, self.spec.bodies[a].reach, run)
            is_tied = miss.may_be(tolerance)
        return _Tested(is_tied, misfit.raw, far)

    def _is_near(self, a: int, b: int, pose: np.ndarray, run: np.ndarray) -> bool:
        """Whether bodies without angles may be tied, by where their centres are."""
        can_pin, can_rod, can_slide = _open_ties(self.spec)
        reach = self.spec.bodies[a].reach + self.spec.bodies[b].reach
        apart = np.hypot(*(pose[:, 0, :2] - pose[:, 1, :2]).T)
        # Of a pair on a line fixed in the one nothing can be said without its angle.
        return (
            can_slide
            or (can_pin and float(np.median(apart)) < _WIDEST_SPAN * reach)
            or (can_rod and _may_be_rod(self.spec, pose, a, b, run, 0.0))
        )


def _open_ties(spec: SceneSpec) -> tuple[bool, bool, bool]:
    """Whether pairs may be held by pins (or welds), rods and drawers."""
    has = {kind: spec.unknown.get(kind, 0) > 0 for kind in JOINTS}
    return has["revolute"] or has["weld"], has["distance"], has["prismatic"]


def _may_be_rod(
    spec: SceneSpec, pose: np.ndarray, a: int, b: int, run: np.ndarray, off: float
) -> bool:
    """Whether anchors inside reach could keep a distance.

    The distance of two anchors differs from that of the centres by at most both radii.
    """
    slack = 2.0 * (spec.bodies[a].reach + spec.bodies[b].reach + off)
    return rod_range(pose[:, 0], pose[:, 1], run) < slack or len(pose) == 0
