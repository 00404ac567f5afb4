"""Velocities computed from poses: which recordings are named, and which are not."""

import functools

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_filter

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.doubts.derived_velocities import derived_velocity_reasons
from boomdp_jax.inference.doubts.velocity_doubts import velocity_reasons
from boomdp_jax.inference.kinds.verdict import with_kind_doubts
from tests.inference.doubts.test_pose_velocity_agreement import (
    differenced,
    pushed,
    read,
    states_of,
)
from tests.inference.made_posteriors import table_posterior
from tests.inference.recordings import DT, NOISE, box_scene
from tests.inference.residual_worlds import dry, nothing_else, viscous

NOISES = {
    "exact": 0.0 * NOISE,
    "usual": NOISE,
    "poses": NOISE * [1, 1, 1, 0, 0, 0],
    "velocities": NOISE * [0, 0, 0, 1, 1, 1],
}


def history_of(states, dt=DT, **options):
    rows = states[:, None]
    action = np.zeros((len(rows) - 1, 1, 3))
    return make_history(rows[:-1], action, rows[1:], dt, **options)


_scene = functools.cache(box_scene)


def reasons_of(states, dt=DT, **options):
    return derived_velocity_reasons(_scene(), history_of(states, dt, **options))


def gradient(pose):
    return np.gradient(pose, DT, axis=0), pose


def forward(pose):
    return np.diff(pose, axis=0, append=pose[-1:]) / DT, pose


def spline(pose):
    time = DT * np.arange(len(pose))
    return CubicSpline(time, pose)(time, 1), pose


def filtered(length, order, *, both=False):
    """Slopes of polynomials, which may smooth the poses as well."""

    def derive(pose):
        velocity = savgol_filter(pose, length, order, deriv=1, delta=DT, axis=0)
        return velocity, savgol_filter(pose, length, order, axis=0) if both else pose

    return derive


DERIVED = {
    "gradient": gradient,
    "forward": forward,
    "spline": spline,
    "cubic of 5": filtered(5, 3),
    "parabola of 7": filtered(7, 2),
    "parabola of 11": filtered(11, 2),
    "smoothed by a parabola of 7": filtered(7, 2, both=True),
    "smoothed by a cubic of 9": filtered(9, 3, both=True),
}


def derived(states, way):
    velocity, pose = DERIVED[way](states[:, :3])
    return np.concatenate([pose, velocity], axis=1)


def in_single_precision(states):
    return states.astype(np.float32).astype(float)


def in_four_digits(states):
    return np.round(states, 4)


def unchanged(states):
    return states


def _slow(value):
    return pytest.param(value, marks=pytest.mark.slow)


WRITTEN = [unchanged, in_single_precision, in_four_digits]


def swung(rng, num, rate):
    """A point of a body that swings freely about a pin, read exactly."""
    phase = rate * DT * np.arange(num + 1) + rng.normal()
    angle, spin = 0.8 * np.sin(phase), 0.8 * rate * np.cos(phase)
    sin, cos = 0.3 * np.sin(angle), 0.3 * np.cos(angle)
    return np.column_stack([cos, sin, angle, -sin * spin, cos * spin, spin])


@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("noise", NOISES)
def test_measured_velocities_are_not_named(written, noise):
    for seed, num in enumerate((12, 20, 60, 200)):
        states = pushed(seed, num, dry(6.0), NOISES[noise], hold=5)
        assert reasons_of(written(states)) == []


@pytest.mark.slow
@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("force", [nothing_else, viscous(6.0), dry(6.0)])
@pytest.mark.parametrize("hold", [1, 5, 1000])
def test_measured_velocities_of_other_motions_pass(written, noise, force, hold):
    for seed, num in enumerate((12, 20, 60, 200), 4):
        states = pushed(seed, num, force, NOISES[noise], hold=hold)
        assert reasons_of(written(states)) == []


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("rate", [_slow(1.0), 10.0, _slow(60.0)])
def test_swings_and_rest_are_not_named(noise, rate):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        for still in (1.0, 0.0):
            states = read(rng, still * swung(rng, 80, rate), NOISES[noise])
            for written in WRITTEN:
                assert reasons_of(written(states)) == []


