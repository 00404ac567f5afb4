"""The slow part of an online belief: fit anew, and ask whether the world has changed.

A refit finds the modes of every structure on the rows in the table, builds a mixture on
them, and tempers fresh particles from it to the posterior, so that it does not matter
how wrong the particles before were. Where readings have ceased to look as expected
since some row, it weighs two accounts by their evidence: one world all along (perhaps
another one than was believed), or two, of which the rows since then tell of the second
alone (Barry and Hartigan 1993, A Bayesian analysis for change point problems). Both
start the state anew at that row, so that they explain the same readings.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.history import History
from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.inference.adapt_mixture import adapt_mixtures
from boomdp_jax.inference.block import Block, make_block, stack_blocks
from boomdp_jax.inference.filter_points import filter_points
from boomdp_jax.inference.find_modes import Found, find_modes
from boomdp_jax.inference.fit import FitSettings, Modes
from boomdp_jax.inference.kalman import NoiseLevel
from boomdp_jax.inference.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.noise import host_generator
from boomdp_jax.inference.noise_level import NoiseFit
from boomdp_jax.inference.online_likelihood import tally_of, track_points
from boomdp_jax.inference.online_state import (
    BlockBelief,
    Champions,
    ParticleSet,
    Suspicion,
)
from boomdp_jax.inference.online_window import in_whole_table, windowed
from boomdp_jax.inference.structure_draws import start_mixtures
from boomdp_jax.inference.target import StructureTarget
from boomdp_jax.inference.tempered_smc import temper
from boomdp_jax.inference.typical_noise import with_typical_gains
from boomdp_jax.inference.weighing import evaluate_each
from boomdp_jax.physics.scene_spec import SceneSpec

# Draws of each round that adapts the mixture, and rounds: tempering comes after.
_NUM_DRAWS, _NUM_ROUNDS = 1024, 2
# A change is looked for when so many rows have come since readings grew odd, again
# after twice as many, and no more after the last number.
FIRST_TEST, _LAST_TEST = 4, 64
# Log-odds beyond which a question is settled.
_SETTLED = 5.0
# Impulses to begin with, in units of the prior scale of velocity readings.
_FIRST_IMPULSE = 0.1


class BlockRefit(NamedTuple):
    """What a refit found out about one block of bodies."""

    log_evidence: float
    """Of the account that was taken."""
    log_odds_of_change: float | None
    """Two worlds against one, prior odds included; None where nobody asked."""
    changed_at: int | None
    """Row of the table, before the refit, since which there is another world."""
    power: float
    """Of the target that tempering reached; 1 unless it took too many steps."""


class RefitInfo(NamedTuple):
    """What a refit found, on the host."""

    blocks: tuple[BlockRefit, ...]
    seconds: float

    @property
    def has_changed(self) -> bool:
        """Whether some block's world was found to have changed."""
        return any(block.changed_at is not None for block in self.blocks)


class _Account(NamedTuple):
    """A fit of some of the rows."""

    block: Block
    found: Found
    mixtures: LaplaceMixture
    log_evidence: float


class RefitSettings(NamedTuple):
    """What stays the same from refit to refit."""

    spec: SceneSpec
    num_particles: int
    is_uniform: bool
    forgetting: float
    change_rate: float
    """Prior probability that the world changes, per transition."""
    fit: FitSettings = FitSettings()


