"""Whether a pinned body has a wheel: what its drag says, beside what the draws say."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from boomdp_jax.core.history import make_history
from boomdp_jax.inference import infer_batch
from boomdp_jax.inference.doubts.drag_doubts import drag_reasons
from boomdp_jax.interop.object_families import hide
from boomdp_jax.physics import empty_params, rollout, scene_spec_from_dict
from tests.inference.made_posteriors import draws_like, make_posterior, table_spec

NUM_PRIOR, NUM_DRAWS = 4096, 50
ARM = 0.2
"""From the pin, at the centre of mass, to the wheel [m]."""
OWN, BESIDE = (-1.5, 1.0), (1.0, 0.7)
"""Mean and sd of the logarithms of both rates a priori."""
KERNEL = 0.05
SPIN = 2.0


def open_scene(*kinds, **content):
    """A table that may have a pin and some kinds besides."""
    unknown = dict.fromkeys(("revolute", *kinds), 1)
    content = table_spec().to_dict() | {"unknown": unknown} | content
    return scene_spec_from_dict(content, source="test")


def of_rates(spec, own, turned, *, active=True, **fields):
    """A table on a pin at its centre, and a wheel that only slides: drag of each."""
    num = len(own)
    inertia = 20.0 * spec.bodies[0].area * float(spec.scene.gyration[0])
    viscous = np.stack([0.0 * turned, inertia * turned / ARM**2], axis=-1)
    empty = empty_params(1, num_revolute=1, num_wheel=1, num_ground=1)
    given = {
        "density": jnp.full((num, 1), 20.0),
        "revolute_active": True,
        "revolute_viscous": inertia * own[:, None],
        "revolute_dry": np.inf,
        "wheel_active": active,
        "wheel_position": np.broadcast_to([ARM, 0.0], (num, 1, 1, 2)),
        "wheel_viscous": viscous[:, None, None],
        "wheel_dry": np.inf,
    }
    return draws_like(empty, num, **{**given, **fields})


def prior_of(spec):
    rng = np.random.default_rng(0)
    own, turned = (np.exp(rng.normal(*part, NUM_PRIOR)) for part in (OWN, BESIDE))
    return of_rates(spec, own, turned)


def turning(spin=SPIN, **missing):
    """A history of a body that turns as fast as that."""
    state = np.zeros((20, 1, 6))
    state[:, 0, 2], state[:, 0, 5] = spin * 0.02 * np.arange(20), spin
    after = state.copy()
    after[:, 0, 2] += spin * 0.02
    for channel in missing.get("unread", ()):
        state[..., channel] = after[..., channel] = np.nan
    return make_history(state, np.zeros((20, 1, 3)), after, 0.02)


def reasons_of(rate, *, spec=None, history=None, **fields):
    """Of draws with a pin, whose friction is all the drag there is."""
    spec = open_scene("wheel") if spec is None else spec
    nothing = np.zeros(NUM_DRAWS)
    given = {"wheel_viscous": 0.0, "active": False, **fields}
    params = of_rates(spec, np.full(NUM_DRAWS, rate), nothing, **given)
    posterior = make_posterior(spec, params, prior_of(spec))
    return drag_reasons(spec, turning() if history is None else history, posterior)


def probability(log_rate, share=0.3):
    """In closed form, but for one integral over the pin's own rate."""

    def own(x):
        return norm.pdf(x, OWN[0], np.hypot(OWN[1], KERNEL))

    def both(a):
        rest = np.exp(log_rate) - np.exp(a)
        change = np.exp(log_rate) / rest
        return norm.pdf(a, *OWN) * norm.pdf(np.log(rest), *BESIDE) * change

    beside = quad(both, -12.0, log_rate - 1e-9, limit=500)[0]
    return share * beside / (share * beside + (1.0 - share) * own(log_rate))


@pytest.mark.parametrize("log_rate", [0.5, 1.0, 2.0])
def test_drag_tells_how_probable_a_wheel_is(log_rate):
    (reason,) = reasons_of(np.exp(log_rate))
    pattern = r"table: about its pin a wheel is drag, .* probability is (\S+), by the"
    (found,) = re.findall(pattern, reason)
    # The kernel widens the density with a wheel a little as well.
    assert float(found) == pytest.approx(probability(log_rate), abs=0.06)
    assert "by the draws 0.00; neither is to be relied on" in reason


@pytest.mark.parametrize("log_rate", [1.0, 2.0])
def test_drag_tells_how_probable_a_floor_is(log_rate):
    """Of one that is viscous, so that its law has a closed form."""
    spec = open_scene("ground")
    body = spec.bodies[0]
    square = np.sum(body.feet**2, axis=-1) + body.foot_size**2
    rng = np.random.default_rng(1)
    own, turned = (np.exp(rng.normal(*part, NUM_PRIOR)) for part in (OWN, BESIDE))
    inertia = 20.0 * body.area * float(spec.scene.gyration[0])
    viscous = inertia * turned / (body.foot_load @ square)
    given = {"ground_viscous": viscous[:, None, None], "ground_dry": np.inf}
    prior = of_rates(spec, own, 0.0 * turned, active=False, ground_active=True, **given)
    nothing = np.zeros(NUM_DRAWS)
    params = of_rates(spec, np.full(NUM_DRAWS, np.exp(log_rate)), nothing, active=False)
    (reason,) = drag_reasons(spec, turning(), make_posterior(spec, params, prior))
    assert "friction with the floor is drag" in reason
    found = float(reason.split("probability is ")[1].split(",")[0])
    assert found == pytest.approx(probability(log_rate, 0.5), abs=0.06)