@pytest.mark.parametrize("noise", NOISES)
def test_constant_speeds_and_one_impact_are_not_named(noise):
    """Of so little that is irregular, any few weights explain all."""
    for seed in range(8):
        rng = np.random.default_rng(seed)
        velocity, time = rng.normal(size=3), DT * np.arange(41)[:, None]
        after = velocity + (rng.normal(size=3) if seed % 2 else 0.0)
        hit = DT * rng.uniform(10, 30)
        pose = velocity * np.minimum(time, hit) + after * np.maximum(time - hit, 0.0)
        twist = np.where(time < hit, velocity, after)
        states = read(rng, np.concatenate([pose, twist], axis=1), NOISES[noise])
        for written in WRITTEN:
            assert reasons_of(written(states)) == []


@pytest.mark.parametrize("way", DERIVED)
@pytest.mark.parametrize("hold", [_slow(1), 5])
def test_velocities_computed_from_poses_are_named(way, hold):
    for seed in range(3):
        states = derived(pushed(seed, 80, hold=hold), way)
        for written in WRITTEN[:2]:
            (reason,) = reasons_of(written(states))
            assert reason.startswith(
                "box: velocities and angular velocities repeat the noise of positions "
                "and angles, as what is computed from them does"
            )
            assert reason.endswith("leave velocities out (NaN)")


@pytest.mark.parametrize("way", ["gradient", "forward", "parabola of 7"])
def test_poses_without_noise_tell_it_too(way):
    """By what pushes change."""
    states = derived(pushed(0, 80, noise=NOISES["exact"]), way)
    assert len(reasons_of(states)) == 1


def test_an_angle_alone_is_named():
    states = pushed(0, 80)
    states[:, 5] = derived(states, "gradient")[:, 5]
    (reason,) = reasons_of(states)
    assert reason.startswith("box: angular velocities repeat the noise of angles, as")


def test_runs_and_wrapped_angles():
    """Each run is for itself, with formulas of their own at either end."""
    parts = [derived(pushed(seed, 20), "gradient") for seed in range(4)]
    for part in parts:
        part[:, 2] = np.angle(np.exp(1j * (part[:, 2] + np.pi)))
    first = np.concatenate([part[:-1] for part in parts])[:, None]
    last = np.concatenate([part[1:] for part in parts])[:, None]
    action, episode = np.zeros((80, 1, 3)), np.arange(80) // 20
    history = make_history(first, action, last, DT, episode=episode)
    assert len(derived_velocity_reasons(box_scene(), history)) == 1


@pytest.mark.parametrize("noise", NOISES)
def test_uneven_steps(noise):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        dt = DT * rng.uniform(0.5, 1.5, 60)
        states = read(rng, states_of(rng, dt), NOISES[noise])
        assert reasons_of(states, dt) == []
        time = np.append(0.0, np.cumsum(dt))
        states[:, 3:] = np.gradient(states[:, :3], time, axis=0)
        assert len(reasons_of(states, dt)) == 1


def test_what_was_not_read_or_is_too_little_is_not_named():
    states = derived(pushed(0, 80), "gradient")
    poses = np.array(states)
    poses[:, 3:] = np.nan
    assert reasons_of(poses) == []
    in_turn = np.array(states)
    in_turn[::2, 3:] = np.nan
    assert reasons_of(in_turn) == []
    assert reasons_of(states[:8], capacity=64) == []


def along_own_axes(states):
    angle, velocity = states[:, 2], states[:, 3:5]
    turn = np.exp(-1j * angle) * (velocity[:, 0] + 1j * velocity[:, 1])
    turned = np.column_stack([turn.real, turn.imag, states[:, 5]])
    return np.concatenate([states[:, :3], turned], axis=1)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("noise", ["exact", "usual"])
def test_velocities_along_the_own_axes_are_named(seed, noise):
    states = pushed(seed, noise=NOISES[noise])
    states[:, 2] += 1.0
    history = history_of(along_own_axes(states))
    (reason,) = velocity_reasons(box_scene(), history)
    assert reason.startswith("box: velocities turned by its angle fit how positions")
    assert velocity_reasons(box_scene(), history_of(states)) == []


def test_each_body_is_named_once_and_kinds_are_doubted_too():
    posterior = table_posterior(8, diagnostics={"ok": True, "reasons": []})
    states, turned = pushed(0, 80), np.array([0, 0, 1, 0, 0, 0])
    for made, start in (
        (derived(states, "gradient"), "velocities and angular velocities repeat the"),
        (differenced(states), "velocities and angular velocities look like"),
        (along_own_axes(states + turned), "velocities turned by its angle fit"),
    ):
        doubted = with_kind_doubts(posterior, history_of(made), [], None).diagnostics
        assert not doubted["ok"]
        (reason,) = doubted["reasons"]
        assert reason.startswith(f"{posterior.spec.names[0]}: {start}")
