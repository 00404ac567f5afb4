"""One body's posterior as the papers put it: single steps, one sigma, no jumps.

Metres, radians and rates share one noise scale, as equation 1 of "What Does Physics
Bias" has it, and every constraint is there at all times: a switch value of each says
whether it acts, so that one is nulled by a value and not by a jump. The whole is one
vector in which everything is a priori standard normal, or uniform if it is an angle.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import FloatScalar, IntScalar, Key
from boomdp_jax.core.history import History
from boomdp_jax.inference.blocks.block import Block, make_block
from boomdp_jax.inference.hypotheses.coordinates import Coordinates
from boomdp_jax.inference.likelihoods.one_step import residuals
from boomdp_jax.inference.readings.single_steps import Readings, readings
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec

# Middle and spread of the prior of log-sigma; the papers do not give theirs.
_LOG_SIGMA, _SIGMA_SPREAD = float(np.log(1e-2)), 2.0


class PlainProblem(eqx.Module):
    """A density over vectors: coordinates, a switch for each slot, and log-sigma."""

    coordinates: Coordinates
    data: Readings
    structures: Bool[Array, "structure slot"]
    period: Float[Array, " dim"]
    level: Float[Array, " slot"]
    """A slot acts where its switch is below this."""
    groups: Float[Array, "group size"]
    """Which numbers are proposed together."""

    @property
    def dim(self) -> int:
        """Coordinates."""
        return self.period.shape[0]

    @property
    def size(self) -> int:
        """Numbers in all."""
        return self.groups.shape[1]

    @property
    def calls_each(self) -> int:
        """Simulator steps of one likelihood."""
        return self.data.mask.shape[0]

    def split(
        self, x: Float[Array, " size"]
    ) -> tuple[IntScalar, Float[Array, " dim"], FloatScalar]:
        """Structure (-1: one that may not exist), coordinates and sigma."""
        num_slots = self.level.shape[0]
        z, switch = x[: self.dim], x[self.dim : self.dim + num_slots]
        same = jnp.all(self.structures == (switch < self.level)[None], axis=1)
        structure = jnp.where(jnp.any(same), jnp.argmax(same), -1)
        return structure, z, jnp.exp(_LOG_SIGMA + _SIGMA_SPREAD * x[-1])

    def params(self, x: Float[Array, " size"]) -> Params:
        """The hypothesis."""
        structure, z, _ = self.split(x)
        return self.coordinates(z, self.structures[jnp.maximum(structure, 0)])

    def log_prior(self, x: Float[Array, " size"]) -> FloatScalar:
        """Up to a constant."""
        z, rest, period = x[: self.dim], x[self.dim :], self.period
        inside = jnp.all((period == 0) | (jnp.abs(z) <= 0.5 * period))
        value = jnp.sum(jnp.where(period > 0, 0.0, -0.5 * z**2))
        return jnp.where(inside, value - 0.5 * jnp.sum(rest**2), -jnp.inf)

    def log_likelihood(self, x: Float[Array, " size"]) -> FloatScalar:
        """Of single steps, up to a constant; -1e30 where nothing can be predicted."""
        structure, _, sigma = self.split(x)
        error = residuals(self.coordinates.scene, self.params(x), self.data)
        num = jnp.sum(self.data.mask)
        value = -0.5 * jnp.sum(error**2) / sigma**2 - num * jnp.log(sigma)
        return jnp.where((structure >= 0) & jnp.isfinite(value), value, -1e30)

    def log_density(self, x: Float[Array, " size"]) -> FloatScalar:
        """Prior times likelihood, up to a constant."""
        return self.log_prior(x) + self.log_likelihood(x)

    def draw(self, key: Key) -> Float[Array, " size"]:
        """From the prior."""
        normal_key, turn_key = jax.random.split(key)
        normal = jax.random.normal(normal_key, (self.size,), self.period.dtype)
        turn = jax.random.uniform(turn_key, (self.dim,), self.period.dtype) - 0.5
        z = jnp.where(self.period > 0, turn * self.period, normal[: self.dim])
        return normal.at[: self.dim].set(z)


def plain_problem(spec: SceneSpec, history: History) -> tuple[Block, PlainProblem]:
    """Put the first body's posterior so.

    Args:
        spec: the scene; prior scales and what may exist are read from it.
        history: what was seen; all of its steps are equally long.

    Returns:
        The block that other samplers would see, and the problem, whose arrays have the
        same shapes for histories of the same capacity.
    """
    block = make_block(spec, (0,), history)
    target = block.target
    structures = np.asarray(target.structures)
    prior = np.exp(np.asarray(target.log_prior, float))
    share = np.clip(prior @ structures, 1e-6, 1 - 1e-6)
    num_slots = structures.shape[1]
    slot = np.append(np.asarray(target.slot), [*range(num_slots), num_slots])
    groups = np.stack([slot == name for name in range(-1, num_slots + 1)])
    dtype = target.period.dtype
    likelihood: Any = target.log_likelihood
    return block, PlainProblem(
        coordinates=likelihood.coordinates,
        data=readings(history, (0,), True),
        structures=target.structures,
        period=target.period,
        level=jnp.asarray(norm.ppf(share), dtype),
        groups=jnp.asarray(groups[groups.any(axis=1)], dtype),
    )
