"""Posteriors built by hand from known draws, for tests of what is made of them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics import Params, empty_params, rollout
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict


def table_spec(**changes) -> SceneSpec:
    """One unknown box of 0.6 m by 0.4 m seen from above."""
    body = {
        "name": "table",
        "pose": [0.0, 0.0, 0.0],
        "shape": {"type": "box", "half_extents": [0.3, 0.2]},
        **changes,
    }
    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": 0.02,
            "bodies": [body],
            "unknown": {"revolute": 1, "wheel": 1, "ground": 1},
        }
    )


def room_spec() -> SceneSpec:
    """Two unknown boxes and a wall."""

    def box(name, **fields):
        return {
            "name": name,
            "pose": [0.0, 0.0, 0.0],
            "shape": {"type": "box", "half_extents": [0.3, 0.2]},
            **fields,
        }

    return scene_spec_from_dict(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": 0.02,
            "bodies": [box("wall", static=True), box("table"), box("chair")],
            "unknown": {"revolute": 2, "wheel": 2},
        }
    )


def draws_like(params: Params, num_draws: int, **slots) -> Params:
    """Repeat params along a draw axis and set fields, `wheel_active=...` and so on."""
    many = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (num_draws, *leaf.shape)), params
    )
    for name, value in slots.items():
        kind, _, field = name.partition("_")
        if not field:
            many = eqx.tree_at(lambda p, k=kind: getattr(p, k), many, value)
            continue
        old = getattr(getattr(many, kind), field)
        many = eqx.tree_at(
            lambda p, k=kind, f=field: getattr(getattr(p, k), f),
            many,
            jnp.broadcast_to(jnp.asarray(value, old.dtype), old.shape),
        )
    return many


def make_posterior(
    spec: SceneSpec,
    params: Params,
    prior_params: Params,
    *,
    weights: np.ndarray | None = None,
    noise_scale: tuple[float, ...] = (0.001, 0.001, 0.005, 0.005),
    **fields,
) -> Posterior:
    """A posterior with constant noise and every slot inferred."""
    num_draws, num_bodies = params.density.shape
    num_prior = prior_params.density.shape[0]
    if weights is None:
        weights = np.full(num_draws, 1.0 / num_draws)
    with np.errstate(divide="ignore"):
        log_weight = np.log(weights / np.sum(weights))
    first = jax.tree.map(lambda leaf: leaf[0], params)
    noise = np.random.default_rng(9).lognormal(0.0, 1.0, (num_prior, num_bodies, 4))
    given = {
        "inferred": {
            kind: np.ones(getattr(first, kind).active.shape, bool)
            for kind in ("revolute", "distance", "wheel", "ground")
        },
        "chain": jnp.arange(num_draws) * 2 // num_draws,
        "log_density": jnp.linspace(-1.0, 1.0, num_draws),
        "log_evidence": 12.5,
        "diagnostics": {"ok": True, "reasons": [], "r_hat": 1.003},
        "seconds": {"compile": 1.0, "run": 0.5},
        "seed": 3,
        **fields,
    }
    return Posterior(
        params=params,
        noise_scale=jnp.broadcast_to(
            jnp.asarray(noise_scale), (num_draws, num_bodies, 4)
        ),
        log_weight=jnp.asarray(log_weight),
        prior_params=prior_params,
        prior_noise_scale=jnp.asarray(0.01 * noise),
        spec=spec,
        **given,
    )


def table_posterior(
    num_draws: int = 400, spec: SceneSpec | None = None, **fields
) -> Posterior:
    """A pinned table: three quarters of the draws have the pin, a quarter a wheel too.

    The pin's place, the mass and the wheel's lateral friction are well known; the wheel
    may slide along its axle and its rolling friction is a priori.
    """
    generator = np.random.default_rng(0)
    spec = table_spec() if spec is None else spec
    empty = empty_params(1, num_revolute=1, num_wheel=1, num_ground=1)

    def normal(*shape):
        return generator.normal(size=shape)

    has_wheel = np.arange(num_draws) % 4 == 0
    heading = 0.4 + 0.02 * normal(num_draws)
    along, across = 0.3 * normal(num_draws), 0.05 + 0.004 * normal(num_draws)
    place = across[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    place += along[:, None] * np.stack([-np.sin(heading), np.cos(heading)], -1)
    pin = np.array([0.25, 0.1]) + 0.002 * normal(num_draws, 2)
    viscous = np.exp(np.array([0.0, 3.0]) + np.array([1.5, 0.1]) * normal(num_draws, 2))
    wheel = has_wheel[:, None]
    params = draws_like(
        empty,
        num_draws,
        density=jnp.asarray(20.0 * np.exp(0.02 * normal(num_draws, 1))),
        revolute_active=True,
        revolute_anchor_a=pin[:, None],
        revolute_anchor_b=pin[:, None] + 1.0,
        revolute_viscous=np.exp(-2.0 + 0.1 * normal(num_draws, 1)),
        revolute_dry=np.inf,
        wheel_active=wheel[:, None],
        wheel_position=np.where(wheel, place, 0.0)[:, None, None],
        wheel_heading=np.where(has_wheel, heading, 0.0)[:, None, None],
        wheel_viscous=np.where(wheel, viscous, 0.0)[:, None, None],
        wheel_dry=np.where(wheel, np.inf, 0.0)[:, None, None],
    )
    return make_posterior(spec, params, table_prior(), **fields)


def table_prior(num_draws: int = 500) -> Params:
    """Prior draws for a table, every slot active."""
    generator = np.random.default_rng(1)

    def normal(*shape):
        return generator.normal(size=shape)

    return draws_like(
        empty_params(1, num_revolute=1, num_wheel=1, num_ground=1),
        num_draws,
        density=jnp.asarray(30.0 * np.exp(1.5 * normal(num_draws, 1))),
        revolute_active=True,
        revolute_anchor_a=0.4 * normal(num_draws, 1, 2),
        revolute_anchor_b=0.4 * normal(num_draws, 1, 2),
        revolute_viscous=np.exp(-2.0 + 2.0 * normal(num_draws, 1)),
        revolute_dry=np.inf,
        wheel_active=True,
        wheel_position=0.3 * normal(num_draws, 1, 1, 2),
        wheel_heading=generator.uniform(-np.pi, np.pi, (num_draws, 1, 1)),
        wheel_viscous=np.sort(np.exp(1.5 * normal(num_draws, 1, 1, 2)), axis=-1),
        wheel_dry=np.inf,
        ground_active=True,
        ground_dry=np.exp(0.8 * normal(num_draws, 1, 1)),
        ground_viscous=np.exp(0.8 * normal(num_draws, 1, 1)),
    )


def pushed_history(
    params: Params, spec: SceneSpec, *, num_rows: int = 60, seed: int = 0
) -> History:
    """Readings of one hypothesis under random pushes, in two episodes, with noise."""
    generator = np.random.default_rng(seed)
    half = num_rows // 2
    num_bodies = len(spec.bodies)
    is_moving = np.array([not body.is_static for body in spec.bodies])
    tables = []
    for _ in range(2):
        pushes = np.repeat(generator.normal(size=(half // 5 + 1, num_bodies, 3)), 5, 0)
        wrench = pushes[:half] * np.array([8.0, 8.0, 1.0]) * is_moving[:, None]
        states, _ = rollout(
            spec.scene, params, spec.initial_state(), jnp.asarray(wrench)
        )
        truth = np.concatenate(
            [np.asarray(spec.initial_state().array)[None], np.asarray(states.array)]
        )
        scale = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3]) * is_moving[:, None]
        reading = truth + scale * generator.normal(size=truth.shape)
        tables.append((reading[:-1], wrench, reading[1:]))
    state, action, next_state = (
        np.concatenate(part) for part in zip(*tables, strict=True)
    )
    return make_history(
        state, action, next_state, 0.02, episode=np.repeat([0, 1], half)
    )
