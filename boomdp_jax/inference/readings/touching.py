r"""Which bodies may have touched during a history, and what contact is told by it.

Of outlines that are $d_0$ and $d_1$ apart at two readings, between which one moved
against the other by at most L, the distance in between is at least
$(d_0 + d_1 - L) / 2$. Where that is less than what noise may hide they may have
touched: they are inferred together, and their contact is simulated. What bounces in
between comes back, and both readings do not show how far it went: L is as much as it
went in a row before or after, and half as much again, if that is more.

A disc is where it is whichever way it points. Another outline whose angle was not read
is taken for the circle round it, which errs towards having touched; and bodies that
were read in turn are looked at where one is read and the other between two readings.

Bodies whose file leaves friction or restitution open share one unknown number of each.
So all that may have touched something with an open number belongs to one block.
"""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.history import History
from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.readings.outliers import SD_OF_MEDIAN
from boomdp_jax.inference.readings.tie_tracks import bridged_tracks
from boomdp_jax.physics.body_spec import BodySpec
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.separation import pair_separation
from boomdp_jax.physics.state import State

CONTACT_NUMBERS = ("friction", "restitution")
"""Numbers of contact that may be inferred, in the order of their coordinates."""

# Noise of a distance, in sds, within which outlines may have touched.
_NUM_SDS = 5.0
# How much farther than in the row before it something may go in one in which it comes
# back, as forces act and noise hides some of it.
_MORE = 1.5
_FEWEST_BESIDE = 3


class Touching(NamedTuple):
    """What may have touched."""

    pairs: Bool[np.ndarray, "body body"]
    """Symmetric."""
    unknown: dict[str, Bool[np.ndarray, " body"]]
    """Bodies whose number the scene leaves open, by number."""
    rows: Bool[np.ndarray, "time body body"] | None = None
    """Rows of the history in which each pair may have touched, or in the one before or
    after; None: perhaps all."""

    def has_unknown(self, a: int, b: int) -> bool:
        """Whether contact of two bodies depends on a number that is left open."""
        return any(bool(body[a] or body[b]) for body in self.unknown.values())

    def near_rows(
        self, bodies: tuple[int, ...], num_rows: int
    ) -> Bool[np.ndarray, " time"]:
        """Rows of a table in which any of some bodies may have touched something."""
        near = np.ones(num_rows, bool)
        if self.rows is not None:
            known = np.any(self.rows[:, list(bodies)], axis=(1, 2))
            near[: len(known)] = known
            # No row of the history is there.
            near[len(known) :] = False
        return near

    def walls_of(self, spec: SceneSpec, bodies: tuple[int, ...]) -> tuple[int, ...]:
        """Static bodies that some bodies may have touched."""
        near = np.any(self.pairs[list(bodies)], axis=0) & spec.is_static
        return tuple(np.flatnonzero(near).tolist())

    def inferred_in(self, spec: SceneSpec, bodies: tuple[int, ...]) -> tuple[str, ...]:
        """Numbers of contact on which the motion of some bodies may depend."""
        everything = bodies + self.walls_of(spec, bodies)
        touching = self.pairs[np.ix_(bodies, everything)]
        first, second = np.nonzero(touching)
        involved = np.unique(np.array([bodies[i] for i in first], int))
        involved = np.union1d(involved, np.array([everything[i] for i in second], int))
        involved = involved.astype(int)
        return tuple(
            name for name in CONTACT_NUMBERS if np.any(self.unknown[name][involved])
        )


def unknown_contact(spec: SceneSpec) -> dict[str, Bool[np.ndarray, " body"]]:
    """Which bodies' contact numbers a scene leaves open, by number."""
    return {
        name: np.array(
            [np.isnan(getattr(body, name) or 0.0) for body in spec.bodies], bool
        )
        for name in CONTACT_NUMBERS
    }


def find_touching(spec: SceneSpec, history: History) -> Touching | None:
    """Find the pairs of bodies that may have touched.

    Args:
        spec: the scene.
        history: readings of all its bodies. Without any nothing has touched.

    Returns:
        The pairs; None in a scene without contact.
    """
    scene = spec.scene
    if scene.collides is None:
        return None
    may = np.asarray(scene.collides).copy()
    may &= ~(spec.is_static[:, None] & spec.is_static[None])
    readings = _readings(spec, history)
    scale = read_prior(spec.prior, spec.source).noise
    noise = _noise(readings, scale["position"], scale["angle"])
    reach = np.array([_reach(body) for body in spec.bodies])
    sd = np.hypot(noise[:, 0], noise[:, 1] * reach)
    tracks = [readings]
    if not np.all(readings.is_read):
        tracks.append(_between(spec, history))
    pairs = np.zeros_like(may)
    rows = np.zeros((history.capacity, *may.shape), bool)
    for a, b in itertools.combinations(range(spec.num_bodies), 2):
        if may[a, b]:
            margin = _NUM_SDS * float(np.hypot(sd[a], sd[b]))
            near = (_is_near(spec, one, (a, b), reach, margin) for one in tracks)
            pairs[a, b] = pairs[b, a] = any(near)
        if pairs[a, b]:
            near_rows = _near_rows(spec, readings, (a, b), reach, margin)
            rows[np.asarray(history.mask), a, b] = near_rows
            rows[:, b, a] = rows[:, a, b]
    return Touching(pairs, unknown_contact(spec), rows)


