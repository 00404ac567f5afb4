"""Adapting a step size to a wanted acceptance probability, by dual averaging."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar

# Hoffman & Gelman (2014), The No-U-Turn Sampler, section 3.2: how many early updates
# are damped, how hard the step is pulled to its start, how fast averages forget.
_DAMPED_UPDATES = 10.0
_SHRINKAGE = 0.05
_FORGETTING = 0.75


class DualAveraging(eqx.Module):
    """A step size that is still being adapted, and its average."""

    log_start: FloatScalar
    log_step: FloatScalar
    log_average: FloatScalar
    error: FloatScalar
    """Running mean of wanted minus seen acceptance."""
    num_updates: IntScalar

    def step_size(self, is_adapting: BoolScalar | bool) -> Float[Array, "*chain"]:
        """The step to use: the latest while adapting, the average after that."""
        return jnp.exp(jnp.where(is_adapting, self.log_step, self.log_average))


def start_dual_averaging(step_size: float) -> DualAveraging:
    """Begin from a step size; it is used unchanged where nothing is ever updated."""
    log_step = jnp.log(jnp.asarray(step_size, float))
    return DualAveraging(
        log_start=log_step,
        log_step=log_step,
        log_average=log_step,
        error=jnp.zeros_like(log_step),
        num_updates=jnp.zeros((), jnp.int32),
    )


def update_dual_averaging(
    state: DualAveraging,
    accept_probability: FloatScalar,
    target_accept: float,
    max_step: float,
) -> DualAveraging:
    """Lengthen the step if proposals are accepted too often, else shorten it.

    Args:
        state: before the update.
        accept_probability: of the latest proposal.
        target_accept: what it should be on average.
        max_step: largest step allowed.
    """
    num = state.num_updates + 1
    weight = 1.0 / (num + _DAMPED_UPDATES)
    error = (1.0 - weight) * state.error + weight * (target_accept - accept_probability)
    log_step = jnp.minimum(
        state.log_start - jnp.sqrt(num) / _SHRINKAGE * error, jnp.log(max_step)
    )
    forget = num ** (-_FORGETTING)
    log_average = forget * log_step + (1.0 - forget) * state.log_average
    return DualAveraging(
        log_start=state.log_start,
        log_step=log_step.astype(state.log_step.dtype),
        log_average=log_average.astype(state.log_step.dtype),
        error=error.astype(state.log_step.dtype),
        num_updates=num,
    )
