"""One block of bodies as a sampling problem: scene, history and prior made a target."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from boomdp_jax.core.arrays import on_device
from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.block_contact import block_contact
from boomdp_jax.inference.hypotheses.coordinates import Coordinates, surroundings
from boomdp_jax.inference.hypotheses.layout import Layout, block_layout, structures
from boomdp_jax.inference.hypotheses.prior import prior_scales, read_prior
from boomdp_jax.inference.likelihoods.filtered_likelihood import FilteredLikelihood
from boomdp_jax.inference.likelihoods.kalman import channel_scale
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.likelihoods.tracking import one_step_gains
from boomdp_jax.inference.readings.components import why_joined
from boomdp_jax.inference.readings.outliers import without_isolated
from boomdp_jax.inference.readings.touching import Touching
from boomdp_jax.inference.readings.track_data import track_data
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.turns import parts_for_turns

# A step of up to so many seconds is one part in likelihoods of several bodies, whose
# time is spent in steps: of two pairs that were pushed for a second the evidence was no
# better with two. Longer ones are cut as the engine cuts them: of a cart pushed for
# 0.4 s one part is a centimetre off, and exact readings of it then gave an axle 7 cm
# off and a mass 10 % off, for certain. Those of a lone body are always cut so. Where
# its motion turns round against dry friction one part of 0.02 s was 0.1 rad/s off,
# which passed for noise of the motion: with two parts the evidence of six doors that
# MuJoCo moved rose by 0 to 45 nats, that of eight tables on a floor by -3 to 43.
_LONGEST_WHOLE_STEP = 0.05


class Block(NamedTuple):
    """Bodies that may interact, and their target."""

    bodies: tuple[int, ...]
    """Indices in the scene, ascending."""
    layout: Layout
    target: StructureTarget


def make_block(
    spec: SceneSpec,
    bodies: tuple[int, ...],
    history: History,
    *,
    is_uniform: bool | None = None,
    weight: np.ndarray | None = None,
    touching: Touching | None = None,
    freedom: float | None = None,
    is_told: bool = True,
    cuts_turns: bool = False,
) -> Block:
    """Set up the posterior of a block.

    Its likelihood starts out as the one-step likelihood; a fit then gives it the gains
    of a filter.

    Args:
        spec: the scene.
        bodies: which of its bodies.
        history: of the whole scene.
        is_uniform: whether all steps are equally long; default: as the history has it.
        weight: as how many times its likelihood each row counts, `[time]`; default: as
            one.
        touching: what may have touched; None: nothing collides.
        freedom: degrees of freedom of the readings' Student-t noise; None: normal.
        is_told: whether readings tell what the bodies are, or only where.
        cuts_turns: whether steps are cut by how far bodies are read to turn, where the
            scene does not say in how many parts they are made. Not where shapes must
            not depend on readings.

    Returns:
        The block.

    Raises:
        ValueError: as `block_layout` and `structures` have it; it says why the bodies
            are one block.
    """
    # An empty table needs room for one row, from which shapes can be told.
    history = history.padded(max(history.capacity, 1))
    options = read_prior(spec.prior, spec.source)
    touches = touching is not None and touching.pairs[list(bodies)].any()
    inferred = touching.inferred_in(spec, bodies) if touches else ()
    may_tie = options.probability["tie"] > 0
    layout = block_layout(spec, bodies, inferred, may_tie=may_tie)
    trusted = history if freedom is None else without_isolated(history)
    try:
        rows, log_prior = structures(
            layout,
            spec.unknown,
            options,
            is_loaded=spec.normal_gravity > 0,
            source=spec.source,
        )
    except ValueError as error:
        if len(bodies) == 1:
            raise
        why = why_joined(spec, bodies, trusted, touching)
        raise ValueError(f"{error}; {why}") from None
    poses = _poses(trusted, bodies)
    num_parts = 1
    if cuts_turns and spec.substeps is None:
        num_parts = _parts_of_turns(history, bodies)
    scene = _block_scene(spec, bodies, np.asarray(history.dt), num_parts)
    contact = block_contact(spec, bodies, touching, scene) if touches else None
    coordinates = Coordinates(
        layout=layout,
        scales=prior_scales(options),
        surroundings=surroundings(
            spec, bodies, layout, poses, _forces(history, bodies)
        ),
        scene=scene,
        contact=contact,
    )
    if is_uniform is None:
        dt = np.asarray(history.dt)[np.asarray(history.mask)]
        is_uniform = bool(dt.size == 0 or np.all(dt == dt[0]))
    if not is_told:
        history = _unread(history)
    data = track_data(
        history, bodies, is_uniform, has_delay=layout.has_delay, freedom=freedom
    )
    if weight is not None:
        data = dataclasses.replace(data, weight=on_device(weight))
    if touches:
        near = touching.near_rows(bodies, history.capacity)
        data = dataclasses.replace(data, may_touch=on_device(near, bool))
    scale = np.asarray(coordinates.scales.noise)
    reference = np.tile(scale[None], (len(bodies), 1))
    gains = one_step_gains(data, channel_scale(reference))
    target = StructureTarget(
        log_likelihood=FilteredLikelihood(
            coordinates=coordinates,
            data=data,
            structures=on_device(rows, bool),
            gains=jax.tree.map(
                lambda leaf: on_device(
                    np.broadcast_to(np.asarray(leaf), (len(rows), *leaf.shape))
                ),
                gains,
            ),
            reference=on_device(np.tile(reference[None], (len(rows), 1, 1))),
        ),
        structures=on_device(rows, bool),
        log_prior=on_device(log_prior),
        slot=on_device(layout.slot_of_coordinate(), np.dtype(np.int32)),
        period=on_device(layout.period()),
    )
    return Block(bodies, layout, target)


def _poses(history: History, bodies: tuple[int, ...]) -> np.ndarray:
    """All poses that were read, NaN where missing, `[reading, body, 3]`."""
    out = []
    for values, seen in (
        (history.state, history.state_mask),
        (history.next_state, history.next_state_mask),
    ):
        values, seen = (
            np.asarray(values)[:, bodies, :3],
            np.asarray(seen)[:, bodies, :3],
        )
        out.append(
            np.where(seen & np.asarray(history.mask)[:, None, None], values, np.nan)
        )
    return np.concatenate(out)


def _unread(history: History) -> History:
    """The same table without rows in use."""
    is_none = {
        name: on_device(np.zeros_like(getattr(history, name)), bool)
        for name in ("mask", "state_mask", "next_state_mask", "is_chained")
    }
    return dataclasses.replace(history, **is_none)


def _forces(history: History, bodies: tuple[int, ...]) -> np.ndarray:
    """Commanded forces of the rows in use, `[row, body, 2]`."""
    rows = np.asarray(history.mask)
    return np.asarray(history.action, float)[rows][:, list(bodies), :2]


def _parts_of_turns(history: History, bodies: tuple[int, ...]) -> int:
    """In how many parts steps have to be cut for how far bodies turn in them."""
    first, last = (
        np.where(mask, np.asarray(values, float), np.nan)[:, list(bodies)]
        for values, mask in (
            (history.state, np.asarray(history.state_mask)),
            (history.next_state, np.asarray(history.next_state_mask)),
        )
    )
    turned = np.abs(np.angle(np.exp(1j * (last[..., 2] - first[..., 2]))))
    by_spin = np.abs(last[..., 5]) * np.asarray(history.dt, float)[:, None]
    turned = np.where(np.isfinite(turned), turned, by_spin)
    return parts_for_turns(turned[np.asarray(history.mask)])


def _block_scene(
    spec: SceneSpec, bodies: tuple[int, ...], dt: np.ndarray, num_parts: int
) -> Scene:
    """The scene of a block's bodies; outlines shrink to a point: see `contact`.

    Args:
        spec: of all bodies.
        bodies: of the block.
        dt: lengths of steps [s].
        num_parts: in which steps are to be cut at least.
    """
    scene, index = spec.scene, np.asarray(bodies)
    # Of all rows, unused ones too: an online table holds its length from the start.
    longest = float(np.max(dt)) if dt.size else float(scene.dt)
    is_whole = len(bodies) > 1 and longest <= _LONGEST_WHOLE_STEP
    is_whole = is_whole and spec.substeps is None

    def pick(array):
        picked = np.asarray(array)[index]
        return on_device(picked, picked.dtype)

    return Scene(
        vertices=on_device(np.zeros((len(bodies), 1, 2))),
        vertex_mask=on_device(np.zeros((len(bodies), 1)), bool),
        radius=on_device(np.zeros(len(bodies))),
        area=pick(scene.area),
        gyration=pick(scene.gyration),
        feet=pick(scene.feet),
        foot_load=pick(scene.foot_load),
        foot_size=None if scene.foot_size is None else pick(scene.foot_size),
        corner_load=None if scene.corner_load is None else pick(scene.corner_load),
        diagonal=None if scene.diagonal is None else pick(scene.diagonal),
        stance_axis=None if scene.stance_axis is None else pick(scene.stance_axis),
        is_static=pick(scene.is_static),
        gravity=scene.gravity,
        normal_gravity=scene.normal_gravity,
        dt=scene.dt,
        num_substeps=max(1 if is_whole else scene.num_substeps, num_parts),
    )


def stack_blocks(blocks: list[Block]) -> StructureTarget:
    """Targets of equal layout with a leading axis, for one compiled call."""
    return jax.tree.map(
        lambda *leaves: jax.device_put(np.stack([np.asarray(x) for x in leaves])),
        *(b.target for b in blocks),
    )
