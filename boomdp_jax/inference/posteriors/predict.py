"""How well a posterior predicts held-out motion, several steps ahead.

From every row of an episode whose start is known, draws of the posterior are rolled out
under the recorded wrenches. A prediction is uncertain for three reasons, and all are
drawn: which hypothesis holds, where the bodies truly were at the start, and how the
reading at the end will err.
"""

import functools
import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.core.history import History
from boomdp_jax.core.quick_compile import KeptJit
from boomdp_jax.inference.hypotheses.whole_motion import (
    WholeScene,
    many_rollouts,
    whole_scene,
)
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.posteriors.prediction_starts import (
    PredictionStarts,
    with_walls,
)
from boomdp_jax.inference.posteriors.random_motion import add_impulse, add_reading_noise
from boomdp_jax.inference.posteriors.summary import CHANNELS, plain
from boomdp_jax.physics import Params, State, rollout, state_from_array, step
from boomdp_jax.physics.actuator import delayed, past_commands

SCHEMA = "boomdp-predict-1"

_COLUMNS = {"position": [0, 1], "angle": [2], "velocity": [3, 4], "spin": [5]}
_STARTS_AT_ONCE = 16
"""Starts rolled out together: enough to fill vectors, few enough to bound memory."""


def predict(
    posterior: Posterior,
    history: History,
    horizons: int | Iterable[int] = (1, 10, 50),
    *,
    num_draws: int = 128,
    key: Key | None = None,
    starts: str = "auto",
) -> dict:
    """Score predictions at several horizons.

    A start is a row that is followed by enough rows of its episode, and whose reading
    has every channel of every body that can move; or, `filtered`, at or before which
    every pose was read twice in that episode: from readings until then each draw's
    filter says where the bodies are and how fast. Readings at the end count channel by
    channel. Angles are compared as they are, not modulo a turn, as files hold them
    unwrapped.

    Args:
        posterior: what is believed.
        history: readings and wrenches that it has not seen.
        horizons: steps ahead, one number or several.
        num_draws: draws rolled out from each start; of a posterior with fewer each is,
            with noise of its own, as often as it takes.
        key: random key; default: that of seed 0.
        starts: `readings`, `filtered`, or `auto`: the former where there is a whole
            reading to start from, else the latter.

    Returns:
        A `boomdp-predict-1` object. By horizon and channel: `rmse` of the predictive
        mean (of the distance, for position [m] and velocity [m/s]; of the angle [rad]
        and spin [rad/s]), `coverage90` of central 90 % intervals, `log_score`: mean log
        predictive density of a number, of the normal with the draws' mean and
        variance, and `baseline_rmse` of constant velocity (that between the
        last two readings of a pose, where it was not read); None where nothing could
        be scored. By horizon, `num_starts`: rows that were predicted from. `starts`:
        `readings` or `filtered`.

    Raises:
        ValueError: a horizon that is no whole number or under one, too few draws,
            another number of bodies, starts that are none of the above, or a history
            without rows.
    """
    horizons = _sorted_horizons(horizons)
    num_draws = whole_number("num_draws", num_draws, 2)
    num_bodies = len(posterior.spec.bodies)
    if history.num_bodies != num_bodies:
        raise ValueError(
            f"history: expected {num_bodies} bodies as in the scene, got "
            f"{history.num_bodies}"
        )
    if not np.any(history.mask):
        raise ValueError("history: expected at least one row, got none")
    key = jax.random.key(0) if key is None else key
    history = with_walls(posterior.spec, history)
    kept = _enough_draws(posterior, num_draws)
    table = jax.tree.map(np.asarray, history)
    is_static = np.asarray(posterior.spec.scene.is_static)
    known = PredictionStarts(starts, key, kept, history)
    moments = _predict_rows(
        key,
        whole_scene(posterior.spec),
        posterior.spec.with_surface(kept.params),
        kept.noise_scale,
        kept.impulse_scale,
        history,
        commands_in_effect(kept.params, history),
        tuple(horizons),
        posterior.degrees_of_freedom,
        known.state,
    )
    moments = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), moments)
    report, counts = {}, {}
    for place, horizon in enumerate(horizons):
        at_horizon = {name: leaf[:, place] for name, leaf in moments.items()}
        at_horizon["baseline"] = known.baseline(horizon)
        rows = known.rows(horizon)
        counts[str(horizon)] = len(rows)
        with np.errstate(over="ignore", invalid="ignore"):
            report[str(horizon)] = _score(at_horizon, table, rows, horizon, is_static)
    out = {"schema": SCHEMA, "horizons": report, "num_starts": counts}
    return plain(out | {"starts": known.name})


