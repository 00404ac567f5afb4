r"""What is read after a wrench was held: its law under every hypothesis of a list.

From a state that is known, the mean is where a body goes that nothing disturbs, and the
motion's own noise, independent impulses on the twists before every step, spreads it,

$$P \leftarrow A \, (P + G Q G^T) \, A^T, \qquad y \sim m + N(0, P) + \sigma \epsilon,$$

as the filters have it whose likelihood inferred the impulses (`kalman.RowFilter`); A is
by differences of one sd of the state, which averages over kinks finer than that. The
reading's noise is normal or Student's t. In the latter case the density is that of
`robust_update.correct_robustly`, exact where the motion has no noise.

Särkkä (2013), Bayesian Filtering and Smoothing, algorithm 5.4.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.full_precision import full_precision
from boomdp_jax.inference.likelihoods.filter_update import move
from boomdp_jax.inference.likelihoods.kalman import channel_scale, kick_scale
from boomdp_jax.inference.likelihoods.robust_update import correct_robustly
from boomdp_jax.physics import step
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State, state_from_array


class ReadingLaw(eqx.Module):
    """Of the channels of bodies that move, under each of some hypotheses."""

    mean: Float[Array, "draw channel"]
    """Of x, y, theta, xdot, ydot, thetadot, body by body [m, rad, m/s, rad/s]."""
    covariance: Float[Array, "draw channel channel"] | None
    """Of the state; None: it is certain."""
    scale: Float[Array, "draw channel"]
    """Of the reading's noise."""
    freedom: float | None = eqx.field(static=True)
    """Degrees of freedom of Student-t noise; None: it is normal."""


class ReadingNoise(eqx.Module):
    """Standard numbers that readings are made of, the same for every wrench."""

    normal: Float[Array, "draw body 6"]
    student: Float[Array, "draw body 6"] | None
    """None: readings have normal noise."""


def draw_noise(
    key: Key, num_draws: int, num_bodies: int, freedom: float | None, dtype: np.dtype
) -> ReadingNoise:
    """Draw what one reading of each hypothesis needs.

    Args:
        key: random key.
        num_draws: hypotheses.
        num_bodies: all of the scene.
        freedom: as `ReadingLaw` has it.
        dtype: float type.
    """
    shape = (num_draws, num_bodies, 6)
    normal = jax.random.normal(key, shape, dtype)
    if freedom is None:
        return ReadingNoise(normal, None)
    student = jax.random.t(jax.random.fold_in(key, 1), freedom, shape, dtype)
    return ReadingNoise(normal, student)


def law_after(
    scene: Scene,
    params: Params,
    noise_scale: Float[Array, "draw body 4"],
    impulse_scale: Float[Array, "draw body 2"] | None,
    state: State,
    wrench: Float[Array, "body 3"],
    share: Float[Array, "*draw time body 3"],
    *,
    bodies: Sequence[int],
    freedom: float | None = None,
) -> ReadingLaw:
    """Predict the reading after a wrench, under each hypothesis.

    Args:
        scene: outlines, feet, gravity.
        params: hypotheses with a leading draw axis.
        noise_scale: of the readings [m, rad, m/s, rad/s].
        impulse_scale: noise of the motion [m/s, rad/s]; None: it has none. It costs six
            steps more per step and body that moves.
        state: where it starts.
        wrench: commanded all the time [N, N, N m].
        share: of the command that is in effect in each step of the scene, under each
            hypothesis or all.
        bodies: those that move; the others have no noise.
        freedom: as `ReadingLaw` has it.
    """
    index, num = np.asarray(bodies, int), noise_scale.shape[0]
    scale = jax.vmap(channel_scale)(noise_scale)[:, index].reshape(num, -1)
    kick = None
    if impulse_scale is not None:
        kick = jax.vmap(kick_scale)(impulse_scale)[:, index].reshape(num, -1) ** 2

    def image(params: Params, channels: Array, wrench: Array) -> Array:
        before = state.array.at[index].set(channels.reshape(-1, 6))
        after, _ = step(scene, params, state_from_array(before), wrench)
        return after.array[index].reshape(-1)

    # Draws are the inner axis, which is long enough for vectors.
    of_draws = jax.vmap(image, (0, 0, 0 if share.ndim == 4 else None))
    of_points = jax.vmap(of_draws, (None, 0, None))

    def one_step(carry: tuple, share: Array) -> tuple[tuple, None]:
        mean, covariance = carry
        now = share * jnp.broadcast_to(wrench, share.shape)
        if covariance is None or kick is None:
            return (of_draws(params, mean, now), None), None
        # A channel that is certain has no sd, nor does its slope matter.
        spread = jnp.diagonal(covariance, axis1=1, axis2=2) + kick
        offset = jnp.where(spread > 0, jnp.sqrt(spread), scale)
        shifts = offset.T[:, :, None] * jnp.eye(offset.shape[1])[:, None]
        points = jnp.concatenate([mean[None], mean[None] + shifts])
        images = of_points(params, points, now)
        moved = jax.vmap(move, (0, 1, 0, 0))(
            covariance, images[1:] - images[:1], offset, kick
        )
        return (images[0], moved), None

    start = state.array[index].reshape(1, -1)
    start = jnp.broadcast_to(start, scale.shape)
    none = None if kick is None else jnp.zeros((*kick.shape, kick.shape[1]), kick.dtype)
    shares = share if share.ndim == 3 else jnp.moveaxis(share, 1, 0)
    (mean, covariance), _ = jax.lax.scan(one_step, (start, none), shares)
    if covariance is not None:
        # What products are rounded by is noise, too.
        variance = jnp.diagonal(covariance, axis1=1, axis2=2)
        scale = jnp.sqrt(scale**2 + _slack(scale) * variance)
    return ReadingLaw(mean, covariance, scale, freedom)


