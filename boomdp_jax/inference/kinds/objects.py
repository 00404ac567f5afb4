"""From scenes and histories to objects whose kinds can be asked for.

Every movable body is sampled by itself first, under the ordinary prior; what comes of
it is its likelihood as bumps, which propose, and the true likelihood of any list of
points, which decides (Lunn et al. (2013), Fully Bayesian hierarchical modelling in two
stages, with application to meta-analysis).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.compile_ahead import signature
from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.block import Block, make_block, stack_blocks
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.hypotheses.layout import Layout
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.hypotheses.prior import LOGARITHMIC
from boomdp_jax.inference.kinds.axes import (
    axis_turns,
    measure_from_bodies,
    turned_axes,
)
from boomdp_jax.inference.kinds.likelihood_bumps import Bumps
from boomdp_jax.inference.kinds.likelihood_fit import fit_bumps
from boomdp_jax.inference.likelihoods.evaluate import evaluate_points, log_prior_density
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.population import sample_population
from boomdp_jax.inference.samplers.structure_draws import (
    SampleSettings,
    chains_agree,
    start_mixtures,
)
from boomdp_jax.physics.scene_spec import SceneSpec

# Readings that differ from rest by more than so many of the prior's noise scales are
# motion.
_FAR = 8.0

SCALE_TOLERANCE = 1e-5
"""Relative difference of two scales that are the same: kinds that were learnt in single
precision serve in double."""


class BodyAlone(NamedTuple):
    """A movable body, and what it is known by without the others."""

    scene: int
    body: int
    """Index in its scene."""
    name: str
    block: Block
    """With the gains of filters, if any reading tells of it."""
    bumps: Bumps | None = None
    """Its likelihood; None: it never moved, or was not seen to."""
    batch: int = -1
    """Which stack of targets it is in; -1: none."""
    place: int = 0
    """Where in that stack."""


class ObjectsAlone(NamedTuple):
    """All movable bodies of some scenes."""

    bodies: tuple[BodyAlone, ...]
    targets: tuple[StructureTarget, ...]
    """Stacks of targets, on which likelihoods are evaluated."""
    noise: tuple[NoiseFit, ...]
    """Of every structure of every object of each stack, in order."""
    reach: float
    """How far anchors may lie beyond the outline, in radii: the same for all bodies, so
    that coordinates of one mean the same as those of another."""

    def log_likelihood(
        self, index: np.ndarray, structure: np.ndarray, z: np.ndarray
    ) -> np.ndarray:
        """Log-likelihoods of a list of points: objects, structures, coordinates."""
        out = np.zeros(len(index))
        batch = np.array([body.batch for body in self.bodies])[index]
        place = np.array([body.place for body in self.bodies])[index]
        for number, targets in enumerate(self.targets):
            mine = np.flatnonzero(batch == number)
            if len(mine) == 0:
                continue
            points = (place[mine], structure[mine], z[mine])
            found = evaluate_points(targets, *points)
            out[mine] = found.log_density - log_prior_density(targets, *points)
        return out


def sample_alone(
    key: Key,
    specs: Sequence[SceneSpec],
    histories: Sequence[History],
    settings: SampleSettings,
    *,
    reach: float | None = None,
    report: Callable[[str], None] = lambda stage: None,
) -> ObjectsAlone:
    """Sample every movable body by itself, under the ordinary prior.

    Args:
        key: random key.
        specs: the scenes.
        histories: one for each scene.
        settings: how much to draw of each body.
        reach: see `ObjectsAlone`; default: the median over bodies with readings.
        report: called with the name of each stage as it begins.

    Returns:
        The bodies, scene after scene.

    Raises:
        ValueError: a body is tied to another one, or differs from the others in what
            constraints it may have or in their prior; which one.
    """
    entries = []
    for scene, (spec, history) in enumerate(zip(specs, histories, strict=True)):
        _refuse_ties(spec)
        for body in np.flatnonzero(~spec.is_static):
            block = make_block(spec, (int(body),), history)
            likelihood: Any = block.target.log_likelihood
            noise = np.asarray(likelihood.coordinates.scales.noise, float)
            is_read = _moves(history, int(body), noise)
            entries.append((scene, int(body), block, is_read))
    if not entries:
        raise ValueError(f"{specs[0].source}: bodies: expected one that can move")
    _refuse_other_layouts(specs, entries)
    if reach is None:
        reach = _common_reach([block for *_, block, is_read in entries if is_read])
    _refuse_other_scales(specs, entries)
    blocks = [_with_reach(block, reach) for _, _, block, _ in entries]
    groups: dict[object, list[int]] = {}
    for number, (*_, is_read) in enumerate(entries):
        if is_read:
            groups.setdefault(signature(blocks[number].target), []).append(number)
    found: dict[int, BodyAlone] = {}
    stacks, noise = [], []
    for batch, members in enumerate(groups.values()):
        stacked = stack_blocks([blocks[number] for number in members])
        group_key = jax.random.fold_in(key, batch)
        layout = blocks[members[0]].layout
        sampled = _sample_group(group_key, stacked, layout, settings, report)
        targets, group_noise, several = sampled
        stacks.append(targets)
        noise.append(group_noise)
        for place, number in enumerate(members):
            scene, body, _, _ = entries[number]
            target = jax.tree.map(lambda leaf, at=place: leaf[at], targets)
            block = blocks[number]._replace(target=target)
            name = specs[scene].names[body]
            found[number] = BodyAlone(
                scene, body, name, block, several[place], batch, place
            )
    bodies = []
    for number, (scene, body, _, _) in enumerate(entries):
        block = blocks[number]
        target = measure_from_bodies(block.target, block.layout)
        block = block._replace(target=target)
        alone = BodyAlone(scene, body, specs[scene].names[body], block)
        bodies.append(found.get(number, alone))
    return ObjectsAlone(tuple(bodies), tuple(stacks), tuple(noise), reach)


def _sample_group(
    key: Key,
    targets: StructureTarget,
    layout: Layout,
    settings: SampleSettings,
    report: Callable[[str], None],
) -> tuple[StructureTarget, NoiseFit, list[Bumps]]:
    """Targets with the gains of filters, noise, and the bumps of each body."""
    fit_key, chain_key = jax.random.split(key)
    found = find_modes(fit_key, targets, settings.fit, report)
    targets = found.targets
    report("sampling each body by itself")
    mixtures = start_mixtures(targets, found.modes)
    population = sample_population(
        chain_key,
        targets,
        mixtures,
        settings.population,
        is_mixed=lambda draws: chains_agree(targets, draws),
    )
    draws, evidence = population.draws, population.evidence
    num_objects = targets.structures.shape[0]
    structure = np.asarray(draws.structure).reshape(num_objects, -1)
    slot, rows = np.asarray(targets.slot[0]), np.asarray(targets.structures[0])
    in_use = np.append(rows, np.ones((len(rows), 1), bool), axis=1)[:, slot]
    modes, turn = found.modes, axis_turns(targets, layout)[:, None]

    def turned(z):
        return turned_axes(np.asarray(z, float), turn, layout)

    z, _ = turned(np.reshape(draws.z, (*structure.shape, -1)))
    weighed, _ = turned(evidence.z)
    peak, sign = turned(modes.z)
    precision = np.asarray(modes.precision, float) * sign[..., None, :]
    precision = precision * sign[..., :, None]
    several = [
        fit_bumps(
            in_use,
            np.asarray(targets.period[i], float),
            np.asarray(targets.log_prior[i], float),
            np.asarray(evidence.log_evidence[i], float),
            (structure[i], z[i]),
            (
                np.asarray(evidence.structure[i]),
                weighed[i],
                np.exp(np.asarray(evidence.log_weight[i], float)),
            ),
            (
                np.asarray(modes.structure[i]),
                peak[i],
                precision[i],
                np.asarray(modes.log_density[i], float),
            ),
        )
        for i in range(num_objects)
    ]
    return measure_from_bodies(targets, layout), found.noise, several


def _moves(history: History, body: int, noise: np.ndarray) -> bool:
    """Whether a body was pushed, or seen in motion.

    One that rests and is not pushed tells nothing of itself. Its readings are left out:
    as the likelihood starts at the first one, they would charge a pin, and nothing
    else, for being where the body is.
    """
    rows = np.asarray(history.mask)
    if np.any(np.asarray(history.action)[rows, body] != 0):
        return True
    scale = _FAR * noise[[0, 0, 1, 2, 2, 3]]
    reading = np.asarray(history.next_state, float)[rows, body]
    seen = np.asarray(history.next_state_mask)[rows, body]
    for channel in range(6):
        values = reading[seen[:, channel], channel]
        if channel < 3 and len(values):
            values = values - values.mean()
        if np.any(np.abs(values) > scale[channel]):
            return True
    return False


def resting_pose(spec: SceneSpec, history: History, body: int) -> np.ndarray | None:
    """Where a body that does not move is [m, m, rad]; None: nobody knows."""
    rows = np.asarray(history.mask)
    reading = np.asarray(history.state, float)[rows, body, :3]
    seen = np.asarray(history.state_mask)[rows, body, :3].all(axis=1)
    if seen.any():
        return np.median(reading[seen], axis=0)
    return spec.bodies[body].pose


def _refuse_ties(spec: SceneSpec) -> None:
    for constraint in spec.constraints:
        a, b = constraint.body_a, constraint.body_b
        if a >= 0 and b >= 0 and not (spec.is_static[a] or spec.is_static[b]):
            raise ValueError(
                f"{spec.source}: body {spec.names[a]!r}: expected bodies that are not "
                f"tied to each other; got a {constraint.kind} to {spec.names[b]!r}"
            )
    for name in spec.unknown_numbers - {"center_of_mass"}:
        raise ValueError(
            f"{spec.source}: unknown: {name}: inferring it together with kinds is not "
            "supported yet"
        )
    for body, is_unknown in zip(spec.bodies, spec.is_center_unknown, strict=True):
        if is_unknown:
            raise ValueError(
                f"{spec.source}: body {body.name!r}: center_of_mass: expected a known "
                "one; inferring it is not supported yet"
            )


def _slot_kinds(layout: Layout) -> tuple:
    return tuple(slot.kind for slot in layout.slots + layout.known_slots)


def _refuse_other_layouts(specs: Sequence[SceneSpec], entries: list) -> None:
    """Coordinates must mean the same of all bodies."""
    first = entries[0][2]
    for scene, body, block, _ in entries:
        target = block.target
        if _slot_kinds(block.layout) != _slot_kinds(first.layout) or not np.allclose(
            target.log_prior, first.target.log_prior
        ):
            spec = specs[scene]
            raise ValueError(
                f"{spec.source}: body {spec.names[body]!r}: expected the constraints "
                f"that may exist, and their prior, to be those of the first body "
                f"({', '.join(_slot_kinds(first.layout)) or 'none'}); got "
                f"{', '.join(_slot_kinds(block.layout)) or 'none'}"
            )


def _refuse_other_scales(specs: Sequence[SceneSpec], entries: list) -> None:
    """A coordinate is a number in units of its prior."""
    first = prior_scales_of(entries[0][2])
    for scene, _, block, _ in entries:
        for name, scale in prior_scales_of(block).items():
            if not np.allclose(scale, first[name], rtol=SCALE_TOLERANCE):
                raise ValueError(
                    f"{specs[scene].source}: prior: {name}: expected the scale of all "
                    f"scenes, {first[name]}; got {scale}: objects of a kind share "
                    "numbers in units of their prior"
                )


def prior_scales_of(block: Block) -> dict[str, tuple[float, float]]:
    """Centre and spread of every number, as a scene's prior has them."""
    likelihood: Any = block.target.log_likelihood
    scales = likelihood.coordinates.scales
    found = {}
    for name, center in scales.center.items():
        middle = float(np.exp(center) if name in LOGARITHMIC else center)
        # Six digits: what single precision makes of a number is not to be read.
        spread = float(f"{scales.spread[name]:.6g}")
        found[name] = (float(f"{middle:.6g}"), spread)
    return found


def _around(block: Block) -> Any:
    likelihood: Any = block.target.log_likelihood
    return likelihood.coordinates.surroundings


def _common_reach(blocks: list[Block]) -> float:
    """Median over bodies of how far they moved, in radii."""
    if not blocks:
        return 0.0
    arounds = [_around(block) for block in blocks]
    return float(
        np.median([float(around.spread[0] / around.radius[0]) for around in arounds])
    )


def _with_reach(block: Block, reach: float) -> Block:
    """The same block with anchors that reach as far as everybody's."""
    radius = np.asarray(_around(block).radius)
    target = eqx.tree_at(
        lambda target: target.log_likelihood.coordinates.surroundings.spread,
        block.target,
        on_device(reach * radius, radius.dtype),
    )
    return block._replace(target=target)
