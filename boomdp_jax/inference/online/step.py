r"""One transition into an online belief: every particle's filter takes one step.

The weight of a particle changes by $\log L_{t+1} - \log L_t$, both from its sums of
squares; where few particles are left in effect, they are resampled and the mixture is
fitted to them; a part of them moves at every transition. So a refresh costs about the
same whenever it comes.

Whether the readings still look like what the belief expects is watched by a cumulative
Bayes factor of "five times as far off as expected" against the belief's own prediction:
West and Harrison (1986), Monitoring and adaptation in Bayesian forecasting models.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key
from boomdp_jax.inference.likelihoods.kalman import RowFilter
from boomdp_jax.inference.online.likelihood import (
    levels_of,
    likelihood_of,
    log_likelihoods,
    num_levels_of,
    tally_of,
    tally_row,
    track_one_row,
    track_points,
)
from boomdp_jax.inference.online.moves import (
    distinct_sample_size,
    effective_sample_size,
    fit_mixture,
    move_particles,
    resample,
)
from boomdp_jax.inference.online.rows import (
    NewRow,
    append_track_row,
    drop_track_rows,
    shift_rows,
    track_row_of,
)
from boomdp_jax.inference.online.state import (
    BlockBelief,
    Suspicion,
    Tally,
)

# Rows gone through by the moves of one refresh, all particles together: where the table
# is short, there is time for more of them. A move's other work counts as some rows.
_MOVED_ROWS, _ROWS_OF_A_MOVE = 65536, 32
# Resampling comes where fewer particles than this share are left in effect.
_KEPT_SHARE = 0.5
# The alternative by which surprise is measured: readings so many times as far off. One
# row counts for no more nats than this, so that a single bad reading alarms nobody.
_MISFIT, _MOST_NATS = 5.0, 8.0
ALARM = 10.0
"""Cumulative log Bayes factor from which on readings count as odd."""
FIRST_TEST = 4
"""A change is looked for when so many rows have come since readings grew odd."""


class BlockInfo(NamedTuple):
    """What a transition did to the belief about one block of bodies."""

    effective_sample_size: Float[Array, "*block"]
    """Of the weights after the transition, before any resampling."""
    distinct_sample_size: Float[Array, "*block"]
    """The same where copies that resampling made before count as one particle."""
    is_resampled: Bool[Array, "*block"]
    acceptance: Float[Array, "*block"]
    """Share of this refresh's proposals that were accepted."""
    log_predictive: Float[Array, "*block"]
    """Log-density of the new readings given all before."""
    log_surprise: Float[Array, "*block"]
    """Cumulative log Bayes factor against the belief; zero where all is well."""
    surprised_since: Int[Array, "*block"]
    """Row since which the readings do not look as expected, -1: they do."""
    is_surprised: Bool[Array, "*block"]
    """Whether a refit should look for a change now."""


def drop_block_rows(block: BlockBelief, num: int) -> BlockBelief:
    """Take the oldest rows off a full table and weigh the particles anew."""
    likelihood, particles = likelihood_of(block.target), block.particles
    end = likelihood.data.start.shape[0] - num
    level = levels_of(block.target, particles.structure, particles.z)
    before = log_likelihoods(block.target, block.tally, level, particles.square)
    data = drop_track_rows(likelihood.data, block.starts, num)
    gains = jax.vmap(lambda leaf: shift_rows(leaf, num))(likelihood.gains)
    target = eqx.tree_at(
        lambda t: (t.log_likelihood.data, t.log_likelihood.gains),
        block.target,
        (data, gains),
    )
    begin = jnp.maximum(block.begin - num, 0)
    tally = tally_of(target)
    mean, square = track_points(
        target, particles.structure, particles.z, begin, jnp.asarray(end)
    )
    after = log_likelihoods(target, tally, level, square)
    log_weight = _normalised(particles.log_weight + after - before)
    particles = eqx.tree_at(
        lambda p: (p.log_weight, p.mean, p.square),
        particles,
        (log_weight, mean, square),
    )
    suspicion = block.suspicion
    since = jnp.where(suspicion.since < 0, -1, jnp.maximum(suspicion.since - num, 0))
    return eqx.tree_at(
        lambda b: (
            b.target,
            b.tally,
            b.particles,
            b.starts,
            b.begin,
            b.suspicion.since,
        ),
        block,
        (target, tally, particles, shift_rows(block.starts, num), begin, since),
    )


