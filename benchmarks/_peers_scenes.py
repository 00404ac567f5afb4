"""The scenes on which engines are compared, their starts, and who judges them."""

import dataclasses
import functools
import itertools
from collections.abc import Callable

import _repository  # noqa: F401
import numpy as np
from _overlap import deepest_overlap
from _peers_program import Figure
from scipy.integrate import solve_ivp

from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from tests.reference import chains

DT = 1.0 / 60.0
SIZE, DENSITY = (0.3, 0.1), 20.0
"""Half extents [m] and density [kg/m²] of the lone body."""
PIN = (0.1, 0.0)
WHEEL = {
    "type": "wheel",
    "a": "table",
    "pose": [0.2, 0.0, 0.0],
    "viscous": [1.0, 30.0],
    "dry": [2.0, 10.0],
}
NUM_BOXES, ROOM = 10, 2.4
"""How many boxes, and the side of the square room they are in [m]."""
LINKS = {"two": 2, "ten": 10}
"""How many links chains have."""
LINK = (0.1, 0.03)
"""Half extents of a link [m]."""
NUM_JUDGED = 16
"""Worlds whose overlaps are measured."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene, its starts, and its judge."""

    name: str
    spec: SceneSpec
    num_steps: int
    starts: Callable[[int], np.ndarray]
    """From a number of worlds to `[world, body, 6]`."""
    judge: Callable[[np.ndarray], list[Figure]]
    """From states `[world, time, body, 6]` to figures."""
    batches: tuple[int, ...]


def all_cases(*, is_quick: bool = False) -> list[Case]:
    """Every scene of the comparison.

    Args:
        is_quick: small batches only, and boxes only as a pile of one batch, for a
            second; a program for ten boxes takes long to compile.

    Returns:
        One body with a pin, and with a pin and a wheel; a pendulum; chains of two and
        of ten links; ten boxes in a room, flying and piling up.
    """
    few, many = (1, 64, 1024), (1, 64, 1024, 4096)
    box_steps = 300
    if is_quick:
        few, many, box_steps = (64,), (1, 64), 60
    pinned, wheeled = _table([0.0, 0.0]), _table([0.0, 0.0], [WHEEL])
    pendulum = _table([0.0, -9.81], anchor=[-SIZE[0], 0.0])
    flying, piling = _room([0.0, 0.0]), _room([0.0, -9.81])
    cases = [
        Case("pin, 100 steps", pinned, 100, _spinning, _judge_spin(None), many),
        Case(
            "pin and wheel, 100 steps", wheeled, 100, _spinning, _judge_spin(30.0), many
        ),
        Case("pendulum, 300 steps", pendulum, 300, _hanging, _judge_pendulum, many),
    ]
    for name, num in {} if is_quick else LINKS.items():
        starts = functools.partial(_falling, num)
        judge = functools.partial(_judge_chain, num)
        case = f"chain of {name}, 60 steps"
        cases.append(Case(case, _chain(num), 60, starts, judge, few))
    rooms = [("piling up", piling, 0.3)]
    if not is_quick:
        rooms.append(("flying", flying, 1.0))
    for what, spec, speed in rooms:
        cases.append(
            Case(
                f"ten boxes {what}, {box_steps} steps",
                spec,
                box_steps,
                functools.partial(_scattered, spec, speed=speed),
                _judge_boxes(spec),
                few,
            )
        )
    return cases


def _table(gravity, constraints=(), anchor=PIN) -> SceneSpec:
    pin = {"type": "revolute", "a": "table", "b": "world"}
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": gravity,
            "dt": DT,
            "bodies": [
                {
                    "name": "table",
                    "pose": [-anchor[0], -anchor[1], 0.0],
                    "shape": {"type": "box", "half_extents": list(SIZE)},
                    "density": DENSITY,
                }
            ],
            "constraints": [
                {**pin, "anchor_a": list(anchor), "anchor_b": [0.0, 0.0]},
                *constraints,
            ],
        }
    )


def _spinning(num_worlds: int) -> np.ndarray:
    """On the pin, heading 0, at spins from 1 to 5 rad/s."""
    spin = np.linspace(5.0, 1.0, num_worlds)
    zero = np.zeros(num_worlds)
    state = np.stack([zero - PIN[0], zero, zero, zero, -PIN[0] * spin, spin], axis=1)
    return state[:, None]


