r"""Likelihood of noisy readings with latent states, noise scales integrated out.

The innovations of a filter with fixed gains (`tracking`) are whitened by the noise that
the gains were made for. Per body and channel group the true noise is that times an
unknown factor c, whose square has the inverse-gamma prior that the noise's own prior
implies, and is integrated out. Gains depend on the ratios of the noises only, which
this takes as known.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import FloatScalar, IntScalar
from boomdp_jax.inference.hypotheses.coordinates import Coordinates
from boomdp_jax.inference.likelihoods.one_step import NoiseStatistics, log_marginal
from boomdp_jax.inference.likelihoods.tracking import Gains, innovations
from boomdp_jax.inference.readings.track_data import TrackData

CHANNEL_GROUPS = ((0, 1), (2,), (3, 4), (5,))
"""Channels that share their noise: position, angle, velocity, spin."""


class Innovations(NamedTuple):
    """What a hypothesis leaves unexplained."""

    whitened: Float[Array, "time 2 body 6"]
    statistics: NoiseStatistics


class FilteredLikelihood(eqx.Module):
    """Log-likelihood of coordinates and active slots; what samplers call.

    What belongs to structures is absent where gains are handed on (`without_gains`).
    """

    coordinates: Coordinates
    data: TrackData
    structures: Bool[Array, "structure slot"] | None
    gains: Gains | None
    """With a leading structure axis; in an online belief with as many levels of noise
    for each structure, level by level (`noise.levels`)."""
    reference: Float[Array, "level body 4"] | None
    """Noise that the gains were made for."""
    offset: Float[Array, " level"] | None = None
    """What is added to the log-likelihood by these gains; None: nothing."""

    def __call__(
        self, z: Float[Array, " dim"], active: Bool[Array, " slot"]
    ) -> FloatScalar:
        """Log marginal likelihood, -1e30 where the prediction is not finite."""
        assert self.reference is not None
        structure = self.structure_index(active)
        gains = self.gains_of(structure)
        found = self.innovations(z, active, gains)
        return self.log_marginal(
            found.statistics, self.log_volume(gains), self.reference[structure]
        )

    def structure_index(self, active: Bool[Array, " slot"]) -> IntScalar:
        """Which structure has these slots active."""
        same = jnp.all(self.structures == active[None], axis=-1)
        return jnp.argmax(same).astype(jnp.int32)

    def gains_of(self, structure: Int[Array, "*batch"]) -> Gains:
        """Gains of a structure, or of several."""
        return jax.tree.map(lambda leaf: leaf[structure], self.gains)

    def innovations(
        self,
        z: Float[Array, " dim"],
        active: Bool[Array, " slot"],
        gains: Gains,
        is_used: Bool[Array, " time"] | None = None,
    ) -> Innovations:
        """Whitened innovations at a hypothesis, and their sums of squares."""
        whitened = self.whitened(z, active, gains, None, is_used)
        return Innovations(
            whitened,
            NoiseStatistics(self.num_counted(gains), group_sums(whitened**2)),
        )

    def whitened(
        self,
        z: Float[Array, " dim"],
        active: Bool[Array, " slot"],
        gains: Gains,
        place: IntScalar | None,
        is_used: Bool[Array, " time"] | None = None,
    ) -> Float[Array, "time 2 body 6"]:
        """Whitened innovations at a hypothesis, as often as rows count.

        Args:
            z: coordinates.
            active: slots.
            gains: of its structure; of many, after the axis of time, if it has a place.
            place: which of those it has.
            is_used: as `scan_used` has it.
        """
        params, data = self.coordinates(z, active), self.data
        world = self.coordinates.world
        found = innovations(world, params, data, gains, is_used, place)
        if data.weight is None:
            return found
        return found * jnp.sqrt(data.weight)[:, None, None, None]

    def num_counted(self, gains: Gains) -> Float[Array, "body 4"]:
        """How many innovations of each channel group count."""
        counts = gains.counts
        if self.data.weight is not None:
            counts = counts * self.data.weight[:, None, None]
        return group_sums(counts.reshape(len(counts), 2, -1, 6))

    def log_volume(self, gains: Gains) -> FloatScalar:
        """Log-determinant of all whitenings, each row's as often as it counts."""
        each = gains.log_volumes
        if self.data.weight is not None:
            each = each * self.data.weight
        return jnp.sum(each)

    def log_marginal(
        self,
        statistics: NoiseStatistics,
        log_volume: FloatScalar,
        reference: Float[Array, "body 4"],
    ) -> FloatScalar:
        """The same from statistics of innovations whitened for a noise."""
        relative_scale = self.coordinates.scales.noise[None] / reference
        each = jax.vmap(
            lambda num, square, scale: log_marginal(
                NoiseStatistics(num[None], square[None]), scale
            )
        )(statistics.num, statistics.square, relative_scale)
        value = jnp.sum(each) + log_volume
        return jnp.where(jnp.isfinite(value), value, -1e30)


def without_gains(likelihood: FilteredLikelihood) -> FilteredLikelihood:
    """What all structures share; calls of it need gains handed to them."""
    return eqx.tree_at(
        lambda x: (x.gains, x.structures, x.reference), likelihood, (None, None, None)
    )


def group_sums(values: Float[Array, "time 2 body 6"]) -> Float[Array, "body 4"]:
    """Sum over readings and over the channels of each group."""
    total = jnp.sum(values, axis=(0, 1))
    return jnp.stack(
        [sum(total[:, c] for c in group) for group in CHANNEL_GROUPS], axis=-1
    )
