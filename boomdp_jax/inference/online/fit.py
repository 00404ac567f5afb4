"""A fit of some rows of an online belief's table: modes, noise, mixture, particles."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.arrays import Key, on_device, row_of
from boomdp_jax.core.checked_input import one_number, whole_number
from boomdp_jax.core.history import History
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.arguments import check_spec
from boomdp_jax.inference.blocks.block import Block, make_block, stack_blocks
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import FitSettings
from boomdp_jax.inference.fits.warm_modes import Known, warm_modes
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.levels import (
    Levelled,
    mixtures_over_levels,
    with_levels,
)
from boomdp_jax.inference.noise.typical_noise import typical_noise
from boomdp_jax.inference.online.renew import near_log_proposal, renew
from boomdp_jax.inference.online.state import (
    BlockBelief,
    Champions,
    FitRecord,
    ParticleSet,
    Suspicion,
    Tally,
)
from boomdp_jax.inference.online.step import FIRST_TEST
from boomdp_jax.inference.online.window import in_whole_table, windowed
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.resampling import systematic
from boomdp_jax.inference.samplers.structure_draws import start_mixtures
from boomdp_jax.physics.scene_spec import SceneSpec

# Rows are fitted from what is known where they are at most so many times those fitted
# before, and where no body went that much farther, in terms of what anchors of pins are
# scaled by.
_GROWN, _FARTHER = 2.0, 1.0
_MULTIPLE = 16
# Particles that a fit may start from.
_NUM_KNOWN = 128


class Account(NamedTuple):
    """A fit of some of the rows, in the whole table."""

    belief: BlockBelief
    log_evidence: float
    effective_sample_size: float


class RefitSettings(NamedTuple):
    """What stays the same from refit to refit."""

    spec: SceneSpec
    num_particles: int
    is_uniform: bool
    forgetting: float
    change_rate: float
    """Prior probability that the world changes, per transition; zero: it never does."""
    num_levels: int = 1
    """Of the noise of each structure of a lone body (`noise.levels`)."""
    fit: FitSettings = FitSettings()


def refit_settings(
    spec: SceneSpec,
    *,
    num_particles: int,
    is_uniform: bool,
    forgetting: float,
    change_rate: float,
    num_levels: int,
) -> RefitSettings:
    """Settings, checked; arguments as of `OnlineBelief`.

    Raises:
        TypeError: a scene that is none.
        ValueError: a number out of range, or a scene of which nothing can be learnt
            step by step.
    """
    check_spec(spec)
    num_particles = whole_number("num_particles", num_particles, 1)
    forgetting = one_number("forgetting", forgetting)
    change_rate = one_number("change_rate", change_rate)
    if num_particles % _MULTIPLE:
        raise ValueError(
            f"num_particles: expected a multiple of {_MULTIPLE}, got {num_particles}"
        )
    if not 0.0 < forgetting <= 1.0:
        raise ValueError(f"forgetting: expected in (0, 1], got {forgetting}")
    if not 0.0 <= change_rate < 1.0:
        raise ValueError(f"change_rate: expected in [0, 1), got {change_rate}")
    num_levels = whole_number("num_noise_levels", num_levels, 1)
    if "actuator.delay" in spec.unknown_numbers:
        raise ValueError(
            f"{spec.source}: unknown.actuator: expected no delay in an online belief, "
            "which keeps no commands from before a step; got one"
        )
    return RefitSettings(
        spec=spec,
        num_particles=num_particles,
        is_uniform=is_uniform,
        forgetting=forgetting,
        change_rate=change_rate,
        num_levels=num_levels,
    )


def make_online_block(
    settings: RefitSettings,
    bodies: tuple[int, ...],
    history: History,
    *,
    age: int = 0,
) -> Block:
    """A block whose rows count as forgetting has it.

    Args:
        settings: what stays the same.
        bodies: indices of the block's bodies in the scene.
        history: readings of the whole scene.
        age: transitions since its last row.
    """
    weight = None
    if settings.forgetting < 1.0:
        num_rows = int(np.asarray(history.mask).nonzero()[0].max(initial=-1)) + 1
        behind = np.maximum(num_rows - 1 - np.arange(history.capacity), 0)
        weight = settings.forgetting ** (age + behind)
    return make_block(
        settings.spec, bodies, history, is_uniform=settings.is_uniform, weight=weight
    )


class Fitter:
    """Fits some of the rows of a table."""

    def __init__(
        self, settings: RefitSettings, bodies: tuple[int, ...], history: History
    ):
        self._settings, self._bodies, self._history = settings, bodies, history

    def __call__(
        self,
        key: Key,
        begin: int,
        end: int,
        *,
        cut: int | None = None,
        age: int = 0,
        known: BlockBelief | None = None,
    ) -> Account | None:
        """Modes, levels of noise, mixture, particles and evidence.

        Args:
            key: random key.
            begin: first row.
            end: row after the last one.
            cut: row at which a track starts anew; None: as they do.
            age: transitions since the last row.
            known: belief to go on from; None: modes are looked for everywhere.

        Returns:
            None where what is known does not serve for these rows.
        """
        settings = self._settings
        fit_key, draw_key, renew_key = jax.random.split(key, 3)
        rng = host_generator(draw_key)
        window = windowed(self._history, begin, end, cut)
        block = make_online_block(settings, self._bodies, window, age=age)
        if known is None:
            targets = stack_blocks([block])
            found = find_modes(fit_key, targets, settings.fit)
        else:
            if not _is_alike(known, block, end - begin):
                return None
            block = block._replace(target=in_coordinates_of(known, block.target))
            targets = stack_blocks([block])
            found = warm_modes(rng, targets, _known_of(rng, known), settings.fit)
        is_near = known is not None
        typical = typical_noise(rng, found, settings.fit, is_near=is_near)
        found = typical.found
        levelled = with_levels(rng, typical, num_levels_for(settings, self._bodies))
        mixtures = start_mixtures(found.targets, found.modes)
        num, capacity = settings.num_particles, self._history.capacity
        belief = assemble_belief(levelled, mixtures, num, begin, end, capacity)
        log_proposal = belief.particles.log_weight
        if known is not None:
            z = np.array(known.particles.z)
            if num_levels_for(settings, self._bodies) > 1:
                # Levels are others now; one that was narrow may have become wide.
                z[:, -1] = rng.random(len(z)) - 0.5
            particles = eqx.tree_at(
                lambda p: p.z, known.particles, on_device(z, z.dtype)
            )
            belief = eqx.tree_at(lambda b: b.particles, belief, particles)
            log_proposal = near_log_proposal(known)
        renewed = renew(
            renew_key,
            belief,
            on_device(end, belief.begin.dtype),
            on_device(is_near, bool),
            log_proposal,
        )
        return Account(
            renewed.block,
            float(renewed.log_evidence),
            float(renewed.effective_sample_size),
        )


def num_levels_for(settings: RefitSettings, bodies: tuple[int, ...]) -> int:
    """Levels of noise of each structure of a block.

    Of more bodies at once one level: gains grow with the square of their number, and
    filters with its cube.
    """
    return settings.num_levels if len(bodies) == 1 else 1


def _is_alike(belief: BlockBelief, block: Block, num_rows: int) -> bool:
    """Whether rows to fit are not many more, nor go much farther, than those before."""
    old: Any = belief.target.log_likelihood
    new: Any = block.target.log_likelihood
    before, after = old.coordinates.surroundings, new.coordinates.surroundings
    reach = np.asarray(before.radius) + np.asarray(before.spread)
    moved = np.asarray(after.center) - np.asarray(before.center)
    change = np.abs(np.asarray(after.spread) - np.asarray(before.spread))
    farther = np.maximum(np.hypot(*moved.T), change) / reach
    is_near = bool(np.all(farther < _FARTHER))
    return is_near and num_rows <= _GROWN * int(belief.fit.num_rows)


def in_coordinates_of(belief: BlockBelief, target: StructureTarget) -> StructureTarget:
    """A target whose coordinates mean what they meant to a belief."""
    likelihood: Any = belief.target.log_likelihood
    return eqx.tree_at(
        lambda t: t.log_likelihood.coordinates, target, likelihood.coordinates
    )


def _known_of(rng: np.random.Generator, belief: BlockBelief) -> Known:
    """What a fit can start from."""
    champions, particles = belief.champions, belief.particles
    num_structures = belief.target.num_structures
    num_levels = len(champions.z) // num_structures
    dim = belief.target.dim - (num_levels > 1)
    noise = NoiseFit(
        np.asarray(champions.noise.reading, float),
        np.asarray(champions.noise.impulse, float),
    )
    vector = noise.vector.reshape(num_structures, num_levels, -1).mean(axis=1)
    weight = np.exp(np.asarray(particles.log_weight, float))
    rows = systematic(rng, weight, _NUM_KNOWN)
    return Known(
        champion=np.asarray(champions.z, float)[::num_levels, :dim],
        noise=NoiseFit.of_vector(vector),
        structure=np.asarray(particles.structure)[rows],
        z=np.asarray(particles.z, float)[rows, :dim],
    )


def assemble_belief(
    levelled: Levelled,
    mixtures: LaplaceMixture,
    num_particles: int,
    begin: int,
    end: int,
    capacity: int,
) -> BlockBelief:
    """A belief in the whole table, whose particles are yet to be drawn.

    Args:
        levelled: fit of the rows.
        mixtures: made for the fit before there were levels.
        num_particles: how many there will be.
        begin: where the first row of the fit is.
        end: row after the last one.
        capacity: of the whole table.
    """
    targets, filtered = levelled.targets, levelled.filtered
    mixture = mixtures_over_levels(targets, mixtures)
    mixture = row_of(mixture, 0)
    dtype = targets.log_prior.dtype
    integer = jnp.zeros((), int).dtype
    # Rows beyond the last one are padding.
    last = max(end - begin, 1) - 1
    estimate = jax.tree.map(lambda leaf: leaf[:, last], filtered.after)
    best = int(np.argmax(np.asarray(mixture.log_weight)))
    num_levels = len(levelled.champion) // targets.structures.shape[1]
    starts = np.asarray(filtered.starts)[num_levels * int(mixture.structure[best])]
    targets, starts = in_whole_table(targets, starts, begin, capacity)
    target = row_of(targets, 0)
    num_bodies = starts.shape[1]
    num_all = len(levelled.champion)
    shape = (num_particles, num_bodies)
    return BlockBelief(
        target=target,
        champions=Champions(
            z=on_device(levelled.champion, dtype),
            estimate=jax.tree.map(lambda x: on_device(x, dtype), estimate),
            noise=NoiseLevel(
                on_device(levelled.noise.reading, dtype),
                on_device(levelled.noise.impulse, dtype),
            ),
        ),
        tally=Tally(
            on_device(np.zeros((num_all, num_bodies, 4)), dtype),
            on_device(np.zeros(num_all), dtype),
        ),
        particles=ParticleSet(
            structure=on_device(np.zeros(num_particles), np.dtype(np.int32)),
            z=on_device(np.zeros((num_particles, target.dim)), dtype),
            log_weight=on_device(np.full(num_particles, -np.log(num_particles)), dtype),
            mean=on_device(np.zeros((*shape, 6)), dtype),
            square=on_device(np.zeros((*shape, 4)), dtype),
        ),
        mixture=mixture,
        base_log_weight=mixture.log_weight,
        starts=on_device(starts, dtype),
        begin=on_device(begin, integer),
        step_size=on_device(0.5, dtype),
        num_moves=on_device(0, integer),
        suspicion=Suspicion(
            log_factor=on_device(0.0, dtype),
            since=on_device(-1, integer),
            test_after=on_device(FIRST_TEST, integer),
            is_open=on_device(False, bool),
        ),
        fit=FitRecord(on_device(0, integer), on_device(0, integer)),
    )
