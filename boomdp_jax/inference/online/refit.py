"""The slow part of an online belief: fit anew, and ask whether the world has changed.

A refit finds the modes of every structure on the rows in the table, chooses levels of
noise, builds a mixture and draws fresh particles (`online.renew`). Mostly it goes on
from the modes that were best (`warm_modes`); where little was known before, or that may
be wrong, it looks everywhere (`find_modes`), and does not depend on how wrong particles
were. Where readings have ceased to look as expected
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

from boomdp_jax.core.arrays import Key, on_device, row_of
from boomdp_jax.core.history import History
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.blocks.block import Block, stack_blocks
from boomdp_jax.inference.fits.fit import Modes
from boomdp_jax.inference.hypotheses.noise_level import NoiseFit
from boomdp_jax.inference.likelihoods.filter_points import filter_points
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.noise.levels import evenly_levelled
from boomdp_jax.inference.online.fit import (
    Fitter,
    RefitSettings,
    assemble_belief,
    num_levels_for,
)
from boomdp_jax.inference.online.state import BlockBelief, FitRecord, Suspicion
from boomdp_jax.inference.online.step import ALARM, FIRST_TEST
from boomdp_jax.inference.samplers.structure_draws import start_mixtures

# A change is looked for again after twice as many rows as before, and no more after
# this number.
_LAST_TEST = 64
# Log-odds beyond which a question is settled.
_SETTLED = 5.0
# Impulses to begin with, in units of the prior scale of velocity readings.
_FIRST_IMPULSE = 0.1
# Modes are looked for everywhere after so many refits that went on from known ones.
_MOST_WARM = 8
# With fewer particles in effect a belief is no place to start from, and with a smaller
# share of those weighed its refit has failed.
_FEWEST, _POOR = 8.0, 0.02


class BlockRefit(NamedTuple):
    """What a refit found out about one block of bodies."""

    log_evidence: float
    """Of the account that was taken; NaN where it went on from particles that were near
    already, which tell nothing of it."""
    log_odds_of_change: float | None
    """Two worlds against one, prior odds included; None where nobody asked."""
    changed_at: int | None
    """Row of the table, before the refit, since which there is another world."""
    effective_sample_size: float
    """Of the particles drawn, before they were resampled and moved."""
    is_warm: bool
    """Whether the fit began at modes known before, instead of looking everywhere."""


class RefitInfo(NamedTuple):
    """What a refit found, on the host."""

    blocks: tuple[BlockRefit, ...]
    seconds: float

    @property
    def has_changed(self) -> bool:
        """Whether some block's world was found to have changed."""
        return any(block.changed_at is not None for block in self.blocks)


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
    each, champion = np.arange(num_structures), np.zeros((num_structures, dim))
    filtered = filter_points(targets, 0 * each, each, champion, noise)
    levelled = evenly_levelled(
        targets, champion, noise, filtered, num_levels_for(settings, bodies)
    )
    mixtures = start_mixtures(targets, modes)
    target = row_of(levelled.targets, 0)
    structure, z = _prior_draws(rng, target, settings.num_particles)
    capacity = likelihood.data.start.shape[1]
    belief = assemble_belief(levelled, mixtures, settings.num_particles, 0, 0, capacity)
    dtype = belief.particles.z.dtype
    return eqx.tree_at(
        lambda b: (b.particles.structure, b.particles.z),
        belief,
        (on_device(structure, np.dtype(np.int32)), on_device(z, dtype)),
    )


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
        settings.change_rate > 0.0
        and since - begin >= FIRST_TEST
        and num_after >= FIRST_TEST
        and (bool(suspicion.is_open) or float(suspicion.log_factor) > 0)
    )
    # What was believed is no place to start from: modes are looked for everywhere.
    is_wrong = float(suspicion.log_factor) > ALARM
    all_key, again_key, after_key, before_key = jax.random.split(key, 4)
    fit = Fitter(settings, bodies, history)
    is_warm = not is_asked and not is_wrong and _is_known(belief)
    account = None
    if is_warm:
        account = fit(all_key, begin, num_rows, known=belief)
        if account is not None:
            is_poor = account.effective_sample_size < _POOR * settings.num_particles
            account = None if is_poor else account
    if account is None:
        is_warm = False
        cut = since if is_asked else None
        account = fit(again_key, begin, num_rows, cut=cut)
        assert account is not None
    log_odds, is_changed, next_test = None, False, FIRST_TEST
    is_open = False
    if is_asked:
        after = fit(after_key, since, num_rows)
        before = fit(before_key, begin, since, age=num_after)
        assert after is not None
        assert before is not None
        log_odds = after.log_evidence + before.log_evidence - account.log_evidence
        log_odds += np.log(settings.change_rate)
        is_changed = log_odds > _SETTLED
        is_open = not is_changed and log_odds > -_SETTLED
        is_open = is_open and num_after < _LAST_TEST
        next_test = 2 * num_after if is_open else FIRST_TEST
        if is_changed:
            account, begin = after, since
    # What came before a change could be looked for still counts when it can be.
    is_early = not is_asked and 0 <= since and num_after < FIRST_TEST
    log_factor = suspicion.log_factor
    kept = Suspicion(
        log_factor=log_factor if is_early else jnp.zeros_like(log_factor),
        since=on_device(since if is_open or is_early else -1, suspicion.since.dtype),
        test_after=on_device(next_test, suspicion.test_after.dtype),
        is_open=on_device(is_open, bool),
    )
    old, integer = belief.fit, belief.begin.dtype
    num_fitted = int(old.num_rows) if is_warm else num_rows - begin
    num_since = int(old.num_since) + 1 if is_warm else 0
    record = FitRecord(on_device(num_fitted, integer), on_device(num_since, integer))
    fresh = eqx.tree_at(lambda b: (b.suspicion, b.fit), account.belief, (kept, record))
    return fresh, BlockRefit(
        log_evidence=account.log_evidence,
        log_odds_of_change=None if log_odds is None else float(log_odds),
        changed_at=since if is_changed else None,
        effective_sample_size=account.effective_sample_size,
        is_warm=is_warm,
    )


def _is_known(belief: BlockBelief) -> bool:
    """Whether a belief is one to go on from."""
    weight = np.exp(np.asarray(belief.particles.log_weight, float))
    size = weight.sum() ** 2 / np.sum(weight**2)
    num_rows, num_since = int(belief.fit.num_rows), int(belief.fit.num_since)
    return num_rows > 0 and num_since < _MOST_WARM and bool(size >= _FEWEST)


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