class _Readings(NamedTuple):
    """Poses in order of time."""

    pose: Float[np.ndarray, "reading body 3"]
    is_read: Bool[np.ndarray, "reading body 3"]
    run: Int[np.ndarray, " reading"]
    """Which run each belongs to."""
    error: Float[np.ndarray, "reading body 3"]
    """By how much they may be off besides their noise."""


def _is_near(
    spec: SceneSpec,
    readings: _Readings,
    two: tuple[int, int],
    reach: np.ndarray,
    margin: float,
) -> bool:
    """Whether two bodies may have been closer than a margin [m]."""
    is_read = readings.is_read[:, two]
    use = np.all(is_read[..., :2], axis=(1, 2))
    if not np.any(use):
        return False
    place, run, reach = readings.pose[use][:, two], readings.run[use], reach[list(two)]
    is_disc = _are_discs(spec, two)
    # Which way a disc points is nothing, and neither is how it turns.
    place = np.where(is_disc[:, None] & [False, False, True], 0.0, place)
    off = readings.error[use][:, two]
    off = np.sum(np.hypot(off[..., 0], off[..., 1]) + off[..., 2] * reach, axis=1)
    far = np.hypot(*(place[:, 0, :2] - place[:, 1, :2]).T) - np.sum(reach) - off
    if not _comes_near(far, place, run, reach, margin):
        return False
    is_turned = is_read[use][..., 2] | is_disc
    whole = np.all(is_turned, axis=1)
    if np.any(~whole):
        # The circle round an outline is nowhere farther, whichever way it turns.
        place = np.where(whole[:, None, None] | [True, True, False], place, 0.0)
        beside = ~whole
        beside[1:] |= ~whole[:-1]
        beside[:-1] |= ~whole[1:]
        if _comes_near(np.where(beside, far, np.inf), place, run, 0.0 * reach, margin):
            return True
    if not np.any(whole):
        return False
    place, run = place[whole], run[whole]
    apart = _separation(spec.scene, place, *two) - off[whole]
    return _comes_near(apart, place, run, reach, margin)


def _near_rows(
    spec: SceneSpec,
    readings: _Readings,
    two: tuple[int, int],
    reach: np.ndarray,
    margin: float,
) -> Bool[np.ndarray, " row"]:
    """Rows in which two bodies may have been closer than a margin [m], and next ones.

    Rows that were not read in full at both ends are among them.
    """
    reach, is_disc = reach[list(two)], _are_discs(spec, two)
    is_read = readings.is_read[:, two] | (is_disc[:, None] & [False, False, True])
    whole = np.all(is_read, axis=(1, 2)).reshape(-1, 2).all(axis=1)
    place = readings.pose[:, two].reshape(-1, 2, 2, 3)[whole]
    place = np.where(is_disc[:, None] & [False, False, True], 0.0, place)
    apart = _separation(spec.scene, place.reshape(-1, 2, 3), *two).reshape(-1, 2)
    run = readings.run.reshape(-1, 2)[:, 0]
    way = np.zeros(len(whole))
    way[whole] = _way_between(place, reach)
    way = _or_nearby(way, run, 1)[whole]
    least = np.minimum(np.min(apart, axis=1), 0.5 * (np.sum(apart, axis=1) - way))
    # In short runs there is too little beside a row to tell how far it went.
    _, place, count = np.unique(run, return_inverse=True, return_counts=True)
    near = ~whole | (count[place.reshape(-1)] < _FEWEST_BESIDE)
    near[whole] |= least < margin
    same = run[1:] == run[:-1]
    return near | np.append(near[1:] & same, False) | np.append(False, near[:-1] & same)


def _comes_near(apart, place, run, reach, margin: float) -> bool:
    """Whether outlines may have been closer than a margin at or between readings."""
    if np.min(apart) < margin:
        return True
    same = run[1:] == run[:-1]
    way = _way_between(np.stack([place[:-1], place[1:]], axis=1), reach)
    # Rows have a reading at both ends, mostly of the same instants as their neighbours.
    way = _or_nearby(np.where(same, way, 0.0), run[1:], 2)
    least = 0.5 * (apart[1:] + apart[:-1] - way)
    return bool(np.any((least < margin) & same))


