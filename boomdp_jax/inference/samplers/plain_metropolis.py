"""The papers' sampler: random-walk Metropolis from prior draws, many chains.

The papers give neither scales nor blocks. Here one constraint's numbers are proposed at
a time, and each chain's scale of every block is tuned while it burns in. Kept as the
control that this package's samplers are measured against: on a cart's first steps
few of its chains find the axle.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import Key
from boomdp_jax.inference.samplers.plain_problem import PlainProblem

_ACCEPTED, _GAIN, _FIRST_LOG_SCALE = 0.3, 0.05, -1.0


class PlainDraws(NamedTuple):
    """What the chains kept."""

    x: Float[Array, "chain draw size"]
    log_density: Float[Array, "chain draw"]

    @property
    def best(self) -> Float[Array, " size"]:
        """The draw of the highest density: the papers' estimate."""
        index = jnp.argmax(self.log_density)
        return self.x.reshape(-1, self.x.shape[-1])[index]


@eqx.filter_jit
def plain_metropolis(
    key: Key,
    problem: PlainProblem,
    *,
    num_chains: int = 30,
    num_iterations: int = 20_000,
    num_burn_in: int = 1_000,
    thin: int = 10,
) -> PlainDraws:
    """Run the chains, by default as long as the papers did for their cart.

    Args:
        key: random key.
        problem: what to sample.
        num_chains: from prior draws.
        num_iterations: of each.
        num_burn_in: iterations that are thrown away, in which scales are tuned.
        thin: one draw is kept of so many iterations.

    Returns:
        The draws.
    """
    groups = problem.groups

    def propose(carry: tuple, inputs: tuple) -> tuple[tuple, None]:
        x, value, log_scale = carry
        key, number = inputs
        noise_key, group_key, verdict_key = jax.random.split(key, 3)
        group = jax.random.randint(group_key, (), 0, len(groups))
        noise = jax.random.normal(noise_key, x.shape, x.dtype)
        trial = x + jnp.exp(log_scale[group]) * groups[group] * noise
        found = problem.log_density(trial)
        gain = jnp.where(jnp.isnan(found), -jnp.inf, found) - value
        accepts = jnp.log(jax.random.uniform(verdict_key, (), x.dtype)) < gain
        change = _GAIN * (accepts - _ACCEPTED) * (number < num_burn_in)
        log_scale = log_scale.at[group].add(change.astype(x.dtype))
        x, value = jnp.where(accepts, trial, x), jnp.where(accepts, found, value)
        return (x, value, log_scale), None

    def keep(carry: tuple, inputs: tuple) -> tuple[tuple, tuple[Array, Array]]:
        key, first = inputs
        numbers = first + jnp.arange(thin)
        keys = jax.random.split(key, thin)
        carry, _ = jax.lax.scan(propose, carry, (keys, numbers))
        return carry, carry[:2]

    def chain(key: Key) -> tuple[Array, Array]:
        start_key, run_key = jax.random.split(key)
        x = problem.draw(start_key)
        log_scale = jnp.full(len(groups), _FIRST_LOG_SCALE, x.dtype)
        num_kept = num_iterations // thin
        keys = jax.random.split(run_key, num_kept)
        firsts = thin * jnp.arange(num_kept)
        carry = x, problem.log_density(x), log_scale
        return jax.lax.scan(keep, carry, (keys, firsts))[1]

    x, value = jax.vmap(chain)(jax.random.split(key, num_chains))
    num_early = num_burn_in // thin
    return PlainDraws(x[:, num_early:], value[:, num_early:])
