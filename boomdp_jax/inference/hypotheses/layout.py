"""Which constraints may exist in a block of bodies, and which coordinate means what."""

import itertools
import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.hypotheses.prior import PriorOptions
from boomdp_jax.inference.hypotheses.redundancy import NEW_KINDS, Tie, is_redundant
from boomdp_jax.physics.constraint_spec import JOINTS, KINDS
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

NUM_COORDINATES = {
    "revolute": 6,
    "distance": 5,
    "prismatic": 5,
    "weld": 3,
    "wheel": 8,
    "ground": 9,
}
"""Coordinates of one constraint of each kind; see `coordinates.py` for their order."""

DIRECTION = {"wheel": 2, "prismatic": 0}
"""Which coordinate of a kind is a direction, the same when turned by half a turn: a
wheel's heading, a drawer's axis."""

_MAX_STRUCTURES = 4096
_MAX_SLOTS = 12
"""Constraints that may exist in a block: as many as `_MAX_STRUCTURES` allows where each
exists at most once. Programs grow with them: 18 took over two minutes to compile."""

BODY_NUMBERS = {
    "center_of_mass": 2,
    "actuator.gain": 1,
    "actuator.bias": 3,
    "actuator.delay": 1,
}
"""Coordinates of what may be inferred of a body besides its density; a name is the way
to it in `Params`."""


class BodyNumber(NamedTuple):
    """What is inferred of a body besides its density."""

    name: str
    body: int
    start: int
    """First coordinate."""


class SlotKey(NamedTuple):
    """One place in `Params` that a constraint may take."""

    kind: str
    body_a: int
    body_b: int
    index: int
    """Slot of the scene for joints; slot of its body for wheel and ground."""
    start: int
    """First coordinate."""
    known: int
    """Entry of the scene's constraints that lies here; -1: inferred."""


class Layout(NamedTuple):
    """Slots and coordinates of a block; static, so that equal blocks share a program.

    Coordinates: the log-density of each body, those of each slot, numbers of bodies
    and, last, of contact.
    """

    num_bodies: int
    slots: tuple[SlotKey, ...]
    """Inferred slots; a structure says which of them are active."""
    known_slots: tuple[SlotKey, ...]
    """Slots of constraints that are known to exist."""
    dim: int
    numbers: tuple[BodyNumber, ...] = ()
    contact: tuple[str, ...] = ()
    """Numbers of contact that are inferred, `friction` or `restitution`, whose
    coordinates are the last ones."""

    def contact_coordinate(self, name: str) -> int:
        """Which coordinate a number of contact has."""
        return self.dim - len(self.contact) + self.contact.index(name)

    def count(self, kind: str) -> int:
        """How many slots of a kind `Params` needs (per body for wheel and ground)."""
        slots = [s for s in self.slots + self.known_slots if s.kind == kind]
        return max((s.index for s in slots), default=-1) + 1

    def slot_of_coordinate(self) -> np.ndarray:
        """Slot of each coordinate, `[dim]`; -1: of no inferred slot."""
        out = np.full(self.dim, -1)
        for i, slot in enumerate(self.slots):
            out[slot.start : slot.start + NUM_COORDINATES[slot.kind]] = i
        return out

    def period(self) -> np.ndarray:
        """Period of each coordinate, `[dim]`: pi for directions, else 0."""
        out = np.zeros(self.dim)
        for slot in self.slots + self.known_slots:
            if slot.kind in DIRECTION:
                out[slot.start + DIRECTION[slot.kind]] = math.pi
        return out

    @property
    def has_delay(self) -> bool:
        """Whether commands take effect later than they were given."""
        return any(number.name == "actuator.delay" for number in self.numbers)

    @property
    def rests(self) -> tuple[SlotKey, ...]:
        """Drawers and welds, measured from where the bodies were seen."""
        return self._of_kinds(NEW_KINDS)

    @property
    def meetings(self) -> tuple[SlotKey, ...]:
        """Pins and rods, measured from where the bodies were seen."""
        return self._of_kinds(("revolute", "distance"))

    def _of_kinds(self, kinds: Collection[str]) -> tuple[SlotKey, ...]:
        slots = sorted(self.slots + self.known_slots, key=lambda slot: slot.start)
        return tuple(slot for slot in slots if slot.kind in kinds)


def block_layout(
    spec: SceneSpec,
    bodies: tuple[int, ...],
    contact: tuple[str, ...] = (),
    *,
    may_tie: bool = True,
) -> Layout:
    """Lay out the constraints that a block of bodies may have.

    Args:
        spec: the scene.
        bodies: indices of the block's bodies in the scene, ascending.
        contact: numbers of contact that are inferred.
        may_tie: whether pairs have slots. Those of which the prior has none would only
            make the block too large.

    Returns:
        The layout; its body indices count within the block.

    Raises:
        ValueError: the scene has a joint that inference cannot take along.
    """
    _refuse_drives(spec)
    place = {body: i for i, body in enumerate(bodies)}
    start = len(bodies)
    counts = dict.fromkeys(JOINTS, 0)
    per_body = {
        (kind, i): 0 for kind in ("wheel", "ground") for i in range(len(bodies))
    }
    known, inferred = [], []

    def add(out, kind, a, b, entry):
        nonlocal start
        if kind in counts:
            index = counts[kind]
            counts[kind] += 1
        else:
            index = per_body[kind, a]
            per_body[kind, a] += 1
        out.append(SlotKey(kind, a, b, index, start, entry))
        start += NUM_COORDINATES[kind]

    for entry, constraint in enumerate(spec.constraints):
        if constraint.body_a in place:
            partner = place.get(constraint.body_b, WORLD)
            add(known, constraint.kind, place[constraint.body_a], partner, entry)
    movable = [i for i, body in enumerate(bodies) if not spec.is_static[body]]
    for kind in KINDS:
        for i in movable:
            for _ in range(spec.unknown.get(kind, 0)):
                add(inferred, kind, i, WORLD, -1)
    for kind in JOINTS:
        if may_tie and spec.unknown.get(kind, 0):
            for i, j in itertools.combinations(movable, 2):
                add(inferred, kind, i, j, -1)
    numbers = []
    for i in movable:
        for name, count in BODY_NUMBERS.items():
            is_unknown = name in spec.unknown_numbers
            if name == "center_of_mass":
                is_unknown = bool(spec.is_center_unknown[bodies[i]])
            if is_unknown:
                numbers.append(BodyNumber(name, i, start))
                start += count
    return Layout(
        len(bodies),
        tuple(inferred),
        tuple(known),
        start + len(contact),
        tuple(numbers),
        contact,
    )


