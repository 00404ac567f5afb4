"""The Cramér-Rao bound on an object's mass, given what a recording could tell.

Readings are those of a deterministic trajectory of our engine: its start in each
episode and every number of the true structure are free, the structure and the noise are
known. With readings y_i = s_i(z, s_0) + noise of covariance R the information is the
sum of J_i^T R^-1 J_i; the starts are then marginalised out. A weak prior keeps
directions that cannot be seen (a wheel along its own axle) from being singular. Where
MuJoCo's laws of friction are not ours the number is a guide rather than a bound.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.transition_table import TransitionTable
from boomdp_jax.physics import Params, Scene, State, rollout
from boomdp_jax.physics.scene_spec import SceneSpec

_CAPACITY = 50
"""Steps of an episode; shorter ones are padded: each structure compiles once."""

_NUM_EPISODES = 4
_CHANNEL = np.array([0, 0, 1, 2, 2, 3])

PRIOR_SD = {"log": 1.5, "length": 1.0, "angle": 1.0, "offset": 1.0}
"""Of a number's logarithm, a place [m], a heading [rad], friction [N m s/rad]."""


def log_mass_bound(
    truth: SceneSpec,
    table: TransitionTable,
    noise_scale: np.ndarray,
    *,
    is_chained: bool,
) -> float:
    """Least standard deviation of log-mass of an unbiased estimate.

    Args:
        truth: scene with one body, of which everything is known.
        table: true states and wrenches, at most four episodes of at most 50 rows.
        noise_scale: sd of position, angle, velocity and spin readings.
        is_chained: one reading of each instant, or two inside an episode.

    Returns:
        The bound, about the relative sd of mass.
    """
    starts, wrenches, weights = _episodes(table, is_chained)
    with jax.enable_x64(True):
        inverse = 1.0 / np.asarray(noise_scale, float)[_CHANNEL] ** 2
        information = _information(
            truth.scene,
            truth.params(),
            jnp.asarray(starts),
            jnp.asarray(wrenches),
            jnp.asarray(weights[..., None] * inverse),
        )
        information = np.asarray(information)
    return float(np.sqrt(np.linalg.inv(information)[0, 0]))


def _episodes(table: TransitionTable, is_chained: bool) -> tuple[np.ndarray, ...]:
    """Starts, padded wrenches, and how often each instant was read."""
    starts = np.zeros((_NUM_EPISODES, 6))
    wrenches = np.zeros((_NUM_EPISODES, _CAPACITY, 3))
    weights = np.zeros((_NUM_EPISODES, _CAPACITY + 1))
    for place, episode in enumerate(np.unique(table.episode)):
        rows = np.flatnonzero(table.episode == episode)
        starts[place] = table.state[rows[0], 0]
        wrenches[place, : len(rows)] = table.action[rows, 0]
        weights[place, : len(rows) + 1] = 1.0 if is_chained else 2.0
        weights[place, [0, len(rows)]] = 1.0
    return starts, wrenches, weights


@jax.jit
def _information(scene: Scene, params: Params, starts, wrenches, weights) -> jax.Array:
    """Information about the numbers of the structure, starts marginalised out."""
    kinds, base = free_numbers(params)
    num_free = len(kinds)
    pinned = params.revolute.active.shape[0] > 0

    def start_state(free, first):
        """A free state, or angle and spin on the pin."""
        if not pinned:
            return first
        current = base(free).revolute
        cos, sin = jnp.cos(first[0]), jnp.sin(first[0])
        a = current.anchor_a[0]
        arm = -jnp.stack([cos * a[0] - sin * a[1], sin * a[0] + cos * a[1]])
        speed = first[1] * jnp.stack([-arm[1], arm[0]])
        place = current.anchor_b[0] + arm
        return jnp.concatenate([place, first[:1], speed, first[1:]])

    def path(free, first, wrench):
        start = start_state(free, first)[None]
        states, _ = rollout(
            scene, base(free), State(start[:, :3], start[:, 3:]), wrench[:, None]
        )
        return jnp.concatenate([start, states.array[:, 0]])

    def one_episode(start, wrench, weight):
        first = start[jnp.array([2, 5])] if pinned else start
        joint = jnp.concatenate([jnp.zeros(num_free), first])
        jacobian = jax.jacfwd(lambda q: path(q[:num_free], q[num_free:], wrench))(joint)
        both = jnp.einsum("tci,tc,tcj->ij", jacobian, weight, jacobian)
        cross = both[:num_free, num_free:]
        # An episode of padding alone tells nothing.
        own = both[num_free:, num_free:] + 1e-6 * jnp.eye(first.shape[0])
        return both[:num_free, :num_free] - cross @ jnp.linalg.solve(own, cross.T)

    total = jnp.sum(jax.vmap(one_episode)(starts, wrenches, weights), axis=0)
    prior = jnp.array([PRIOR_SD[kind] ** -2 for kind in kinds])
    return total + jnp.diag(prior)


def free_numbers(params: Params):
    """Kind of each free number, and the params that offsets from the truth make."""
    kinds, changes = ["log"], []
    fields = {
        "revolute": {"anchor_a": "length", "anchor_b": "length", "viscous": "offset"},
        "wheel": {
            "position": "length",
            "heading": "angle",
            "viscous": "log",
            "dry": "log",
        },
        "ground": {"dry": "log", "viscous": "log"},
    }
    for group, names in fields.items():
        for name, kind in names.items():
            leaf = getattr(getattr(params, group), name)
            if leaf.size:
                changes.append((group, name, kind, len(kinds), leaf.size))
                kinds += [kind] * leaf.size

    def base(free):
        current = _replace(params, "density", params.density * jnp.exp(free[0]))
        for group, name, kind, begin, size in changes:
            part = getattr(current, group)
            leaf = getattr(part, name)
            offset = free[begin : begin + size].reshape(leaf.shape)
            moved = leaf * jnp.exp(offset) if kind == "log" else leaf + offset
            current = _replace(current, group, _replace(part, name, moved))
        return current

    return kinds, base


def _replace(module, name: str, value):
    """A copy of a module with one field changed."""
    return eqx.tree_at(lambda m: getattr(m, name), module, value)
