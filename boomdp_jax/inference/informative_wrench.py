r"""Which push would tell most: expected information gain of wrenches.

For a wrench u held from a state on, with y the reading at its end,

$$I(u) = E\left[\log p(y \mid \Phi, u) - \log p(y \mid u)\right]
  \approx \frac1N \sum_i \log \frac{p(y_i \mid \Phi_i, u)}
  {\tfrac1N \sum_j p(y_i \mid \Phi_j, u)}, \quad y_i \sim p(\cdot \mid \Phi_i, u),$$

over posterior draws: in expectation a lower bound, and never above log N. Foster et al.
(2020), A unified stochastic gradient approach to designing Bayesian-optimal
experiments, eq. 9. Of that, what y tells of the structure alone is
$E[\log p(y \mid k, u) - \log p(y \mid u)]$, with $p(y \mid k, u)$ the mean over the
draws of structure k. Noise is the same for every wrench, so that gains compare well.

It costs one simulation per draw and wrench, and the likelihood of every pair of draws.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.checked_input import real_array, whole_number
from boomdp_jax.inference.posterior import Posterior
from boomdp_jax.physics import step
from boomdp_jax.physics.arguments import check_state_is_finite, checked_state
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State

# Noise group of x, y, theta, xdot, ydot, thetadot.
_GROUP = (0, 0, 1, 2, 2, 3)


class InformationGain(NamedTuple):
    """What each candidate is expected to tell [nats]."""

    best: int
    """Candidate of the largest gain."""
    wrench: Float[Array, "body 3"]
    """That candidate."""
    gain: Float[Array, " candidate"]
    """Of structure and all numbers."""
    structure_gain: Float[Array, " candidate"]
    """Of the structure alone; at most its entropy."""
    error: Float[Array, " candidate"]
    """Standard error of `gain`, for draws as given; differences err by less."""


def informative_wrench(
    key: Key,
    posterior: Posterior,
    state: State,
    candidates: Array | np.ndarray,
    *,
    num_steps: int = 1,
    num_draws: int = 256,
) -> InformationGain:
    """Choose the wrench that is expected to tell most.

    Args:
        key: random key.
        posterior: what is known.
        state: where the bodies are.
        candidates: wrenches at the centres of mass `[candidate, body, 3]` [N, N m].
        num_steps: steps of the scene over which a wrench is held before the reading.
        num_draws: posterior draws that are compared; gains above their logarithm
            cannot be told apart.

    Returns:
        The gain of each candidate, and the best.

    Raises:
        ValueError: no candidate, wrenches of another number of bodies or not finite, a
            count that is no positive whole number, no state, or a state of another
            number of bodies or not finite.
    """
    wrenches = real_array("candidates", candidates)
    num_bodies = posterior.spec.num_bodies
    if wrenches.ndim != 3 or wrenches.shape[1:] != (num_bodies, 3) or not len(wrenches):
        raise ValueError(
            f"candidates: expected shape [candidate, {num_bodies}, 3] with one at "
            f"least, got {wrenches.shape}"
        )
    if not np.all(np.isfinite(wrenches)):
        index = int(np.argwhere(~np.isfinite(wrenches))[0, 0])
        raise ValueError(f"candidates: expected finite wrenches, got one at {index}")
    num_steps = whole_number("num_steps", num_steps, 1)
    num_draws = whole_number("num_draws", num_draws, 1)
    state = checked_state(posterior.spec.num_bodies, state)
    # Of a body that is nowhere every candidate would tell the same.
    check_state_is_finite(state, posterior.spec.names)
    thinned = posterior.thin(num_draws)
    scene = posterior.spec.scene
    gain, structure_gain, error = _gains(
        key,
        scene,
        posterior.spec.with_surface(thinned.params),
        thinned.noise_scale,
        jnp.asarray(_structures(thinned)),
        state,
        jnp.asarray(wrenches, thinned.noise_scale.dtype),
        num_steps,
    )
    best = int(np.argmax(np.asarray(gain)))
    return InformationGain(
        best, jnp.asarray(wrenches[best], float), gain, structure_gain, error
    )


def _structures(posterior: Posterior) -> np.ndarray:
    """Number of each draw's structure, `[draw]`."""
    num = posterior.num_draws
    columns = [np.zeros((num, 1), bool)]
    for kind, is_inferred in posterior.inferred.items():
        active = np.asarray(getattr(posterior.params, kind).active).reshape(num, -1)
        columns.append(active[:, np.ravel(is_inferred)])
    rows = np.concatenate(columns, axis=1)
    return np.unique(rows, axis=0, return_inverse=True)[1].reshape(num)


@eqx.filter_jit
def _gains(
    key: Key,
    scene: Scene,
    params: Params,
    noise_scale: Float[Array, "draw body 4"],
    structure: Int[Array, " draw"],
    state: State,
    candidates: Float[Array, "candidate body 3"],
    num_steps: int,
) -> tuple[Array, Array, Array]:
    """Gain, that of the structure, and standard error of every candidate."""
    scale = noise_scale[..., jnp.asarray(_GROUP)]
    moves = jnp.broadcast_to(~scene.is_static[:, None], scale.shape[1:])
    noise = scale * jax.random.normal(key, scale.shape, scale.dtype)
    same = structure[:, None] == structure[None]

    def predict(params: Params, wrench: Array) -> Array:
        def advance(state: State, _: None) -> tuple[State, None]:
            return step(scene, params, state, wrench)[0], None

        return jax.lax.scan(advance, state, None, length=num_steps)[0].array

    def one(wrench: Array) -> tuple[Array, Array, Array]:
        mean = jax.vmap(lambda params: predict(params, wrench))(params)
        log_likelihood = _log_likelihood(mean + noise, mean, scale, moves)
        own = jnp.diagonal(log_likelihood)
        num = own.shape[0]
        whole = logsumexp(log_likelihood, axis=1) - jnp.log(num)
        within = logsumexp(jnp.where(same, log_likelihood, -jnp.inf), axis=1)
        within = within - jnp.log(jnp.sum(same, axis=1))
        each = own - whole
        error = jnp.std(each) / jnp.sqrt(num)
        return jnp.mean(each), jnp.mean(within - whole), error

    return jax.lax.map(one, candidates)


def _log_likelihood(
    reading: Float[Array, "draw body 6"],
    mean: Float[Array, "draw body 6"],
    scale: Float[Array, "draw body 6"],
    moves: Bool[Array, "body 6"],
) -> Float[Array, "draw draw"]:
    """Of every reading (rows) under every draw (columns), up to a constant."""

    def pair(reading: Array, mean: Array, scale: Array) -> Array:
        each = -0.5 * ((reading - mean) / scale) ** 2 - jnp.log(scale)
        return jnp.sum(jnp.where(moves, each, 0.0))

    over_draws = jax.vmap(pair, (None, 0, 0))
    return jax.lax.map(lambda r: over_draws(r, mean, scale), reading)
