"""What a posterior's diagnostics tell of laws that the model lacks."""

import math

import numpy as np

from boomdp_jax.inference.blocks.model_sites import coordinate_names
from boomdp_jax.inference.doubts.corrections import persistence_note, unmoved_reason
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.doubts.residual import BodyLaw, ResidualCheck
from boomdp_jax.inference.doubts.residual_laws import LAWS
from boomdp_jax.inference.doubts.step_doubts import step_reason
from boomdp_jax.inference.doubts.uneven_clock import clock_reason
from boomdp_jax.inference.posteriors.table import plus_minus
from boomdp_jax.physics.scene_spec import SceneSpec

FALSE_ALARMS = 0.01
"""Rate of scenes with no law missing of which one is said to miss, at most; the same
for innovations that are said to be correlated."""

# Nats that are asked for beyond that. Filters are linearised, and dry friction has
# kinks: of 112 recordings of 60 steps of seven families of objects in our own engine
# (noise of 0 to 15 %, pin, wheel and friction unknown) a cart with a dry wheel reached
# 8.6. Of 21 of 100 steps two were above 10: such carts, whose posteriors were wrong.
_MARGIN = 3.0
# Probability by chance below which readings are said to err more at higher speeds.
_GROWTH_BY_CHANCE = 1e-4
# Innovations that are so correlated with those before, by chance with so small a
# probability, are more than a sensor's. Of 28 objects in MuJoCo, floors included, none
# came near (0.18 and 7e-2 with poses alone, 0.4 and 1e-2 with all channels); of 18
# recordings in which something was other than told (a limit of the actuator, degrees,
# millimetres, angles counted the other way round, a known pin elsewhere) 12 did.
# Trackers that smooth have noise with correlations of 0.4 and more: a note.
_CORRELATED, _CORRELATED_BY_CHANCE = 0.55, 1e-8
# Ratio and score from which on a note says that corrections go one way. More is not
# made of it: of MuJoCo's drawers and boxes on floors, whose friction is not quite the
# model's, every third comes to 4 and 6, one to 7 and 13, masses right; forces turned by
# 30 degrees make no more.
_PERSISTS, _PERSISTS_BY_CHANCE = 3.0, 6.0
# Laws of each block that are listed.
_MOST_LAWS = 3
_NUM_GROUPS = 4