def refresh_block(
    key: Key,
    block: BlockBelief,
    new: NewRow,
    bodies: Int[Array, " body"],
    index: IntScalar,
    is_held: BoolScalar,
    forgetting: float,
) -> tuple[BlockBelief, BlockInfo]:
    """Take one transition into the belief about a block.

    Args:
        key: random key.
        block: the belief, with room for a row.
        new: the transition.
        bodies: indices of the block's bodies in the scene.
        index: where the row goes.
        is_held: whether to leave moves out, after other work.
        forgetting: factor on the weight of all rows before.

    Returns:
        The new belief, and what happened.
    """
    likelihood = likelihood_of(block.target)
    is_start = new.starts_episode | (index <= block.begin)
    row = track_row_of(likelihood.data, new, bodies, is_start)
    num_old = block.particles.log_weight.shape[0]
    block, weights = _filter_row(block, row, index, forgetting)
    size = effective_sample_size(weights.log_weight)
    distinct = distinct_sample_size(block.particles)
    is_resampled = size < _KEPT_SHARE * num_old
    resample_key, move_key = jax.random.split(key)
    block = jax.lax.cond(
        is_resampled, lambda b: _renew(resample_key, b), lambda b: b, block
    )
    part = num_old // 4
    rows = index + 1 - block.begin + _ROWS_OF_A_MOVE
    count = jnp.where(is_held, 0, jnp.maximum(_MOVED_ROWS // (part * rows), 1))
    moved = move_particles(move_key, block, index + 1, count)
    suspicion = _watch(block.suspicion, weights, index)
    num_after = index + 1 - suspicion.since
    is_alarmed = (suspicion.log_factor > ALARM) | suspicion.is_open
    is_surprised = (
        is_alarmed & (suspicion.since >= 0) & (num_after >= suspicion.test_after)
    )
    block = eqx.tree_at(lambda b: b.suspicion, moved.block, suspicion)
    return block, BlockInfo(
        effective_sample_size=size,
        distinct_sample_size=distinct,
        is_resampled=is_resampled,
        acceptance=moved.num_accepted / jnp.maximum(moved.num_proposed, 1.0),
        log_predictive=weights.log_predictive,
        log_surprise=suspicion.log_factor,
        surprised_since=suspicion.since,
        is_surprised=is_surprised,
    )


class _Weights(NamedTuple):
    """How well the particles foretold a row."""

    log_weight: Float[Array, " particle"]
    log_predictive: FloatScalar
    log_alternative: FloatScalar
    """The same had every reading been expected to be several times as far off."""


def _filter_row(
    block: BlockBelief, row, index: IntScalar, forgetting: float
) -> tuple[BlockBelief, _Weights]:
    """Every champion and every particle takes the row in."""
    target, particles = block.target, block.particles
    likelihood, champions = likelihood_of(target), block.champions
    coordinates, dt = likelihood.coordinates, likelihood.data.steps.dt

    def take(z, active, estimate, noise):
        params = coordinates(z, active)
        return RowFilter(coordinates.world, params, dt, noise)(estimate, row)

    active = jnp.repeat(target.structures, num_levels_of(target), axis=0)
    estimate, found = jax.vmap(take)(
        champions.z, active, champions.estimate, champions.noise
    )
    # A champion that has lost its way gives gains that count for nothing.
    gains = jax.tree.map(lambda leaf: jnp.nan_to_num(leaf), found.gains)
    mean, added = track_one_row(
        target, particles.structure, particles.z, particles.mean, row, gains
    )
    k = levels_of(target, particles.structure, particles.z)
    share = jax.ops.segment_sum(jnp.exp(particles.log_weight), k, champions.z.shape[0])
    start = found.start[jnp.argmax(share)]
    new_gains = jax.tree.map(
        lambda table, one: table.at[:, index].set(one), likelihood.gains, gains
    )
    data = append_track_row(likelihood.data, index, row, forgetting)
    target = eqx.tree_at(
        lambda t: (t.log_likelihood.data, t.log_likelihood.gains),
        target,
        (data, new_gains),
    )
    tally, square = block.tally, particles.square
    one = tally_row(gains)
    faded = Tally(forgetting * tally.num, forgetting * tally.log_volume)
    faded_square = forgetting * square
    whole = Tally(faded.num + one.num, faded.log_volume + one.log_volume)
    old = log_likelihoods(target, tally, k, square)
    past = log_likelihoods(target, faded, k, faded_square)
    new = log_likelihoods(target, whole, k, faded_square + added)
    missed = Tally(
        whole.num, whole.log_volume - jnp.log(_MISFIT) * jnp.sum(one.num, axis=(1, 2))
    )
    off = log_likelihoods(target, missed, k, faded_square + added / _MISFIT**2)
    before = _normalised(particles.log_weight + past - old)
    log_weight = _normalised(particles.log_weight + new - old)
    weights = _Weights(
        log_weight=log_weight,
        log_predictive=logsumexp(before + new - past),
        log_alternative=logsumexp(before + off - past),
    )
    particles = eqx.tree_at(
        lambda p: (p.log_weight, p.mean, p.square),
        particles,
        (log_weight, mean, faded_square + added),
    )
    block = eqx.tree_at(
        lambda b: (b.target, b.champions.estimate, b.tally, b.particles, b.starts),
        block,
        (target, estimate, whole, particles, block.starts.at[index].set(start)),
    )
    return block, weights


def _renew(key: Key, block: BlockBelief) -> BlockBelief:
    """Fit the mixture to the particles and resample them."""
    mixture = fit_mixture(block)
    particles = resample(key, block.particles)
    return eqx.tree_at(lambda b: (b.mixture, b.particles), block, (mixture, particles))


def _watch(suspicion: Suspicion, weights: _Weights, index: IntScalar) -> Suspicion:
    """Add a row to the cumulative Bayes factor."""
    added = weights.log_alternative - weights.log_predictive
    added = jnp.clip(jnp.nan_to_num(added), -_MOST_NATS, _MOST_NATS)
    total = jnp.maximum(suspicion.log_factor + added, 0.0)
    began = jnp.where(suspicion.log_factor > 0, suspicion.since, index)
    since = jnp.where(total > 0, began, -1)
    is_open = suspicion.is_open
    return Suspicion(
        log_factor=total,
        since=jnp.where(is_open, suspicion.since, since),
        test_after=suspicion.test_after,
        is_open=is_open,
    )


def _normalised(log_weight: Float[Array, " particle"]) -> Float[Array, " particle"]:
    """Weights that sum to one; all equal where none is left."""
    finite = jnp.nan_to_num(log_weight, nan=-1e30, posinf=-1e30, neginf=-1e30)
    return finite - logsumexp(finite)