def _way_between(place: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """How far outlines went against each other from one reading to the next [m].

    Args:
        place: `[pair, reading, 2, 3]`.
        reach: of each body [m].
    """
    moved = place[:, 1] - place[:, 0]
    length = np.hypot(*(moved[:, 0, :2] - moved[:, 1, :2]).T)
    return length + np.abs(moved[:, :, 2]) @ reach


def _or_nearby(way: np.ndarray, run: np.ndarray, num: int) -> np.ndarray:
    """The same, or what was gone within so many before or after, if that is more."""
    most = way.copy()
    for shift in range(1, num + 1):
        same = run[shift:] == run[:-shift]
        before = np.where(same, _MORE * way[:-shift], 0.0)
        after = np.where(same, _MORE * way[shift:], 0.0)
        most[shift:] = np.maximum(most[shift:], before)
        most[:-shift] = np.maximum(most[:-shift], after)
    return most


def _readings(spec: SceneSpec, history: History) -> _Readings:
    """What was read, unread angles as zero."""
    rows = np.asarray(history.mask)
    episode = np.asarray(history.episode)[rows]
    parts = [
        (np.asarray(values, float)[rows][..., :3], np.asarray(mask)[rows][..., :3])
        for values, mask in (
            (history.state, history.state_mask),
            (history.next_state, history.next_state_mask),
        )
    ]
    num = 2 * len(episode)
    pose = np.stack([part[0] for part in parts], axis=1)
    mask = np.stack([part[1] for part in parts], axis=1)
    pose, mask = (x.reshape(num, spec.num_bodies, 3) for x in (pose, mask))
    return _with_static(
        spec, _Readings(pose, mask, np.repeat(episode, 2), np.zeros_like(pose))
    )


def _between(spec: SceneSpec, history: History) -> _Readings:
    """The same with what lies between readings."""
    tracks = bridged_tracks(history)
    is_known = np.isfinite(tracks.pose)
    pose = np.where(is_known, tracks.pose, 0.0)
    return _with_static(spec, _Readings(pose, is_known, tracks.run, tracks.error))


def _with_static(spec: SceneSpec, readings: _Readings) -> _Readings:
    """The same with bodies that stay where the scene puts them."""
    pose, is_read = np.array(readings.pose), np.array(readings.is_read)
    for index, body in enumerate(spec.bodies):
        if body.is_static and body.pose is not None:
            pose[:, index], is_read[:, index] = body.pose, True
    return readings._replace(pose=pose, is_read=is_read)


def _noise(
    readings: _Readings, position: float, angle: float
) -> Float[np.ndarray, "b 2"]:
    """Noise of positions [m] and angles [rad], no less than the prior's.

    By the median of what three readings in a row depart from a line by, which an impact
    does not change and a steady push hardly.
    """
    out = np.tile([position, angle], (readings.pose.shape[1], 1)).astype(float)
    # Rows end where the next ones begin, or close to it: one reading of each instant.
    pose, is_read, run = readings.pose[1::2], readings.is_read[1::2], readings.run[1::2]
    if len(pose) < 3:
        return out
    bend = np.abs(pose[2:] - 2.0 * pose[1:-1] + pose[:-2]) / np.sqrt(6.0)
    same = (run[2:] == run[:-2])[:, None, None]
    whole = is_read[2:] & is_read[1:-1] & is_read[:-2] & same
    for body, channel in np.ndindex(*whole.shape[1:]):
        of_it = bend[whole[:, body, channel], body, channel]
        if len(of_it):
            sd, part = SD_OF_MEDIAN * np.median(of_it), channel // 2
            out[body, part] = max(out[body, part], sd)
    return out


def _separation(scene: Scene, place: np.ndarray, a: int, b: int) -> np.ndarray:
    """Distance of two outlines at many poses `[reading, 2, 3]`, `[reading]`."""
    num = len(place)
    # Few different lengths, so that few programs are compiled.
    room = 1 << max(num - 1, 1).bit_length()
    place = np.concatenate([place, np.repeat(place[-1:], room - num, axis=0)])
    return np.asarray(_apart(scene, on_device([a, b], int), on_device(place)))[:num]


@jax.jit
def _apart(scene: Scene, index: Int[Array, "2"], place: Float[Array, "reading 2 3"]):
    two = eqx.tree_at(
        lambda s: (s.vertices, s.radius),
        scene,
        (scene.vertices[index], scene.radius[index]),
    )

    def at(pose):
        return pair_separation(two, State(pose, jnp.zeros_like(pose)), 0, 1)

    return jax.vmap(at)(place)


def _reach(body: BodySpec) -> float:
    """Farthest point of an outline from the centre of mass [m]."""
    return body.radius + float(np.max(np.hypot(*body.vertices.T), initial=0.0))


def _are_discs(spec: SceneSpec, bodies: tuple[int, ...]) -> Bool[np.ndarray, " body"]:
    """Whether outlines are the same whichever way they point."""
    vertices = (spec.bodies[i].vertices for i in bodies)
    return np.array([np.max(np.hypot(*v.T), initial=0.0) == 0.0 for v in vertices])