def _enough_draws(posterior: Posterior, num_draws: int) -> Posterior:
    """Draws of equal weight; few are all rolled out several times.

    Noise is drawn for each: one hypothesis foretells a spread as well.
    """
    kept = posterior.thin(num_draws)
    times = -(-num_draws // kept.num_draws)
    if times == 1:
        return kept
    rows = np.tile(np.arange(kept.num_draws), times)

    def parts(p: Posterior) -> tuple:
        return p.params, p.noise_scale, p.impulse_scale

    repeated = jax.tree.map(lambda leaf: leaf[rows], parts(kept))
    return eqx.tree_at(parts, kept, repeated, is_leaf=lambda leaf: leaf is None)


def _sorted_horizons(horizons: Any) -> list[int]:
    """Each horizon once, the nearest first."""
    is_one = not isinstance(horizons, Iterable) or getattr(horizons, "shape", 0) == ()
    given = [horizons] if is_one else list(horizons)
    whole = sorted({whole_number("horizons", each, 0) for each in given})
    if not whole or whole[0] < 1:
        raise ValueError(f"horizons: expected steps of at least 1, got {whole}")
    return whole


def sample_readings(
    key: Key,
    world: WholeScene,
    params: Params,
    noise_scale: Float[Array, "draw body 4"],
    reading: Float[Array, "draw body 6"],
    wrenches: Float[Array, "draw time body 3"],
    dt: Float[Array, "draw time"],
    places: Int[Array, " place"],
    impulse_scale: Float[Array, "draw body 2"] | None = None,
    freedom: float | None = None,
    is_true: bool = False,
) -> Float[Array, "draw place body 6"]:
    """Draw what may be read later, one trajectory for each hypothesis.

    Args:
        key: random key.
        world: of `whole_scene`.
        params: hypotheses with a leading draw axis.
        noise_scale: of each hypothesis [m, rad, m/s, rad/s].
        reading: what is read at the start; the truth scatters around it.
        wrenches: held over each step [N, N, N m].
        dt: lengths of the steps [s].
        places: after which steps to read, counted from 0.
        impulse_scale: noise of the motion [m/s, rad/s]; None: it has none.
        freedom: degrees of freedom of the readings' Student-t noise; None: normal.
        is_true: whether `reading` is where each trajectory truly starts.

    Returns:
        Readings at those places.
    """
    start_key, end_key, kick_key = jax.random.split(key, 3)
    is_static = world.scene.is_static
    start = state_from_array(reading)
    if not is_true:
        start = add_reading_noise(start_key, start, noise_scale, is_static, freedom)
    states = _true_states(kick_key, world, params, start, wrenches, dt, impulse_scale)
    states = jax.tree.map(lambda leaf: leaf[:, places], states)
    return add_reading_noise(
        end_key, states, noise_scale[:, None], is_static, freedom
    ).array


def _true_states(key, world, params, start, wrenches, dt, impulse_scale) -> State:
    """After each step, `[draw, time]`; velocities change at random before it."""
    scene, keys = world.scene, jax.random.split(key, len(dt))

    def alone(key, params, state, wrenches, dt, impulse_scale):
        if impulse_scale is None:
            return rollout(scene, params, state, wrenches, dt=dt)[0]
        return _rollout_with_impulses(
            key, scene, params, state, wrenches, dt, impulse_scale
        )

    def kicks_of(key, dt, impulse_scale):
        still = State(jnp.zeros_like(start.pose[0]), jnp.zeros_like(start.twist[0]))
        return jax.vmap(
            lambda key: add_impulse(key, still, impulse_scale, scene.is_static).twist
        )(jax.random.split(key, len(dt)))

    if world.contact is None:
        return jax.vmap(alone)(keys, params, start, wrenches, dt, impulse_scale)
    kicks = None
    if impulse_scale is not None:
        kicks = jax.vmap(kicks_of)(keys, dt, impulse_scale)
    return many_rollouts(world, params, start, wrenches, dt, kicks)


def _rollout_with_impulses(key, scene, params, state, wrenches, dt, impulse_scale):
    """One trajectory whose velocities change at random before each step."""
    keys = jax.random.split(key, len(dt))

    def advance(state, row):
        key, wrench, length = row
        state = add_impulse(key, state, impulse_scale, scene.is_static)
        state, _ = step(scene, params, state, wrench, dt=length)
        return state, state

    return jax.lax.scan(advance, state, (keys, wrenches, dt))[1]


@functools.partial(KeptJit, static=("horizons", "freedom"))
def _predict_rows(
    key: Key,
    world: WholeScene,
    params: Params,
    noise_scale: Float[Array, "draw body 4"],
    impulse_scale: Float[Array, "draw body 2"] | None,
    history: History,
    actions: Float[Array, "draw time body 3"] | None,
    horizons: tuple[int, ...],
    freedom: float | None,
    states: Float[Array, "draw time body 6"] | None,
) -> dict[str, Float[Array, "time horizon body 6"]]:
    """Moments and interval of the predictive distribution from every row.

    Rows that no episode follows long enough are computed too, from whatever comes
    next, and masked when scored: one shape serves every history of a capacity. Starts
    and draws share one axis: two nested ones took ten times as long to compile.
    """
    num_draws, num_rows = noise_scale.shape[0], history.capacity
    num_starts = min(_STARTS_AT_ONCE, num_rows)
    num_blocks = -(-num_rows // num_starts)
    last = num_rows - 1
    rows = jnp.minimum(jnp.arange(num_blocks * num_starts), last)
    places = jnp.array(horizons) - 1
    draw = jnp.tile(jnp.arange(num_draws), num_starts)

    def predict_block(inputs):
        block_key, starts = inputs
        row = jnp.repeat(starts, num_draws)
        following = jnp.minimum(row[:, None] + jnp.arange(horizons[-1])[None], last)
        readings = sample_readings(
            block_key,
            world,
            jax.tree.map(lambda leaf: leaf[draw], params),
            noise_scale[draw],
            history.state[row] if states is None else states[draw, row],
            history.action[following]
            if actions is None
            else actions[draw[:, None], following],
            history.dt[following],
            places,
            None if impulse_scale is None else impulse_scale[draw],
            freedom,
            is_true=states is not None,
        ).reshape(num_starts, num_draws, *places.shape, -1, 6)
        low, high = jnp.quantile(readings, _levels(num_draws), axis=1)
        return {
            "mean": readings.mean(axis=1),
            "variance": readings.var(axis=1, ddof=1),
            "low": low,
            "high": high,
        }

    blocks = rows.reshape(num_blocks, num_starts)
    keys = jax.random.split(key, num_blocks)
    moments = jax.lax.map(predict_block, (keys, blocks))
    return jax.tree.map(
        lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[:num_rows], moments
    )


def _levels(num_draws: int) -> Float[Array, "2"]:
    """Between which of so many draws a further one lies with 90 %.

    Between the draws of ranks k and m of n, in order, it lies with (m - k)/(n + 1); the
    quantiles of draws themselves are nearer to each other.
    """
    ranks = jnp.array([0.05, 0.95]) * (num_draws + 1) - 1.0
    return jnp.clip(ranks / (num_draws - 1), 0.0, 1.0)


def commands_in_effect(
    params: Params, history: History
) -> Float[Array, "draw time body 3"] | None:
    """Commands as they take effect by each draw.

    Args:
        params: hypotheses with a leading draw axis.
        history: what was commanded.

    Returns:
        Wrenches [N, N, N m]; None where none is delayed.
    """
    if params.actuator is None or params.actuator.delay is None:
        return None
    table = jax.tree.map(np.asarray, history)
    is_start = np.diff(table.episode, prepend=np.nan) != 0
    commands = past_commands(table.action, table.dt, is_start)
    return jax.lax.map(lambda one: delayed(one, commands), params)


def _score(
    moments: dict[str, np.ndarray],
    history: History,
    starts: np.ndarray,
    horizon: int,
    is_static: np.ndarray,
) -> dict:
    """Compare predictions with what was read at one horizon."""
    ends = starts + horizon - 1
    moving = ~is_static
    reading = history.next_state[ends][:, moving].astype(np.float64)
    is_read = history.next_state_mask[ends][:, moving]
    chosen = {name: leaf[starts][:, moving] for name, leaf in moments.items()}
    report: dict = {}
    for channel in CHANNELS:
        columns = _COLUMNS[channel]
        there = is_read[..., columns]
        if not there.any():
            report[channel] = dict.fromkeys(
                ("rmse", "coverage90", "log_score", "baseline_rmse")
            )
            continue
        value = reading[..., columns][there]
        part = {name: leaf[..., columns][there] for name, leaf in chosen.items()}
        error, drift = value - part["mean"], value - part["baseline"]
        drift = drift[np.isfinite(drift)]
        variance = np.maximum(part["variance"], np.finfo(np.float32).tiny)
        inside = (part["low"] <= value) & (value <= part["high"])
        density = -0.5 * (error**2 / variance + np.log(2.0 * math.pi * variance))
        report[channel] = {
            "rmse": math.sqrt(len(columns) * np.mean(error**2)),
            "coverage90": float(np.mean(inside)),
            "log_score": float(np.mean(density)),
            "baseline_rmse": math.sqrt(len(columns) * np.mean(drift**2))
            if drift.size
            else None,
        }
    return report
