"""How long until a first posterior, compilation and all?

Each case runs in a process of its own with nothing compiled beforehand, and then again
on another recording of the same scene. Any two bodies may be tied by a pin, and each
may be pinned to the world, roll on a wheel and rub on the floor; all of this is unknown
of a pair of boxes that hang together by a pin, and of a room of five: such a pair, a
table that is pinned, a cart and a loose box. Every body is pushed about at random; the
truth is simulated by the library's engine, readings scatter by 1 mm, 1 mrad, 5 mm/s and
5 mrad/s. The answer is checked first: pins and wheels that truly are have more than
nine tenths, all others less than a half. One object alone stands beside them.
"""

import json
import os
import subprocess
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _report import Reporter, parser_of

import boomdp_jax
from boomdp_jax.core.history import History, make_history
from boomdp_jax.interop.recording import READING_NOISE
from boomdp_jax.physics import rollout, scene_spec_from_dict
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

NUM_ROWS, DT = 60, 0.02
TARGETS = {"object": None, "pair": 60.0, "room": 180.0}
"""Seconds of the first call; the second may take a tenth."""

_CHANNEL = np.array([0, 0, 1, 2, 2, 3])
_UNKNOWN = {"revolute": 1, "wheel": 1, "ground": 1}
_FLOOR = {"type": "ground", "dry": 0.15}


def main() -> None:
    parser = parser_of(__doc__, quick="the lone object only")
    parser.add_argument("--cases", nargs="+", choices=TARGETS, default=tuple(TARGETS))
    parser.add_argument("--worker", choices=TARGETS, help="run one case in here")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.worker:
        print(json.dumps(measure(arguments.worker, arguments.seed)))
        return
    reporter = Reporter(arguments.out)
    for name in ("object",) if arguments.quick else arguments.cases:
        found = in_a_process_of_its_own(name, arguments.seed)
        target = TARGETS[name]
        reporter.report(
            case=name,
            metric="constraints with other than their true truth value",
            value=found["num_wrong"],
            n=found["num_constraints"],
            target=0,
            met=found["num_wrong"] == 0,
        )
        for which, seconds in (("first", found["first"]), ("second", found["second"])):
            goal = target if which == "first" or target is None else 0.1 * target
            reporter.report(
                case=name,
                metric=f"{which} call",
                value=seconds,
                unit="s",
                n=1,
                target=goal,
                met=None if goal is None else seconds < goal,
            )
    reporter.print_table()


def in_a_process_of_its_own(name: str, seed: int) -> dict:
    """What `measure` finds there, where no programs are kept."""
    run = subprocess.run(
        [sys.executable, __file__, "--worker", name, "--seed", str(seed)],
        stdout=subprocess.PIPE,
        env=os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"},
        check=True,
        text=True,
    )
    return json.loads(run.stdout.splitlines()[-1])


def measure(name: str, seed: int) -> dict:
    """Infer a scene twice, from two recordings of it."""
    truth, spec = scenes(name)
    true = {
        constraint_name(spec, c.kind, c.body_a, c.body_b) for c in truth.constraints
    }
    seconds, num_wrong, num = [], 0, 0
    for number in range(2):
        history = recorded(truth, seed + number)
        start = time.perf_counter()
        posterior = boomdp_jax.infer(jax.random.key(seed + number), spec, history)
        seconds.append(time.perf_counter() - start)
        found = probabilities(spec, posterior)
        for key, p in found.items():
            is_wrong = not (p > 0.9 if key in true else p < 0.5)
            num_wrong, num = num_wrong + is_wrong, num + 1
    first, second = seconds
    return {
        "first": first,
        "second": second,
        "num_wrong": num_wrong,
        "num_constraints": num,
    }


def constraint_name(spec: SceneSpec, kind: str, a: int, b: int) -> str:
    """The same for both ways round."""
    bodies = sorted(spec.names[i] for i in (a, b) if i != WORLD)
    return f"{kind} of {' and '.join(bodies)}"


def probabilities(spec: SceneSpec, posterior: boomdp_jax.Posterior) -> dict[str, float]:
    """Of each pin and wheel that may exist, but for pairs that were screened out."""
    weights, out = posterior.weights, {}
    for kind in ("revolute", "distance", "wheel", "ground"):
        slots: Any = getattr(posterior.params, kind)
        active = np.asarray(slots.active)
        if kind in ("wheel", "ground"):
            ends = {
                (i, WORLD): active[:, i].any(axis=1) for i in range(active.shape[1])
            }
        else:
            a, b = np.asarray(slots.body_a)[0], np.asarray(slots.body_b)[0]
            ends = {(a[i], b[i]): active[:, i] for i in range(active.shape[1])}
        for (a, b), is_there in ends.items():
            out[constraint_name(spec, kind, a, b)] = float(weights @ is_there)
    return out


def scenes(name: str) -> tuple[SceneSpec, SceneSpec]:
    """What is true, and what is known of it."""

    def box(name: str, x: float, y: float, angle: float = 0.0) -> dict:
        shape = {"type": "box", "half_extents": [0.25, 0.15]}
        return {"name": name, "shape": shape, "pose": [x, y, angle]}

    pin = {"type": "revolute", "a": "left", "b": "right", "dry": 0.2}
    pin |= {"anchor_a": [0.3, 0.0], "anchor_b": [-0.3, 0.0]}
    bodies = [box("left", 0.0, 0.0), box("right", 0.6, 0.0)]
    constraints: list[dict] = [pin]
    if name == "object":
        bodies, constraints = bodies[:1], []
    if name == "room":
        bodies += [box("table", 3.0, 0.0, 0.5), box("cart", 0.0, 3.0), box("box", 3, 3)]
        constraints += [
            {"type": "revolute", "a": "table", "b": "world", "dry": 0.3}
            | {"anchor_a": [0.1, 0.05], "anchor_b": [3.0638, 0.0918]},
            {"type": "wheel", "a": "cart", "pose": [-0.2, 0.0, 0.0]}
            | {"viscous": [1.0, 60.0]},
        ]
    constraints += [_FLOOR | {"a": body["name"]} for body in bodies]
    common = {"schema": "planar-scene-1", "dt": DT}
    densities = (30.0, 60.0, 40.0, 50.0, 20.0)
    known = [b | {"density": d} for b, d in zip(bodies, densities, strict=False)]
    truth = {**common, "bodies": known, "constraints": constraints}
    hidden = {**common, "bodies": bodies, "unknown": _UNKNOWN}
    return scene_spec_from_dict(truth), scene_spec_from_dict(hidden)


def recorded(truth: SceneSpec, seed: int) -> History:
    """Every body is pushed about, all at the same time."""
    rng = np.random.default_rng([seed, truth.num_bodies])
    num = truth.num_bodies
    # Pushes of a fifth of a second.
    held = rng.normal(size=(-(-NUM_ROWS // 10), num, 3)) * [15.0, 15.0, 2.0]
    wrench = np.repeat(held, 10, axis=0)[:NUM_ROWS]
    start = truth.initial_state()
    run, _ = jax.jit(rollout)(
        truth.scene, truth.params(), start, jnp.asarray(wrench, start.pose.dtype)
    )
    state = np.concatenate([np.asarray(start.array)[None], np.asarray(run.array)])
    scale = np.asarray(READING_NOISE)[_CHANNEL]
    state = state + scale * rng.normal(size=state.shape)
    return make_history(state[:-1], wrench, state[1:], DT)


if __name__ == "__main__":
    main()
