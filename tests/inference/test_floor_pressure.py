"""What presses on the floor with all of its area has no wheel."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference import infer, infer_batch
from boomdp_jax.inference.stance_doubts import stance_reasons
from boomdp_jax.interop.object_families import random_pushes
from boomdp_jax.interop.recording import READING_NOISE
from boomdp_jax.physics import rollout
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

DT, NUM_ROWS, NUM_OBJECTS = 0.02, 60, 6
NOISE = np.array(READING_NOISE)[[0, 0, 1, 2, 2, 3]]


def spread_over(shape, half):
    """64 points that stand for all of a disc's, or a box's, area."""
    if shape == "circle":
        number = np.arange(64) + 0.5
        radius, angle = np.sqrt(number / 64), np.pi * (1 + 5**0.5) * number
        points = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        side = (np.arange(8) + 0.5) / 4 - 1
        points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return points * half


def scene(outline, feet=None, **known):
    body = {"name": "object", "shape": outline, "pose": [0.1, -0.2, 0.3]}
    body |= {} if feet is None else {"feet": feet.tolist()}
    content = {"schema": "planar-scene-1", "dt": DT}
    if known:
        body["density"] = known["density"]
        floor = {"type": "ground", "a": "object", "dry": known["dry"]}
        content["constraints"] = [floor]
    else:
        content["unknown"] = {"revolute": 1, "wheel": 1, "ground": 1}
    return scene_spec_from_dict(content | {"bodies": [body]})


def pushed_object(seed: int, stance: str):
    """What is seen of a disc or box, its readings, and its mass."""
    legs = stance != "all of it"
    rng = np.random.default_rng([seed, 11])
    half = np.sort(rng.uniform(0.1, 0.4, 2))[::-1]
    if seed % 2:
        outline = {"type": "box", "half_extents": half.tolist()}
        kind, area, reach = "box", 4 * half[0] * half[1], float(np.hypot(*half))
    else:
        half = np.full(2, half[1])
        outline = {"type": "circle", "radius": half[0]}
        kind, area, reach = "circle", np.pi * half[0] ** 2, half[0]
    feet = spread_over(kind, half)
    if legs:
        corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        feet = (0.6 if kind == "circle" else 0.9) * half * corners
    told = feet if stance.endswith("told") else None
    if stance == "legs that rock":
        # Those of one diagonal carry half as much again; points that coincide add up.
        feet = np.concatenate([*[feet[::2]] * 3, *[feet[1::2]] * 2])
    density = float(np.exp(rng.uniform(np.log(5.0), np.log(100.0))))
    dry = float(np.exp(rng.uniform(np.log(0.1), np.log(0.6))))
    truth = scene(outline, feet, density=density, dry=dry)
    force, _ = random_pushes(rng, NUM_ROWS, 1, reach)
    force = force * density * area * 9.81 * dry * rng.uniform(1.5, 4.0)
    start = truth.initial_state()
    states, _ = jax.jit(rollout)(
        truth.scene, truth.params(), start, jnp.asarray(force)[:, None]
    )
    read = np.concatenate([np.asarray(start.array)[None], np.asarray(states.array)])
    read = read + NOISE * rng.normal(size=read.shape)
    history = make_history(read[:-1], force[:, None], read[1:], DT)
    return scene(outline, told), history, density * area


@pytest.mark.slow
@pytest.mark.parametrize(
    "stance", ["all of it", "legs", "legs that rock", "legs that are told"]
)
def test_discs_and_boxes_that_slip_every_way_have_friction_and_no_wheel(stance):
    objects = [pushed_object(seed, stance) for seed in range(NUM_OBJECTS)]
    specs, histories, masses = zip(*objects, strict=True)
    found = infer_batch(jax.random.key(0), list(specs), list(histories))
    right = [p.structure_probabilities().get("friction", 0.0) for p in found]
    assert np.median(right) > 0.95
    # Nine feet are 1 to 2 % off an even pressure, which shows where a disc of 0.1 m
    # turns at 8 rad/s in every row: that one had a wheel, for certain.
    assert sorted(right)[1 if stance == "all of it" else 0] > 0.5
    for posterior, probability in zip(found, right, strict=True):
        # A wheel beside friction is never believed of what may stand in any way.
        assert probability > 0.5 or not posterior.diagnostics["ok"]
    for posterior, spec, mass in zip(found, specs, masses, strict=True):
        density = np.asarray(posterior.params.density)[:, 0]
        mean = posterior.weights @ density * float(spec.scene.area[0])
        assert mean == pytest.approx(mass, rel=0.06)


def test_a_wheel_beside_friction_is_doubted_where_nobody_gave_the_feet():
    spec, history, _ = pushed_object(1, "legs")
    told, *_ = pushed_object(1, "legs that are told")
    found = infer(jax.random.key(0), spec, history, method="laplace")

    def with_slots(wheel: bool, ground: bool):
        params = found.params
        return eqx.tree_at(
            lambda p: (p.params.wheel.active, p.params.ground.active),
            found,
            (
                jnp.full_like(params.wheel.active, wheel),
                jnp.full_like(params.ground.active, ground),
            ),
        )

    both = with_slots(True, True)
    (reason,) = stance_reasons(spec, both)
    assert reason.startswith("object: has a wheel beside friction with the floor")
    assert "probability 1.00" in reason
    assert "expected 'feet' in the scene, got none" in reason
    assert stance_reasons(told, both) == []
    assert stance_reasons(spec, with_slots(True, False)) == []
    assert stance_reasons(spec, with_slots(False, True)) == []
