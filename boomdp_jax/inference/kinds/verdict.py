"""Whether to rely on kinds: doubts and notes, of all scenes and of kinds given."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.history import History
from boomdp_jax.inference.doubts.angle_sense import angle_sense_reasons
from boomdp_jax.inference.doubts.end_stops import end_stop_reasons
from boomdp_jax.inference.doubts.pose_velocity_agreement import pose_velocity_notes
from boomdp_jax.inference.doubts.run_breaks import run_break_reasons
from boomdp_jax.inference.doubts.stance_doubts import stance_reasons
from boomdp_jax.inference.doubts.unread_angles import angle_reasons
from boomdp_jax.inference.doubts.velocity_doubts import velocity_reasons
from boomdp_jax.inference.kinds.file import LearntKinds
from boomdp_jax.inference.kinds.objects import ObjectsAlone
from boomdp_jax.inference.posteriors.posterior import Posterior, with_diagnostics
from boomdp_jax.inference.readings.outliers import outlier_notes
from boomdp_jax.inference.readings.unread import unread_notes
from boomdp_jax.physics.scene_spec import SceneSpec

# Reasons, and notes, that are written out where people read them.
_MOST_SHOWN = 3
# The worst over all scenes of what a scene has one number of.
_WORST = {
    "r_hat": np.max,
    "effective_sample_size": np.min,
    "jump_acceptance": np.min,
}


def merged_diagnostics(posteriors: Sequence[Posterior]) -> dict:
    """One verdict over all scenes, with the keys that one scene's has.

    Args:
        posteriors: one of each scene.

    Returns:
        Not ok where one is not. With several scenes reasons name theirs, and so do
        notes, but for those that are of all scenes; numbers are the worst.
    """
    each: list[dict[str, Any]] = [
        {"ok": True, "reasons": [], **posterior.diagnostics} for posterior in posteriors
    ]
    merged = dict(each[0])
    if len(each) == 1:
        return merged
    notes = [one.get("notes", []) for one in each]
    common = [note for note in notes[0] if all(note in others for others in notes)]
    own = [[note for note in one if note not in common] for one in notes]
    merged |= {
        "ok": all(one["ok"] for one in each),
        "reasons": _of_scenes([one["reasons"] for one in each]),
        "notes": [*common, *_of_scenes(own)],
        "residual": [
            {"scene": scene, **entry}
            for scene, one in enumerate(each)
            for entry in one.get("residual", [])
        ],
    }
    for name, worst in _WORST.items():
        values = [one[name] for one in each if one.get(name) is not None]
        merged[name] = float(worst(values)) if values else None
    return merged


def _of_scenes(lines: list[list[str]]) -> list[str]:
    return [
        f"scene {scene}: {line}" for scene, mine in enumerate(lines) for line in mine
    ]


def first_few(lines: Sequence[str], where: str) -> list[str]:
    """The first lines, and how many more there are.

    Args:
        lines: reasons or notes.
        where: all of them are to be found.
    """
    more = len(lines) - _MOST_SHOWN
    rest = [f"and {more} more in {where}"] if more > 0 else []
    return [*lines[:_MOST_SHOWN], *rest]


def verdict_on_learnt(
    diagnostics: dict, prior_kinds: LearntKinds | None
) -> tuple[bool | None, tuple[str, ...]]:
    """`ok` and `reasons` of kinds just learnt, on top of kinds given.

    Their tallies count the objects of kinds given too, right or wrong.

    Args:
        diagnostics: of all scenes.
        prior_kinds: kinds given.
    """
    ok = diagnostics["ok"]
    if prior_kinds is not None:
        ok = ok and prior_kinds.ok
    return ok, (*diagnostics["reasons"], *_given_notes(prior_kinds))


def _given_notes(prior_kinds: LearntKinds | None) -> list[str]:
    if prior_kinds is None or prior_kinds.ok is not False:
        return []
    reasons = first_few(prior_kinds.reasons, "prior_kinds.reasons")
    return [
        "the kinds given were learnt with diagnostics that were not ok: "
        + ("; ".join(reasons) or "no reasons known")
    ]


def with_kind_doubts(
    posterior: Posterior,
    history: History,
    at_rest: list[int],
    prior_kinds: LearntKinds | None,
) -> Posterior:
    """The same with what its readings, and kinds given, give to think.

    As `with_doubts`, but for what takes the scene's prior for all that is known besides
    a body's own readings (drag about a pin, a pin that no push has moved): others of
    its kind tell of those. Nor are bodies at rest asked about, whose readings were
    left out.

    Args:
        posterior: of the scene.
        history: its readings.
        at_rest: `resting_bodies` of the scene.
        prior_kinds: kinds given.
    """
    spec = posterior.spec
    is_used = np.ones((spec.num_bodies, 1), bool)
    is_used[at_rest] = False
    used = dataclasses.replace(
        history,
        state_mask=on_device(np.asarray(history.state_mask) & is_used, bool),
        next_state_mask=on_device(np.asarray(history.next_state_mask) & is_used, bool),
    )
    reasons = [
        *run_break_reasons(spec, used),
        *velocity_reasons(spec, used),
        *angle_sense_reasons(spec, used),
        *end_stop_reasons(spec, used, posterior),
        *angle_reasons(spec, used, posterior),
        *stance_reasons(spec, posterior),
    ]
    notes = [
        *_given_notes(prior_kinds),
        *posterior.diagnostics.get("notes", []),
        *unread_notes(spec, history),
        *pose_velocity_notes(spec, used),
        *outlier_notes(spec, used, "write NaN in their place"),
    ]
    return with_diagnostics(posterior, reasons, {"notes": notes})


def kind_notes(objects: ObjectsAlone, spec: SceneSpec, scene: int) -> list[str]:
    """What is taken for granted of the bodies of one scene.

    Args:
        objects: all bodies.
        spec: the scene.
        scene: its number.
    """
    notes = ["bodies are taken not to be tied to each other"]
    at_rest = [spec.names[body] for body in resting_bodies(objects, scene)]
    if at_rest:
        notes.append(
            f"known by their kinds alone, never in motion: {', '.join(at_rest)}"
        )
    mine = [body.body for body in objects.bodies if body.scene == scene]
    given = [spec.names[b] for b in mine if spec.bodies[b].density is not None]
    if given:
        notes.append(
            "densities that the scene gives tell nothing of others of a kind: "
            f"{', '.join(given)}"
        )
    return notes


def resting_bodies(objects: ObjectsAlone, scene: int) -> list[int]:
    """Bodies of a scene that were not pushed and not seen in motion.

    Args:
        objects: all bodies.
        scene: its number.
    """
    mine = [body for body in objects.bodies if body.scene == scene]
    return [body.body for body in mine if body.bumps is None]