def test_a_prior_for_wheels_counts():
    spec = open_scene("wheel", prior={"probability": {"wheel": 0.05}})
    (reason,) = reasons_of(np.e**2, spec=spec)
    found = float(reason.split("probability is ")[1].split(",")[0])
    assert found == pytest.approx(probability(2.0, 0.05), abs=0.06)


def test_what_the_drag_agrees_with_is_not_doubted():
    assert reasons_of(np.exp(-1.5)) == []
    spec = open_scene("wheel")
    turned = np.full(NUM_DRAWS, np.exp(1.5))
    params = of_rates(spec, np.full(NUM_DRAWS, np.exp(-2.0)), turned)
    posterior = make_posterior(spec, params, prior_of(spec))
    assert drag_reasons(spec, turning(), posterior) == []


def test_a_wheel_that_hardly_drags_is_doubted():
    spec = open_scene("wheel")
    rates = np.full(NUM_DRAWS, np.exp(-1.5)), np.full(NUM_DRAWS, np.exp(-4.0))
    posterior = make_posterior(spec, of_rates(spec, *rates), prior_of(spec))
    (reason,) = drag_reasons(spec, turning(), posterior)
    assert "by the draws 1.00" in reason


def test_what_is_pinned_elsewhere_known_or_unread_is_let_be():
    rate = np.e
    assert reasons_of(rate)
    assert reasons_of(rate, revolute_active=False) == []
    assert reasons_of(rate, revolute_body_b=0) == []
    assert reasons_of(rate, history=turning(unread=(2, 5))) == []
    # From angles alone spins are known as well.
    assert reasons_of(rate, history=turning(unread=(3, 4, 5)))
    assert reasons_of(rate, spec=open_scene()) == []
    assert reasons_of(rate, spec=open_scene("wheel", normal_gravity=0.0)) == []


def test_limits_of_a_wheel_count():
    """One that slips at a hundredth of such a drag tells nothing: the prior is left."""
    spec = open_scene("wheel")
    prior = prior_of(spec)
    least = 20.0 * spec.bodies[0].area * float(spec.scene.gyration[0])
    least = 0.01 * least * np.e * 0.25 * SPIN / ARM
    wheel = dataclasses.replace(
        prior.wheel, dry=jnp.full_like(prior.wheel.dry, float(least))
    )
    nothing = np.zeros(NUM_DRAWS)
    params = of_rates(spec, np.full(NUM_DRAWS, np.e), nothing, active=False)
    posterior = make_posterior(spec, params, dataclasses.replace(prior, wheel=wheel))
    (reason,) = drag_reasons(spec, turning(), posterior)
    found = float(reason.split("probability is ")[1].split(",")[0])
    assert found == pytest.approx(0.3, abs=0.03)


def pinned(seed, *, has_wheel, num_rows=60):
    """A box on a pin without friction, and pushes of it, in our own engine."""
    rng = np.random.default_rng(seed)
    half = np.sort(rng.uniform(0.15, 0.4, 2))[::-1]
    mass = 20.0 * 4.0 * half[0] * half[1]
    anchor = 0.8 * half * rng.choice([-1.0, 1.0], 2)
    content = table_spec(
        shape={"type": "box", "half_extents": half.tolist()}, density=20.0
    ).to_dict()
    content["constraints"] = [
        {
            "type": "revolute",
            "a": "table",
            "b": "world",
            "anchor_a": anchor.tolist(),
            "anchor_b": anchor.tolist(),
        }
    ]
    if has_wheel:
        place = -0.5 * anchor
        heading = np.arctan2(*(place - anchor)[::-1]) + rng.uniform(-0.3, 0.3)
        content["constraints"].append(
            {
                "type": "wheel",
                "a": "table",
                "pose": [*place.tolist(), float(heading)],
                "viscous": [2.0 * mass, 60.0 * mass],
            }
        )
    spec = scene_spec_from_dict(content, source="test")
    held = rng.normal(size=(num_rows // 6, 1, 3)) * mass * [8.0, 8.0, 1.0]
    wrench = np.repeat(held, 6, axis=0)
    start = spec.initial_state()
    run, _ = rollout(spec.scene, spec.params(), start, jnp.asarray(wrench))
    truth = np.concatenate([np.asarray(start.array)[None], np.asarray(run.array)])
    scale = np.array([1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 5e-3])
    reading = truth + scale * rng.normal(size=truth.shape)
    history = make_history(reading[:-1], wrench, reading[1:], 0.02)
    return hide(spec), history


@pytest.mark.slow
def test_a_pinned_cart_is_not_said_to_have_no_wheel_for_certain():
    cases = [pinned(seed, has_wheel=has) for has in (True, False) for seed in (0, 1)]
    specs, histories = zip(*cases, strict=True)
    told = []
    for posterior, is_cart in zip(
        infer_batch(jax.random.key(0), specs, histories),
        (True, True, False, False),
        strict=True,
    ):
        weights = np.asarray(posterior.weights)
        has = np.asarray(posterior.params.wheel.active)[:, 0].any(axis=-1)
        said, diagnostics = float(weights @ has), posterior.diagnostics
        told.append(any("is drag" in reason for reason in diagnostics["reasons"]))
        if is_cart:
            assert said > 0.5 or not diagnostics["ok"], said
        else:
            assert said < 0.05
    assert any(told[:2])
    assert not any(told[2:])
