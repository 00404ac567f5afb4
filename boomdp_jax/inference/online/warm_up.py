"""An online belief's programs, tried on transitions that mean nothing."""

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Array

from boomdp_jax.core.arrays import on_device
from boomdp_jax.inference.online.window import table_sizes
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State

if TYPE_CHECKING:
    from boomdp_jax.inference.online.belief import OnlineBelief

_FEW, _STRIDE = 4, 0.01
# Programs that are compiled: of which belief, for tables of how many rows.
_done: set[tuple[object, int]] = set()


def walk(spec: SceneSpec) -> Iterator[tuple[State, Array, State]]:
    """Endless pushes and readings.

    Args:
        spec: the scene; bodies that do not move stay where they are.

    Yields:
        A reading, the wrench held after it `[body, 3]`, and the next reading.
    """
    rng = np.random.default_rng(0)
    moves = ~np.asarray(spec.scene.is_static)[:, None]
    row = np.zeros((spec.num_bodies, 6))
    before = State(on_device(row[:, :3]), on_device(row[:, 3:]))
    while True:
        row = row + _STRIDE * rng.normal(size=row.shape) * moves
        after = State(on_device(row[:, :3]), on_device(row[:, 3:]))
        yield before, on_device(rng.normal(size=(spec.num_bodies, 3)) * moves), after
        before = after


def try_out(
    belief_filter: "OnlineBelief", name: object, dt: float | None, most: int
) -> None:
    """Call everything once that compiles, unless it was done for the same programs.

    Args:
        belief_filter: whose programs.
        name: the same for those that share them.
        dt: length of every step, where it is to be told [s].
        most: rows of the largest table that fits are tried on.
    """
    small, large = table_sizes(belief_filter.capacity)
    stages = [(small, min(small, _FEW))]
    if most > small:
        stages.append((large, small + 1))
    if all((name, size) in _done for size, _ in stages):
        return
    belief, rows, count = (
        belief_filter.init(jax.random.key(0)),
        walk(belief_filter.spec),
        0,
    )
    for size, num in stages:
        for before, wrench, after in itertools.islice(rows, num - count):
            belief, _ = belief_filter.step(belief, before, wrench, after, dt)
        count = num
        if (name, size) in _done:
            continue
        for _ in range(2):  # The second goes on from the first.
            belief, _ = belief_filter.refit(belief)
        belief_filter.posterior(belief, check=False)
        belief_filter.sample_params(jax.random.key(1), belief, 1)
        _done.add((name, size))