def _refuse_drives(spec: SceneSpec) -> None:
    """Ranges and motors, of which inference would otherwise take no notice."""
    for index, constraint in enumerate(spec.constraints):
        extras = sorted({"limit", "motor"} & constraint.numbers.keys())
        if not extras:
            continue
        what = " with a ".join([constraint.kind, *extras])
        raise ValueError(
            f"{spec.source}: constraints[{index}]: inference expected one of "
            f"{', '.join(KINDS)}, without limits and motors; got {what}"
        )


def structures(
    layout: Layout,
    caps: dict[str, int],
    options: PriorOptions,
    *,
    is_loaded: bool = True,
    source: str = "",
) -> tuple[np.ndarray, np.ndarray]:
    """Every structure that a block may have, and its prior.

    Each optional constraint is present independently, truncated to the caps. Of slots
    that could be exchanged only the canonical choice is listed: the first ones are in
    use. What fewer constraints say as well is left out, see `redundancy`: a weld to
    the world stands alone, and pin and drawer exclude each other.

    Args:
        layout: slots of the block.
        caps: most inferred constraints of each kind that one body may have.
        options: probabilities.
        is_loaded: whether the floor carries the bodies. What it does not carry has no
            wheel and no friction with it: such structures are listed, so that shapes do
            not depend on the load, with a probability of zero.
        source: file of the scene, for messages.

    Returns:
        Active slots, `[structure, slot]`, and normalised log-probabilities.

    Raises:
        ValueError: more structures than can be told apart one by one, or of more
            constraints than compile in reasonable time.
    """
    check_size(layout, source)
    groups = _exchangeable(layout)
    sizes = [len(group) + 1 for group in groups.values()]
    needs_load = [slot.kind in ("wheel", "ground") for slot in layout.slots]
    needs_load = np.array(needs_load, bool)
    known = [Tie(s.kind, s.body_a, s.body_b, False) for s in layout.known_slots]
    rows, weights = [], []
    for counts in itertools.product(*(range(size) for size in sizes)):
        used: dict[tuple, int] = {}
        weight, row = 0.0, np.zeros(len(layout.slots), bool)
        for ((kind, a, b), group), count in zip(groups.items(), counts, strict=True):
            is_tie = b != WORLD
            p = options.probability["tie" if is_tie else kind]
            for body in (a, b) if is_tie else (a,):
                used[kind, body] = used.get((kind, body), 0) + count
            row[group[:count]] = True
            weight += math.log(math.comb(len(group), count))
            weight += _log_power(p, count) + _log_power(1 - p, len(group) - count)
        if (
            weight > -math.inf
            and all(count <= caps.get(kind, 0) for (kind, _), count in used.items())
            and not (layout.rests and is_redundant(known + _ties(layout, row)))
        ):
            rows.append(row)
            is_possible = is_loaded or not row[needs_load].any()
            weights.append(weight if is_possible else -math.inf)
    log_prior = np.array(weights)
    return np.stack(rows), log_prior - np.logaddexp.reduce(log_prior)


def check_size(layout: Layout, source: str = "") -> None:
    """Raise unless a block's structures are few enough.

    Args:
        layout: slots of the block.
        source: file of the scene, for messages.

    Raises:
        ValueError: as in `structures`.
    """
    sizes = [len(group) + 1 for group in _exchangeable(layout).values()]
    where = f"{source}: unknown" if source else "unknown"
    if math.prod(sizes) > _MAX_STRUCTURES:
        raise ValueError(
            f"{where}: {math.prod(sizes)} structures of a block of "
            f"{layout.num_bodies} bodies; expected at most {_MAX_STRUCTURES}; lower "
            "the caps in 'unknown'"
        )
    if len(layout.slots) > _MAX_SLOTS:
        raise ValueError(
            f"{where}: {len(layout.slots)} constraints of a block of "
            f"{layout.num_bodies} bodies; expected at most {_MAX_SLOTS}; lower the "
            "caps in 'unknown'"
        )


def _exchangeable(layout: Layout) -> dict[tuple, list[int]]:
    """Slots by kind and bodies: those of one entry could be exchanged."""
    groups: dict[tuple, list[int]] = {}
    for i, slot in enumerate(layout.slots):
        groups.setdefault((slot.kind, slot.body_a, slot.body_b), []).append(i)
    return groups


def _ties(layout: Layout, row: np.ndarray) -> list[Tie]:
    """Constraints of active slots."""
    active = (slot for slot, is_on in zip(layout.slots, row, strict=True) if is_on)
    return [Tie(slot.kind, slot.body_a, slot.body_b, True) for slot in active]


def _log_power(p: float, count: int) -> float:
    if count == 0:
        return 0.0
    return count * math.log(p) if p > 0 else -math.inf
