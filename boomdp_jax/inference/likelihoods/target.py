"""A posterior over structures and numbers, stripped of physics: what samplers see."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import FloatScalar, IntScalar


class StructureTarget(eqx.Module):
    r"""An unnormalised density over a structure $k$ and coordinates $z$.

    $$\log p(k, z \mid h) = \log \pi_k + \sum_{d \in k} \log p(z_d) + \log L(k, z).$$

    Each coordinate belongs to a slot (or to none, then it is always in use). A slot's
    coordinates are in use where the structure has the slot active, and hold zero
    elsewhere. In use, a coordinate is a priori standard normal, or, if it has a period
    $P$, uniform over $[-P/2, P/2)$.
    """

    log_likelihood: Callable[[Float[Array, " dim"], Bool[Array, " slot"]], FloatScalar]
    """Of coordinates and active slots; ignores coordinates that are not in use."""
    structures: Bool[Array, "structure slot"]
    """Every structure that may exist; no two rows agree."""
    log_prior: Float[Array, " structure"]
    """Normalised log-probability of each structure."""
    slot: Int[Array, " dim"]
    """Slot of each coordinate; -1: always in use."""
    period: Float[Array, " dim"]
    """Period of a coordinate that is an angle, 0 for all others."""

    @property
    def num_structures(self) -> int:
        """How many structures there are."""
        return self.structures.shape[-2]

    @property
    def dim(self) -> int:
        """How many coordinates there are, in use or not."""
        return self.slot.shape[-1]

    def in_use(self, structure: IntScalar) -> Bool[Array, " dim"]:
        """Which coordinates a structure uses."""
        active = self.structures[structure]
        if active.shape[-1] == 0:
            return jnp.ones(self.dim, bool)
        return (self.slot < 0) | active[jnp.maximum(self.slot, 0)]

    def log_prior_density(
        self, structure: IntScalar, z: Float[Array, " dim"]
    ) -> FloatScalar:
        """Log-prior of a structure and its coordinates."""
        normal = -0.5 * z**2 - 0.5 * jnp.log(2.0 * jnp.pi)
        uniform = -jnp.log(jnp.where(self.period > 0, self.period, 1.0))
        each = jnp.where(self.period > 0, uniform, normal)
        return self.log_prior[structure] + jnp.sum(
            jnp.where(self.in_use(structure), each, 0.0)
        )

    def log_density(self, structure: IntScalar, z: Float[Array, " dim"]) -> FloatScalar:
        """Log-prior plus log-likelihood."""
        return self.log_prior_density(structure, z) + self.log_likelihood(
            z, self.structures[structure]
        )

    def wrap(self, z: Float[Array, " dim"]) -> Float[Array, " dim"]:
        """Bring angles into [-period/2, period/2)."""
        period = jnp.where(self.period > 0, self.period, 1.0)
        wrapped = z - period * jnp.floor(z / period + 0.5)
        return jnp.where(self.period > 0, wrapped, z)
