"""Pairs of bodies of which no reading can say whether they are tied."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from boomdp_jax.core.history import History
from boomdp_jax.inference.readings.at_rest import is_at_rest
from boomdp_jax.physics.scene_spec import SceneSpec


class Untold(NamedTuple):
    """What keeps ties from being told."""

    is_at_rest: Bool[np.ndarray, " body"]
    """Bodies that were always read in one place, and that need nothing to hold them."""
    is_unread: Bool[np.ndarray, " body"]
    """Bodies of which nothing was read."""
    is_together: Bool[np.ndarray, "body body"]
    """Pairs of which something was read in one run."""

    def has(self, a: int, b: int) -> bool:
        """Whether nothing tells of a tie of two bodies."""
        return bool(
            (self.is_at_rest[a] and self.is_at_rest[b]) or not self.is_together[a, b]
        )


def find_untold(spec: SceneSpec, history: History) -> Untold:
    """Find the pairs of which nothing tells whether they are tied.

    Two bodies at rest that nobody pushed stay where they are, tied or not, and so do
    two that were pushed too weakly where a floor may hold them. Where one of the two
    moves a tie shows, or where both were carried to another place between two runs. Of
    bodies that were not read in any run together there is nothing to compare.

    Args:
        spec: the scene.
        history: readings of all its bodies. Without rows, which ask for the prior,
            there are no such pairs.
    """
    num = spec.num_bodies
    rows = np.asarray(history.mask)
    none = np.zeros(num, bool)
    if not np.any(rows):
        return Untold(none, none, np.ones((num, num), bool))
    seen = np.asarray(history.state_mask) | np.asarray(history.next_state_mask)
    seen = np.any(seen[rows], axis=-1)
    episode = np.asarray(history.episode)[rows]
    runs = [np.any(seen[episode == run], axis=0) for run in np.unique(episode)]
    together = np.any([np.outer(run, run) for run in runs], axis=0)
    rests = none
    # On a slope rest tells that something holds a body.
    if not np.any(np.asarray(spec.scene.gravity) != 0.0):
        rests = np.array([is_at_rest(spec, history, i) for i in range(num)])
        rests &= _may_rest(spec, np.asarray(history.action)[rows])
    return Untold(rests, ~np.any(runs, axis=0), together)


def untold_notes(
    spec: SceneSpec, untold: Untold, blocks: list[tuple[int, ...]]
) -> list[str]:
    """Say which ties are not asked for since nothing tells of them.

    Args:
        spec: the scene.
        untold: what keeps them from being told.
        blocks: bodies that are inferred together for other reasons, as those that may
            have touched: ties between them are asked for all the same.

    Returns:
        A line on all bodies at rest, one for each body that was not read, and one on
        what was not read together.
    """
    names, notes = spec.names, []
    resting = [[names[i] for i in block if untold.is_at_rest[i]] for block in blocks]
    groups = ["+".join(group) for group in resting if group]
    if len(groups) > 1:
        notes.append(
            f"{', '.join(groups)}: never moved, so that a tie between them cannot be "
            "told from two bodies that stay where they are; none is asked for"
        )
    parted = []
    for block in blocks:
        others = [i for other in blocks if other != block for i in other]
        for i in block:
            if untold.is_unread[i] and others:
                notes.append(
                    f"{names[i]}: nothing was read of it, so that a tie to "
                    f"{', '.join(names[j] for j in sorted(others))} cannot be told; "
                    "none is asked for"
                )
            parted += [
                f"{names[i]}-{names[j]}"
                for j in others
                if i < j
                and not untold.is_together[i, j]
                and not (untold.is_unread[i] or untold.is_unread[j])
            ]
    if parted:
        notes.append(
            f"{', '.join(parted)}: never read in one run, so that a tie between them "
            "cannot be told; none is asked for"
        )
    return notes


def _may_rest(spec: SceneSpec, action: np.ndarray) -> Bool[np.ndarray, " body"]:
    """Bodies that stay without a tie: nobody pushed them, or a floor may hold them.

    What is pushed on a floor that holds nothing is held by a joint.
    """
    has_floor = np.zeros(spec.num_bodies, bool)
    if float(spec.normal_gravity) > 0.0:
        has_floor[:] = spec.unknown.get("ground", 0) > 0
        for constraint in spec.constraints:
            has_floor[constraint.body_a] |= constraint.kind == "ground"
    return has_floor | ~np.any(action != 0.0, axis=(0, 2))