def prior_belief(key: Key, settings: RefitSettings, block: Block) -> BlockBelief:
    """The belief before any row: particles of the prior.

    Args:
        key: random key.
        settings: what stays the same.
        block: of an empty history of the table's capacity.

    Returns:
        The belief about it.
    """
    bodies = block.bodies
    targets = stack_blocks([block])
    # No row has been filtered yet.
    likelihood: Any = targets.log_likelihood
    gains = jax.tree.map(lambda x: on_device(0 * np.asarray(x)), likelihood.gains)
    targets = eqx.tree_at(lambda t: t.log_likelihood.gains, targets, gains)
    rng = host_generator(key)
    structure, z = _prior_draws(rng, block.target, settings.num_particles)
    num_structures, dim = block.target.num_structures, block.target.dim
    scale = np.asarray(likelihood.coordinates.scales.noise, float)[0]
    reading = np.tile(scale, (len(bodies), 1))
    noise = NoiseFit(
        np.tile(reading, (num_structures, 1, 1)),
        np.tile(_FIRST_IMPULSE * reading[:, 2:], (num_structures, 1, 1)),
    )
    num_each = settings.fit.num_modes
    value = np.full((num_structures, num_each), -np.inf)
    value[:, 0] = _log_prior_at_zero(block.target)
    modes = Modes(
        structure=on_device(
            np.repeat(np.arange(num_structures), num_each)[None], np.dtype(np.int32)
        ),
        z=on_device(np.zeros((1, num_structures * num_each, dim))),
        precision=on_device(np.tile(np.eye(dim), (1, num_structures * num_each, 1, 1))),
        log_density=on_device(value.reshape(1, -1)),
    )
    mixtures = start_mixtures(targets, modes)
    capacity = likelihood.data.start.shape[1]
    return _assemble(targets, modes, noise, mixtures, structure, z, 0, 0, capacity)