def _hanging(num_worlds: int) -> np.ndarray:
    """At rest; the first is horizontal, the others within a tenth of a radian."""
    angle = np.linspace(0.0, 0.1, num_worlds)
    state = np.zeros((num_worlds, 1, 6))
    state[:, 0, 0], state[:, 0, 1] = SIZE[0] * np.cos(angle), SIZE[0] * np.sin(angle)
    state[:, 0, 2] = angle
    return state


def _links(num: int) -> chains.Chain:
    return chains.bars(num, half_length=LINK[0], half_width=LINK[1], density=DENSITY)


def _chain(num: int) -> SceneSpec:
    """Links pinned one to the next, the first to the world."""
    names = [f"link {i}" for i in range(num)]
    near, far = [-LINK[0], 0.0], [LINK[0], 0.0]
    pin = {"type": "revolute"}
    pins = [
        {**pin, "a": names[0], "b": "world", "anchor_a": near, "anchor_b": [0.0, 0.0]}
    ] + [
        {**pin, "a": before, "b": name, "anchor_a": far, "anchor_b": near}
        for before, name in itertools.pairwise(names)
    ]
    links = [
        {
            "name": name,
            "pose": [(2 * i + 1) * LINK[0], 0.0, 0.0],
            "shape": {"type": "box", "half_extents": list(LINK)},
            "density": DENSITY,
        }
        for i, name in enumerate(names)
    ]
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, -9.81],
            "dt": DT,
            "bodies": links,
            "constraints": pins,
        }
    )


def _falling(num_links: int, num_worlds: int) -> np.ndarray:
    """Straight and at rest, an eighth of a turn below level, or a little more."""
    angle = -np.pi / 4 - np.linspace(0.0, 0.1, num_worlds)
    reach = (2 * np.arange(num_links) + 1) * LINK[0]
    state = np.zeros((num_worlds, num_links, 6))
    state[..., 0], state[..., 1] = (
        np.outer(np.cos(angle), reach),
        np.outer(np.sin(angle), reach),
    )
    state[..., 2] = angle[:, None]
    return state


def _judge_chain(num_links: int, states: np.ndarray) -> list[Figure]:
    """The first world against the chain in its joint angles."""
    rest = np.zeros(num_links)
    times = DT * np.arange(states.shape[1] + 1)
    angles, _ = chains.integrate(_links(num_links), rest - np.pi / 4, rest, times)
    wrong = np.angle(np.exp(1j * (states[0, :, :, 2] - angles[1:])))
    return [
        Figure("worst heading in a second", float(np.abs(wrong).max()), "rad", 1.0),
        Figure(
            "first pin's drift",
            1e3 * _drift(states[..., :1, :], (-LINK[0], 0)),
            "mm",
            300,
        ),
    ]


def _judge_spin(viscous: float | None) -> Callable[[np.ndarray], list[Figure]]:
    """Against I θ'' = -r min(c r θ', limit), r the wheel's distance from the pin."""

    def judge(states: np.ndarray) -> list[Figure]:
        time = DT * states.shape[1]
        mass = 4.0 * SIZE[0] * SIZE[1] * DENSITY
        inertia = mass * ((SIZE[0] ** 2 + SIZE[1] ** 2) / 3.0 + PIN[0] ** 2)
        lever = WHEEL["pose"][0] - PIN[0]
        worst = 0.0
        spins = _spinning(len(states))[:, 0, 5]
        for spin, end in zip(spins, states[:, -1, 0], strict=True):
            expected = spin * time
            if viscous is not None:

                def rate(_, y):
                    push = min(viscous * lever * y[1], WHEEL["dry"][1])
                    return [y[1], -lever * push / inertia]

                solved = solve_ivp(rate, (0.0, time), [0.0, spin], rtol=1e-9, atol=1e-9)
                expected = float(solved.y[0, -1])
            error = 2.0 * abs(np.sin(0.5 * (end[2] - expected)))
            worst = float(np.maximum(worst, error))
        return [
            Figure("largest error of the heading", worst, "rad"),
            Figure("largest drift off the pin", 1e3 * _drift(states, PIN), "mm", 300),
        ]

    return judge