def report_residuals(
    spec: SceneSpec, results: list[BlockResult]
) -> tuple[list[dict], list[str], list[str]]:
    """Laws that innovations follow, and whether innovations are white.

    A Bayes factor has a mean of one where the law is not there, so that it exceeds K /
    a with a probability under a / K (Markov's inequality): with K laws of all bodies
    together, what exceeds that by a margin is a doubt. Correlated innovations without
    such a law are a note: readings of real sensors are often not white. Where they are
    strongly correlated the draws are too sure at least, which is a doubt, and so is
    motion that is more by chance than by what pushes a body (`corrections`), and steps
    that are too long (`step_doubts`) or not as long as told (`uneven_clock`). Notes are
    readings that err more the faster a body moves, and motion that readings correct the
    same way again and again (`corrections`).

    Args:
        spec: the scene.
        results: its blocks.

    Returns:
        An entry of every block that was checked: `bodies`, `rows`, `threshold` for the
        `log_bayes_factor` of a law, the best `laws` with coefficients and their sds,
        `whiteness`, p-values by body and channel group, `correlation` of innovations
        one after the other likewise, `persistence`, how corrections of the motion add
        up, `by_chance`, how much of it is noise by how much pushes would make,
        `spread`, how errors grow with speed by body, `step_shift`, by how many
        posterior sds numbers would move in finer steps, and `clock`, by how much steps
        seem to vary in length, None where these were not asked; reasons for doubt;
        notes.
    """
    checked = [result for result in results if result.residual is not None]
    num_bodies = sum(len(result.block.bodies) for result in checked)
    threshold = math.log(max(num_bodies, 1) * len(LAWS) / FALSE_ALARMS) + _MARGIN
    least = FALSE_ALARMS / max(num_bodies * _NUM_GROUPS, 1)
    entries, reasons, notes = [], [], []
    for result in checked:
        check = result.residual
        assert check is not None
        names = [spec.names[body] for body in result.block.bodies]
        step_shift = None
        if check.step is not None:
            numbers = coordinate_names(tuple(names), result.block.layout)
            too_long = step_reason(check.step, names, numbers)
            reasons += [] if too_long is None else [too_long]
            step_shift = float(np.max(np.abs(check.step.shift)))
        clock = check.clock
        if clock is not None:
            uneven = clock_reason(clock, names)
            reasons += [] if uneven is None else [uneven]
        decisive: dict[int, BodyLaw] = {}
        for law in check.laws:
            if law.fit.log_bayes_factor > threshold:
                decisive.setdefault(law.body, law)
        for body, law in decisive.items():
            reasons.append(
                f"{names[body]}: its motion also follows a law that the model lacks: "
                f"{describe_law(law)}"
            )
        whiteness = dict(zip(names, check.whiteness, strict=False))
        for body, name in enumerate(names):
            worst = min(whiteness.get(name, {}).items(), key=_value, default=None)
            strong = _strongest(check, body)
            if body in decisive:
                continue
            if strong is not None:
                channel, size, by_chance = strong
                reasons.append(
                    f"{name}: what is left of its {channel} readings goes on from one "
                    f"to the next (correlation {size:.2f}, p = {by_chance:.1g}): its "
                    "motion is not the model's, or noise far from white; expected "
                    "wrenches, axes and units as they were, and what is known to be so"
                )
            elif worst is not None and worst[1] < least:
                notes.append(
                    f"{name}: what is left of its {worst[0]} readings is correlated in "
                    f"time (p = {worst[1]:.1g}): noise that is not white, or motion of "
                    "which the model has no law"
                )
        spread = {
            name: growth._asdict()
            for name, growth in zip(names, check.growth, strict=False)
            if growth is not None
        }
        for body, name in enumerate(names):
            growth = spread.get(name)
            if growth is None or body in decisive:  # Such a law may well grow.
                continue
            # One gross error where it is slow, or readings that are all better than
            # they are taken to be, make nothing too sure.
            grows = growth["fast"] > max(1.0, growth["slow"])
            if grows and growth["p_value"] < _GROWTH_BY_CHANCE / max(num_bodies, 1):
                notes.append(
                    f"{name}: its readings err more the faster it moves, "
                    f"{growth['slow']:.2g} times as much as expected where it is slow "
                    f"and {growth['fast']:.2g} times where it is fast (p = "
                    f"{growth['p_value']:.1g}): noise of the motion that is not the "
                    "same at all speeds, so that what is predicted of fast motion is "
                    "too sure"
                )
        for body, each in enumerate(check.persistence):
            if body in decisive:
                continue
            unmoved = unmoved_reason(names[body], each, check.by_chance[body])
            if unmoved is not None:
                reasons.append(unmoved)
                continue
            for channel, one in each.items():
                if one.ratio > _PERSISTS and one.score > _PERSISTS_BY_CHANCE:
                    notes.append(persistence_note(names[body], channel, one))
        entries.append(
            {
                "bodies": names,
                "rows": check.num_rows,
                "threshold": threshold,
                "laws": [_entry(names, law) for law in check.laws[:_MOST_LAWS]],
                "whiteness": whiteness,
                "correlation": dict(zip(names, check.correlation, strict=False)),
                "persistence": {
                    name: {channel: one._asdict() for channel, one in each.items()}
                    for name, each in zip(names, check.persistence, strict=False)
                },
                "by_chance": dict(zip(names, check.by_chance, strict=False)),
                "spread": spread,
                "step_shift": step_shift,
                "clock": None if clock is None else clock._asdict(),
            }
        )
    return entries, reasons, notes


def _strongest(check: ResidualCheck, body: int) -> tuple[str, float, float] | None:
    """Channel, correlation and p-value of what is surely and much correlated."""
    if body >= len(check.correlation):
        return None
    found = [
        (name, size, check.whiteness[body][name])
        for name, size in check.correlation[body].items()
        if size > _CORRELATED and check.whiteness[body][name] < _CORRELATED_BY_CHANCE
    ]
    return max(found, key=lambda each: each[1], default=None)


def describe_law(law: BodyLaw) -> str:
    """A law with its coefficients, for people."""
    fit, unit = law.fit, law.law.unit
    numbers = ", ".join(
        plus_minus({"mean": float(value), "sd": float(sd)})
        for value, sd in zip(fit.coefficient, fit.sd, strict=True)
    )
    if len(fit.coefficient) > 1:
        numbers = f"({numbers})"
    meaning = law.law.meaning
    return (
        f"{law.law.text}, {numbers} {unit}".rstrip()
        + ("" if meaning is None else f": {meaning(fit.coefficient)}")
        + f" (log Bayes factor {fit.log_bayes_factor:.0f})"
    )


def _value(item: tuple[str, float]) -> float:
    return item[1]


def _entry(names: list[str], law: BodyLaw) -> dict:
    return {
        "body": names[law.body],
        "law": law.law.name,
        "unit": law.law.unit,
        "coefficient": [float(value) for value in law.fit.coefficient],
        "sd": [float(value) for value in law.fit.sd],
        "log_bayes_factor": float(law.fit.log_bayes_factor),
    }