def refit_block(
    key: Key,
    settings: RefitSettings,
    belief: BlockBelief,
    bodies: tuple[int, ...],
    history: History,
    num_rows: int,
) -> tuple[BlockBelief, BlockRefit]:
    """Fit a block anew.

    Args:
        key: random key.
        settings: what stays the same.
        belief: what was believed.
        bodies: the block's.
        history: the table.
        num_rows: rows in use.

    Returns:
        The new belief, and what was found.
    """
    begin, suspicion = int(belief.begin), belief.suspicion
    since = int(suspicion.since)
    num_after = num_rows - since
    is_asked = (
        since - begin >= FIRST_TEST
        and num_after >= FIRST_TEST
        and (bool(suspicion.is_open) or float(suspicion.log_factor) > 0)
    )
    all_key, after_key, before_key, temper_key = jax.random.split(key, 4)
    whole = windowed(history, begin, num_rows, since if is_asked else None)
    account = _fit(all_key, settings, bodies, whole)
    log_odds, is_changed, next_test = None, False, FIRST_TEST
    is_open = False
    if is_asked:
        after = _fit(
            after_key, settings, bodies, windowed(history, since, num_rows, None)
        )
        before = _fit(
            before_key,
            settings,
            bodies,
            windowed(history, begin, since, None),
            age=num_after,
        )
        log_odds = after.log_evidence + before.log_evidence - account.log_evidence
        log_odds += np.log(settings.change_rate)
        is_changed = log_odds > _SETTLED
        is_open = not is_changed and log_odds > -_SETTLED
        is_open = is_open and num_after < _LAST_TEST
        next_test = 2 * num_after if is_open else FIRST_TEST
        if is_changed:
            account, begin = after, since
    rng = host_generator(temper_key)
    targets = account.found.targets
    end = temper(rng, targets, account.mixtures, settings.num_particles, evaluate_each)
    points = end.particles.points
    order = rng.permutation(settings.num_particles)
    fresh = _assemble(
        targets,
        account.found.modes,
        account.found.noise,
        account.mixtures,
        np.asarray(points.structure)[0][order],
        np.asarray(points.z)[0][order],
        begin,
        num_rows,
        history.capacity,
    )
    kept = Suspicion(
        log_factor=jnp.zeros_like(suspicion.log_factor),
        since=on_device(since if is_open else -1, suspicion.since.dtype),
        test_after=on_device(next_test, suspicion.test_after.dtype),
        is_open=on_device(is_open, bool),
    )
    fresh = eqx.tree_at(lambda b: b.suspicion, fresh, kept)
    return fresh, BlockRefit(
        log_evidence=account.log_evidence,
        log_odds_of_change=None if log_odds is None else float(log_odds),
        changed_at=since if is_changed else None,
        power=float(end.power[0]),
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


def _fit(
    key: Key,
    settings: RefitSettings,
    bodies: tuple[int, ...],
    history: History,
    *,
    age: int = 0,
) -> _Account:
    """Modes, mixture and evidence on the rows of a history that ended some time ago."""
    fit_key, draw_key = jax.random.split(key)
    block = make_online_block(settings, bodies, history, age=age)
    rng = host_generator(draw_key)
    found = find_modes(fit_key, stack_blocks([block]), settings.fit)
    found = with_typical_gains(rng, found, settings.fit)
    mixtures, evidence = adapt_mixtures(
        rng,
        found.targets,
        start_mixtures(found.targets, found.modes),
        _NUM_DRAWS,
        evaluate_each,
        max_rounds=_NUM_ROUNDS,
    )
    each = np.asarray(evidence.log_evidence, float)[0]
    each = each + np.asarray(found.targets.log_prior, float)[0]
    return _Account(block, found, mixtures, float(np.logaddexp.reduce(each)))


def _assemble(
    targets: StructureTarget,
    modes: Modes,
    noise: NoiseFit,
    mixtures: LaplaceMixture,
    structure: np.ndarray,
    z: np.ndarray,
    begin: int,
    end: int,
    capacity: int,
) -> BlockBelief:
    """The belief of equally weighted particles, filtered up to the last row."""
    num_structures = targets.structures.shape[1]
    num_particles = len(structure)
    dtype = targets.log_prior.dtype
    integer = jnp.zeros((), int).dtype
    champion = np.asarray(modes.z, float)[0].reshape(num_structures, -1, z.shape[-1])
    champion = np.ascontiguousarray(champion[:, 0])
    each = np.zeros(num_structures, int)
    found = filter_points(targets, each, np.arange(num_structures), champion, noise)
    share = np.bincount(structure, minlength=num_structures)
    # Rows beyond the last one are padding.
    estimate = jax.tree.map(lambda leaf: leaf[:, max(end - begin, 1) - 1], found.after)
    starts = np.asarray(found.starts)[int(np.argmax(share))]
    targets, starts = in_whole_table(targets, starts, begin, capacity)
    target = jax.tree.map(lambda leaf: leaf[0], targets)
    places = on_device(structure, np.dtype(np.int32)), on_device(z, dtype)
    bounds = on_device(begin, integer), on_device(end, integer)
    tally, mean, square = _track(target, *places, *bounds)
    mixture = jax.tree.map(lambda leaf: leaf[0], mixtures)
    return BlockBelief(
        target=target,
        champions=Champions(
            z=on_device(champion, dtype),
            estimate=jax.tree.map(lambda x: on_device(x, dtype), estimate),
            noise=NoiseLevel(
                on_device(noise.reading, dtype), on_device(noise.impulse, dtype)
            ),
        ),
        tally=tally,
        particles=ParticleSet(
            structure=places[0],
            z=places[1],
            log_weight=on_device(np.full(num_particles, -np.log(num_particles)), dtype),
            mean=mean,
            square=square,
        ),
        mixture=mixture,
        base_log_weight=mixture.log_weight,
        starts=on_device(starts, dtype),
        begin=bounds[0],
        step_size=on_device(0.5, dtype),
        num_moves=on_device(0, integer),
        suspicion=Suspicion(
            log_factor=on_device(0.0, dtype),
            since=on_device(-1, integer),
            test_after=on_device(FIRST_TEST, integer),
            is_open=on_device(False, bool),
        ),
    )


@QuickCompile
def _track(target: StructureTarget, structure, z, begin, end):
    return tally_of(target), *track_points(target, structure, z, begin, end)


def _prior_draws(
    rng: np.random.Generator, target: StructureTarget, num: int
) -> tuple[np.ndarray, np.ndarray]:
    """Structures and coordinates of prior draws."""
    prior = np.exp(np.asarray(target.log_prior, float))
    structure = rng.choice(len(prior), size=num, p=prior / prior.sum())
    period = np.asarray(target.period, float)
    shape = (num, target.dim)
    turn = period * (rng.random(shape) - 0.5)
    z = np.where(period > 0, turn, rng.standard_normal(shape))
    slots, slot = np.asarray(target.structures), np.asarray(target.slot)
    active = np.concatenate([slots, np.ones((len(slots), 1), bool)], axis=1)
    return structure, np.where(active[:, slot][structure], z, 0.0)


def _log_prior_at_zero(target: StructureTarget) -> np.ndarray:
    """Log-prior density of every structure at its coordinates' middle."""
    zero = jnp.zeros(target.dim, target.log_prior.dtype)
    each = jax.vmap(lambda k: target.log_prior_density(k, zero))
    return np.asarray(each(jnp.arange(target.num_structures)), float)
