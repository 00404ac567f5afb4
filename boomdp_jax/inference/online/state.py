"""What an online belief carries from one transition to the next: arrays only."""

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import IntScalar, Key
from boomdp_jax.core.history import History
from boomdp_jax.inference.likelihoods.kalman import Estimate, NoiseLevel
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture


class ParticleSet(eqx.Module):
    """Weighted hypotheses, and what the filter of each has come to."""

    structure: Int[Array, "*member particle"]
    z: Float[Array, "*member particle dim"]
    log_weight: Float[Array, "*member particle"]
    """Normalised."""
    mean: Float[Array, "*member particle body 6"]
    """Best guess of the state after the last row, given the hypothesis."""
    square: Float[Array, "*member particle body 4"]
    """Sum of squared whitened innovations per channel group."""


class Tally(eqx.Module):
    """What all hypotheses of a structure and a level of noise share of statistics."""

    num: Float[Array, "*member level body 4"]
    """Innovations that count."""
    log_volume: Float[Array, "*member level"]
    """Log-determinant of all whitenings."""


class Champions(eqx.Module):
    """A hypothesis and noises of each structure, whose Kalman filters give the gains.

    Structure after structure, and for each one level of noise after the other.
    """

    z: Float[Array, "*member level dim"]
    estimate: Estimate
    """After the last row; leading axes `*member level`."""
    noise: NoiseLevel
    """Of readings and motion, leading axes `*member level`."""


class Suspicion(eqx.Module):
    """Whether readings have ceased to look like what the belief expects."""

    log_factor: Float[Array, "*member"]
    """Cumulative log Bayes factor of ill-fitting readings, zero where all is well."""
    since: Int[Array, "*member"]
    """Row since which it grows; -1: it does not."""
    test_after: Int[Array, "*member"]
    """Rows since then at which a refit should look for a change."""
    is_open: Bool[Array, "*member"]
    """Whether a refit has looked and could not tell."""


class FitRecord(eqx.Module):
    """How the modes that a belief rests on were found."""

    num_rows: Int[Array, "*member"]
    """Rows that were fitted when modes were last looked for everywhere; 0: never."""
    num_since: Int[Array, "*member"]
    """Refits since then, which began at modes known before."""


class BlockBelief(eqx.Module):
    """What is believed of bodies that may interact; made by `online.refit`."""

    target: StructureTarget
    """Posterior of the whole table, with gains of the rows so far."""
    champions: Champions
    tally: Tally
    particles: ParticleSet
    mixture: LaplaceMixture
    """What jumps are drawn from and walks are shaped by."""
    base_log_weight: Float[Array, "*member component"]
    """Of the mixture as last fitted."""
    starts: Float[Array, "*member time body 6"]
    """State before each row, as the filter of the most probable champion had it."""
    begin: Int[Array, "*member"]
    """First row that counts."""
    step_size: Float[Array, "*member"]
    """Of walks."""
    num_moves: Int[Array, "*member"]
    """Moves made so far, each of a part of the particles."""
    suspicion: Suspicion
    fit: FitRecord


class BeliefState(eqx.Module):
    """All that is believed of a scene. A pytree: it can be jitted over and scanned."""

    key: Key
    history: History
    """The last transitions, in order of time from row 0."""
    num_rows: IntScalar
    """Rows of the table that are in use."""
    num_seen: IntScalar
    """Transitions taken since the belief began."""
    refit_at: IntScalar
    """Number of transitions at which the mixture and the gains get stale."""
    refit_after: IntScalar
    """Number of transitions before which only a surprise calls for a refit."""
    blocks: tuple[BlockBelief, ...]
    """One entry for all blocks of equal shapes, with a leading axis `member`."""