def readings_of(law: ReadingLaw, noise: ReadingNoise) -> Float[Array, "draw channel"]:
    """Draw a reading under each hypothesis.

    Args:
        law: of the readings.
        noise: of the channels that it is about.
    """
    shape, spread = law.mean.shape, law.covariance
    normal = noise.normal.reshape(shape)
    if noise.student is not None:
        far = law.mean + law.scale * noise.student.reshape(shape)
        return far if spread is None else far + _times(_factor(spread), normal)
    if spread is None:
        return law.mean + law.scale * normal
    return law.mean + _times(_factor(_of_reading(spread, law.scale)), normal)


@full_precision
def log_likelihood(
    law: ReadingLaw, reading: Float[Array, "reading channel"]
) -> Float[Array, "reading draw"]:
    """Log-density of every reading under every hypothesis, up to a constant.

    Args:
        law: of the readings.
        reading: what was read, whichever hypothesis it was drawn under.
    """
    if law.covariance is None:
        return _of_independent(law, reading)
    if law.freedom is not None:
        return _of_student(law, reading, law.freedom)

    # All in one product of two matrices; about what is expected on the whole, since
    # positions may be thousands of sds.
    num, size = law.mean.shape
    factor = _factor(_of_reading(law.covariance, law.scale))
    unit = jnp.broadcast_to(jnp.eye(size, dtype=factor.dtype), factor.shape)
    whitening = solve_triangular(factor, unit, lower=True)
    center = jnp.mean(law.mean, axis=0, keepdims=True)
    expected = jnp.einsum("dij,dj->di", whitening, law.mean - center)
    white = (reading - center) @ whitening.reshape(-1, size).T
    white = white.reshape(-1, num, size) - expected[None]
    log_volume = jnp.sum(jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)), axis=-1)
    return -0.5 * jnp.sum(white**2, axis=-1) - log_volume[None]


def _of_independent(law: ReadingLaw, reading: Array) -> Array:
    """Where all noise is that of the reading."""

    def pair(reading: Array, mean: Array, scale: Array) -> Array:
        square = ((reading - mean) / scale) ** 2
        if law.freedom is None:
            return jnp.sum(-0.5 * square - jnp.log(scale))
        power = 0.5 * (law.freedom + 1.0)
        return jnp.sum(-power * jnp.log1p(square / law.freedom) - jnp.log(scale))

    over_draws = jax.vmap(pair, (None, 0, 0))
    return jax.lax.map(lambda r: over_draws(r, law.mean, law.scale), reading)


def _of_student(law: ReadingLaw, reading: Array, freedom: float) -> Array:
    """Of normal motion read with Student-t noise."""

    def pair(reading, mean, covariance, scale) -> Array:
        counts = jnp.ones_like(mean)
        miss = reading - mean
        found = correct_robustly(covariance, miss, counts, scale**2, freedom)
        return found.log_density

    over_draws = jax.vmap(pair, (None, 0, 0, 0))
    return jax.lax.map(
        lambda r: over_draws(r, law.mean, law.covariance, law.scale), reading
    )


def _of_reading(covariance: Array, scale: Array) -> Array:
    """Covariance of readings with normal noise."""
    return covariance + jax.vmap(jnp.diag)(scale**2)


def _factor(covariance: Float[Array, "draw channel channel"]) -> Array:
    """Cholesky factors, of covariances without an inverse too."""
    sd = jnp.sqrt(jnp.diagonal(covariance, axis1=1, axis2=2))
    unit = jnp.where(sd > 0, sd, 1.0)
    correlation = covariance / (unit[:, :, None] * unit[:, None])
    slack = _slack(sd) * jnp.eye(sd.shape[-1])
    factor = jnp.linalg.cholesky(correlation + slack[None])
    return sd[:, :, None] * factor


def _slack(channels: Float[Array, "draw channel"]) -> float:
    """Share of a variance that is more than its rounding."""
    return channels.shape[-1] * float(jnp.finfo(channels.dtype).eps)


def _times(factor: Array, vector: Array) -> Array:
    return jnp.sum(factor * vector[:, None], axis=-1)
