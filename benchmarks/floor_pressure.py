"""What stands on the floor in ways that the scene does not tell: has it a wheel?

Discs and boxes press on the floor with all of their area, with four legs at their
corners, legs that carry unequal loads or stand under a part of the outline, with a rim
or with three legs, and slip in 60 pushes each. The truth is this
engine's own step with up to 64 points, so that nothing but where the load rests is in
question. A scene that gives no feet leaves that to be found; legs that it gives are
known. An object is right where friction with the floor and no wheel and no pin has more
than half of the posterior probability.
"""

import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from _report import Reporter, parser_of

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.infer import infer_batch
from boomdp_jax.interop.object_families import random_pushes
from boomdp_jax.interop.recording import READING_NOISE
from boomdp_jax.physics import rollout
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

DT, NUM_ROWS = 0.02, 60
NOISE = np.array(READING_NOISE)[[0, 0, 1, 2, 2, 3]]
STANCES = (
    "all of it",
    "four legs",
    "four legs, told",
    "legs that rock",
    "legs that rock, told",
    "legs under a part",
    "rim",
    "three legs",
)
CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def main() -> None:
    parser = parser_of(__doc__, quick="2 objects of each")
    parser.add_argument("--objects", type=int, default=16, help="of each stance")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--stances", nargs="+", choices=STANCES, default=STANCES)
    arguments = parser.parse_args()
    reporter = Reporter(arguments.out)
    num = 2 if arguments.quick else arguments.objects
    for stance in arguments.stances:
        objects = [pushed_object([arguments.seed, i], stance) for i in range(num)]
        specs, histories, truths = zip(*objects, strict=True)
        start = time.perf_counter()
        found = infer_batch(
            jax.random.key(arguments.seed), list(specs), list(histories), progress=True
        )
        seconds = time.perf_counter() - start
        results = [
            score(posterior, spec, truth)
            for posterior, spec, truth in zip(found, specs, truths, strict=True)
        ]
        for index, result in enumerate(results):
            if result["friction"] < 0.95 or not result["is_ok"]:
                print(
                    f"{stance} {index}: {json.dumps(result)}",
                    file=sys.stderr,
                    flush=True,
                )
        report(reporter, stance, results, seconds)
    reporter.print_table()


def points_of(kind: str, stance: str, half: np.ndarray, rng) -> np.ndarray:
    """Where the load rests, in equal parts, about the middle of the outline [m]."""
    share = rng.uniform(0.5, 0.95)
    turn = rng.uniform(0.0, 2.0 * np.pi)
    if stance == "three legs":
        angle = turn + np.arange(3) / 3 * 2 * np.pi
        return share * half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if "legs" in stance:
        corners = CORNERS / np.sqrt(2) if kind == "circle" else CORNERS
        uneven = rng.uniform(0.5, 0.95, 2) if stance.endswith("part") else share
        return uneven * half * corners
    if stance == "rim":
        if kind == "circle":
            angle = np.arange(64) / 64 * 2 * np.pi
            return 0.97 * half * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        side = (np.arange(16) + 0.5) / 8 - 1
        flat, one = np.stack([side, np.ones(16)], axis=1), np.array([1.0, -1.0])
        sides = [flat, flat * one, flat[:, ::-1], flat[:, ::-1] * one[::-1]]
        return 0.97 * half * np.concatenate(sides)
    if kind == "circle":
        number = np.arange(64) + 0.5
        radius, angle = np.sqrt(number / 64), np.pi * (1 + 5**0.5) * number
        points = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        side = (np.arange(8) + 0.5) / 4 - 1
        points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    return half * (points - points.mean(axis=0))


def scene(outline: dict, feet: np.ndarray | None, **known: float):
    """Scene of the one object, its numbers known or all to be found."""
    body = {"name": "object", "shape": outline, "pose": [0.1, -0.2, 0.3]}
    if feet is not None:
        body["feet"] = feet.tolist()
    content: dict = {"schema": "planar-scene-1", "dt": DT}
    if known:
        body["density"] = known["density"]
        floor = {"type": "ground", "a": "object", "dry": known["dry"]}
        content["constraints"] = [floor]
    else:
        content["unknown"] = {"revolute": 1, "wheel": 1, "ground": 1}
    return scene_spec_from_dict(content | {"bodies": [body]})


def pushed_object(seed: list[int], stance: str):
    """What is told of an object, its readings, and what is true of it."""
    rng = np.random.default_rng(seed)
    half = np.sort(rng.uniform(0.1, 0.4, 2))[::-1]
    kind = "box" if seed[-1] % 2 else "circle"
    if kind == "box":
        outline = {"type": "box", "half_extents": half.tolist()}
        area, reach = 4 * half[0] * half[1], float(np.hypot(*half))
    else:
        half = np.full(2, half[1])
        outline = {"type": "circle", "radius": half[0]}
        area, reach = np.pi * half[0] ** 2, half[0]
    legs = feet = points_of(kind, stance, half, rng)
    if "rock" in stance:
        # Points that coincide carry their shares together: the second diagonal's legs
        # stand for one to three times as many as the first one's.
        more = np.repeat(legs[1::2], 3 + seed[-1] % 5, axis=0)
        feet = np.concatenate([np.repeat(legs[::2], 3, axis=0), more])
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
    told = legs if stance.endswith("told") else None
    return scene(outline, told), history, {"mass": density * area, "friction": dry}


def score(posterior, spec, truth: dict) -> dict:
    """Probabilities, and how far off mass and friction of the floor are."""
    names = posterior.structure_probabilities()
    weights = posterior.weights
    mass = np.asarray(posterior.params.density)[:, 0] * float(spec.scene.area[0])
    ground = jax.tree.map(np.asarray, posterior.params.ground)
    is_on = ground.active[:, 0, 0]
    dry = np.nan
    if is_on.any():
        dry = weights[is_on] @ ground.dry[is_on, 0, 0] / weights[is_on].sum()
    wheel = float(weights @ np.asarray(posterior.params.wheel.active).any((1, 2)))
    return {
        "friction": float(names.get("friction", 0.0)),
        "wheel": wheel,
        "mass": float(weights @ mass / truth["mass"] - 1.0),
        "dry": float(dry / truth["friction"] - 1.0),
        "is_ok": bool(posterior.diagnostics["ok"]),
    }


def report(reporter: Reporter, stance: str, results: list[dict], seconds: float):
    """Shares and errors of one stance."""
    column = {key: np.array([r[key] for r in results]) for key in results[0]}
    is_told = stance.endswith("told")
    values = {
        "share right": np.mean(column["friction"] > 0.5),
        "share with probability >= 0.95": np.mean(column["friction"] >= 0.95),
        "share with a wheel, ok": np.mean((column["wheel"] > 0.5) & column["is_ok"]),
        "share ok": np.mean(column["is_ok"]),
        "median error of the mass": np.median(np.abs(column["mass"])),
        "median error of the friction": np.nanmedian(np.abs(column["dry"])),
        "time per object": seconds / len(results),
    }
    for metric, value in values.items():
        is_target = metric == "share right" and (is_told or stance != "three legs")
        reporter.report(
            case=stance,
            metric=metric,
            value=float(value),
            unit="s" if metric.startswith("time") else "",
            n=len(results),
            target=1.0 if is_target else None,
            met=bool(value >= 1.0) if is_target else None,
        )


if __name__ == "__main__":
    main()