def _judge_pendulum(states: np.ndarray) -> list[Figure]:
    chain = chains.bars(1, half_length=SIZE[0], half_width=SIZE[1], density=DENSITY)
    num_steps = states.shape[1]
    angle, _ = chains.integrate(chain, [0.0], [0.0], np.array([DT * num_steps]))
    end = states[0, -1]
    scale = chain.mass[0] * chain.gravity * SIZE[0]
    difference = np.angle(np.exp(1j * (end[0, 2] - angle[-1, 0])))
    moved = float(np.ptp(states[0, :, 0, 2]))
    return [
        Figure("error of the angle after 5 s", abs(difference), "rad"),
        Figure("energy gained after 5 s", chains.energy(chain, end) / scale, "m g l"),
        Figure("drift off the pin", 1e3 * _drift(states[:1], (-SIZE[0], 0)), "mm", 300),
        Figure(
            "swing that is missing", float(np.maximum(0.0, 2.0 - moved)), "rad", 1.0
        ),
    ]


def _drift(states: np.ndarray, anchor) -> float:
    """Largest distance of the anchor from the origin, where the pin is [m]."""
    cos, sin = np.cos(states[..., 2]), np.sin(states[..., 2])
    x = states[..., 0] + cos * anchor[0] - sin * anchor[1]
    y = states[..., 1] + sin * anchor[0] + cos * anchor[1]
    return float(np.hypot(x, y).max())


def _room(gravity) -> SceneSpec:
    """Ten boxes of 0.2 to 0.4 m, the same in all worlds, between four thick walls."""
    rng = np.random.default_rng(0)
    contact = {"friction": 0.3, "restitution": 0.0}
    bodies = [
        {
            "name": f"box {i}",
            "pose": [0.0, 0.0, 0.0],
            "contact": contact,
            "shape": {"type": "box", "half_extents": rng.uniform(0.1, 0.2, 2).tolist()},
            "density": DENSITY,
        }
        for i in range(NUM_BOXES)
    ]
    half, thick = 0.5 * ROOM, 0.5
    for name, x, y in (
        ("floor", 0, -1),
        ("ceiling", 0, 1),
        ("left", -1, 0),
        ("right", 1, 0),
    ):
        extents = [half + 2 * thick, thick] if x == 0 else [thick, half + 2 * thick]
        bodies.append(
            {
                "name": name,
                "pose": [x * (half + thick), y * (half + thick), 0.0],
                "contact": contact,
                "shape": {"type": "box", "half_extents": extents},
                "static": True,
            }
        )
    return scene_spec_from_dict(
        {"schema": "planar-scene-1", "gravity": gravity, "dt": DT, "bodies": bodies}
    )


def _scattered(spec: SceneSpec, num_worlds: int, *, speed: float) -> np.ndarray:
    """Boxes in random cells of a grid, at random headings and velocities."""
    rng = np.random.default_rng(1)
    column, row = np.meshgrid(np.arange(4), np.arange(3))
    cells = np.stack([column.ravel(), row.ravel()], axis=1)
    cell = np.array([ROOM / 4, ROOM / 3])
    state = np.zeros((num_worlds, spec.num_bodies, 6))
    state[:, NUM_BOXES:, :3] = spec.pose[NUM_BOXES:]
    for world in range(num_worlds):
        chosen = rng.permutation(len(cells))[:NUM_BOXES]
        jitter = rng.uniform(-0.5, 0.5, (NUM_BOXES, 2)) * (cell - 0.58)
        boxes = state[world, :NUM_BOXES]
        boxes[:, :2] = (cells[chosen] + 0.5) * cell - 0.5 * ROOM + jitter
        boxes[:, 2] = rng.uniform(-np.pi, np.pi, NUM_BOXES)
        boxes[:, 3:] = speed * rng.normal(size=(NUM_BOXES, 3))
    return state


def _judge_boxes(spec: SceneSpec) -> Callable[[np.ndarray], list[Figure]]:
    def judge(states: np.ndarray) -> list[Figure]:
        escape = float(np.abs(states[:, :, :NUM_BOXES, :2]).max() - 0.5 * ROOM)
        pose = states[:NUM_JUDGED, ..., :3]
        depth = deepest_overlap(spec, pose)
        speed = np.linalg.norm(states[:, -1, :NUM_BOXES, 3:5], axis=-1)
        return [
            Figure("deepest overlap", 1e3 * float(depth.max()), "mm"),
            Figure("deepest overlap at the end", 1e3 * float(depth[:, -1].max()), "mm"),
            Figure("mean speed at the end", float(speed.mean()), "m/s"),
            Figure(
                "furthest centre out of the room",
                float(np.maximum(0.0, escape)),
                "m",
                0.0,
            ),
        ]

    return judge
