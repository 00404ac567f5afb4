"""Bodies that did not move, pushed or not: what can be said of such."""

from collections.abc import Collection

import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.hypotheses.prior import read_prior
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.readings.at_rest import is_at_rest
from boomdp_jax.inference.readings.touching import Touching
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

# Readings that it takes to say that a body did not move.
_FEWEST = 6
# By how much the probability of a pin may differ from the prior's where nothing tells.
_MOST_GAP = 0.15


def bodies_let_be(
    spec: SceneSpec, history: History, touching: Touching | None
) -> tuple[int, ...]:
    """Bodies that nothing pushed, that did not move, and that touch nothing.

    Nothing tells what they are. A likelihood would: it starts at the first reading, so
    that it charges a pin, and nothing else, for being where the body is, and a body
    without friction for having been put there at rest.

    Args:
        spec: the scene.
        history: its readings.
        touching: what may have touched; None: nothing collides.
    """
    # What acts where nothing was commanded does not move it, which tells of mass.
    if "actuator.bias" in spec.unknown_numbers:
        return ()
    is_pushed, is_still = _pushed_and_still(spec, history)
    is_let_be = ~is_pushed & is_still
    if touching is not None:
        is_let_be &= ~touching.pairs.any(axis=1)
    return tuple(np.flatnonzero(is_let_be).tolist())


def let_be_note(spec: SceneSpec, body: int) -> str:
    """What is said of a body whose readings were left out for that."""
    return (
        f"{spec.names[body]}: nothing pushed it and it did not move, which does not "
        "tell what it is; its readings are left out"
    )


def still_notes(
    spec: SceneSpec, history: History, left_out: Collection[str] = ()
) -> list[str]:
    """Notes about bodies at rest with nothing acting on them.

    At the start of a run a body may have any velocity that its first reading allows.
    That one without friction then stays where it is would be a coincidence, and one
    with friction is the more probable, though nobody pushed it. Who put it there knows
    better.

    Args:
        spec: the scene.
        history: its readings.
        left_out: notes of `let_be_note`; of those bodies nothing more is said.

    Returns:
        One line for each body.
    """
    is_pushed, is_still = _pushed_and_still(spec, history)
    return [
        f"{spec.names[body]}: nothing pushed it and it did not move; what is said of "
        "its constraints follows from how fast it might have been at first"
        for body in np.flatnonzero(~is_pushed & is_still)
        if let_be_note(spec, int(body)) not in left_out
    ]


def still_reasons(spec: SceneSpec, history: History, posterior: Posterior) -> list[str]:
    """Reasons for doubt about pins of bodies that no push has moved.

    What holds such a body, friction or more, does not show, and least of all whether
    it could turn about a point. The draws may say so all the same: runs that begin at
    one place are what a pin explains and a free body need not do, and where a pin is
    put before the readings are seen is wider than they tell.

    Args:
        spec: the scene.
        history: its readings.
        posterior: what was inferred.

    Returns:
        One line for each body whose pin is much more or less probable than a priori.
    """
    pins = posterior.params.revolute
    if not spec.unknown.get("revolute", 0) or pins.active.shape[-1] == 0:
        return []
    # What no push moves is fixed, if that is among what may be.
    if spec.unknown.get("weld", 0):
        return []
    expected = read_prior(spec.prior, spec.source).probability["revolute"]
    is_pushed, is_still = _pushed_and_still(spec, history)
    weights = np.asarray(posterior.weights, float)
    to_world = np.asarray(pins.active) & (np.asarray(pins.body_b) == WORLD)
    reasons = []
    for body in np.flatnonzero(is_pushed & is_still & ~np.asarray(spec.is_static)):
        mine = to_world & (np.asarray(pins.body_a) == body)
        said = float(weights @ mine.any(axis=-1))
        is_known = any(c.body_a == body for c in spec.constraints)
        if not is_known and abs(said - expected) > _MOST_GAP:
            reasons.append(
                f"{spec.names[body]}: no push has moved it, so that nothing tells "
                f"whether it is pinned; its probability of {said:.2f} is not to be "
                "relied on: expected a push that moves it"
            )
    return reasons


def _pushed_and_still(
    spec: SceneSpec, history: History
) -> tuple[np.ndarray, np.ndarray]:
    """Which bodies were pushed (or cannot be), and which did not move, `[body]`.

    With gravity along the plane, or without readings, none did not.
    """
    num = len(spec.bodies)
    rows = np.asarray(history.mask)
    if not np.any(rows) or np.any(np.asarray(spec.scene.gravity) != 0.0):
        return np.ones(num, bool), np.zeros(num, bool)
    action = np.asarray(history.action)[rows]
    is_pushed = np.any(action != 0.0, axis=(0, 2)) | np.asarray(spec.is_static)
    is_still = [is_at_rest(spec, history, body, _FEWEST) for body in range(num)]
    return is_pushed, np.array(is_still)
