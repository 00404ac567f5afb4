"""What substeps, sweeps, softness and warm start are worth to a tower of five boxes.

Ten seconds at 60 Hz, boxes of half a metre on a floor, the same with a hundredfold mass
on top, and with impulses forgotten from step to step. Nothing here is right or wrong;
the engine's choice stands in the first row, and `contact_impulses` says why.
"""

import concurrent.futures
import dataclasses
import multiprocessing
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _report import Reporter, parser_of

from boomdp_jax.physics import contact_impulses, empty_cache, scene_spec_from_dict, step

HALF, NUM_BOXES, DT = 0.25, 5, 1.0 / 60.0


class Setting(NamedTuple):
    """How contacts are solved."""

    name: str
    num_substeps: int = 4
    num_sweeps: int = 1
    is_soft: bool = True
    """Or as Baumgarte (1972) has it: a fifth of an overlap is undone in a substep."""
    is_warm: bool = True
    """Whether steps start from the impulses of the step before."""
    top: float = 1.0
    """Mass of the uppermost box over that of the others."""


SETTINGS = [
    Setting("four substeps"),
    Setting("four substeps, cold", is_warm=False),
    Setting("four substeps, hard", is_soft=False),
    Setting("two substeps", 2),
    Setting("two substeps of two sweeps", 2, 2),
    Setting("one substep of four sweeps", 1, 4),
    Setting("four substeps, hundredfold mass on top", top=100.0),
    Setting("four substeps, hard, hundredfold mass on top", is_soft=False, top=100.0),
]


def tower(top: float):
    """The scene."""
    contact = {"friction": 0.5, "restitution": 0.0}

    def box(name, half, pose, **more):
        shape = {"type": "box", "half_extents": half}
        entry = {"name": name, "shape": shape, "pose": pose, "density": 20.0}
        return {**entry, "contact": contact, **more}

    boxes = [
        box(f"box {i}", [HALF, HALF], [0.0, (2 * i + 1) * HALF, 0.0])
        for i in range(NUM_BOXES)
    ]
    boxes[-1]["density"] *= top
    floor = box("floor", [5.0, 0.5], [0.0, -0.5, 0.0], static=True)
    scene = {"schema": "planar-scene-1", "gravity": [0.0, -9.81], "dt": DT}
    return scene_spec_from_dict({**scene, "bodies": [*boxes, floor]})


def run(setting: Setting, num_steps: int):
    """Poses and overlaps of every step; in a process of its own."""
    if not setting.is_soft:
        # Before anything is traced: programs are remembered.
        contact_impulses._SOFTNESS, contact_impulses._SHARE = 0.0, 0.2
    spec = tower(setting.top)
    sizes = {"num_substeps": setting.num_substeps, "num_sweeps": setting.num_sweeps}
    scene, params = dataclasses.replace(spec.scene, **sizes), spec.params()
    wrench = jnp.zeros_like(spec.initial_state().pose)
    cold = empty_cache(scene)

    def advance(carry, _):
        state, cache = carry
        start = cache if setting.is_warm else cold
        state, info = step(scene, params, state, wrench, cache=start)
        return (state, info.cache), (state.pose, info.overlap)

    first = (spec.initial_state(), cold)
    out = jax.jit(lambda carry: jax.lax.scan(advance, carry, None, num_steps))(first)
    return jax.tree.map(np.asarray, out[1])


def main() -> int:
    """Print how deep and how far it goes with each setting."""
    arguments = parser_of(__doc__).parse_args()
    reporter = Reporter(arguments.out)
    for setting in SETTINGS[:2] if arguments.quick else SETTINGS:
        with concurrent.futures.ProcessPoolExecutor(
            1, mp_context=multiprocessing.get_context("spawn")
        ) as pool:
            poses, overlap = pool.submit(run, setting, 600).result()
        moved = np.abs(poses[:, :NUM_BOXES] - poses[0, :NUM_BOXES])
        late = np.abs(poses[-60:, :NUM_BOXES] - poses[-1, :NUM_BOXES])
        for metric, value in (
            ("deepest overlap", overlap.max()),
            ("overlap in the last second", overlap[-60:].max()),
            ("furthest move", moved[..., :2].max()),
            ("movement in the last second", late[..., :2].max()),
        ):
            case = f"tower, {setting.name}"
            reporter.report(case=case, metric=metric, value=1e3 * value, unit="mm")
    reporter.print_table()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
