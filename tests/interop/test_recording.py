"""MuJoCo recordings obey the closed forms of what their scenes say."""

import dataclasses
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from boomdp_jax.interop.mjcf import RecordingLaws
from boomdp_jax.interop.object_families import (
    FAMILIES,
    hide,
    random_object,
    record_random_pushes,
)
from boomdp_jax.interop.recording import READING_NOISE, record, with_reading_noise
from boomdp_jax.physics import State, step
from boomdp_jax.physics.scene_spec import scene_spec_from_dict

HALF = (0.3, 0.2)
DENSITY = 20.0
MASS = DENSITY * 4 * HALF[0] * HALF[1]
INERTIA = MASS * (HALF[0] ** 2 + HALF[1] ** 2) / 3
GRAVITY = 9.81


def scene(*constraints, gravity=(0.0, 0.0), pose=(0.1, -0.2, 0.5)):
    """A known box with the given constraints."""
    body = {
        "name": "object",
        "shape": {"type": "box", "half_extents": list(HALF)},
        "pose": list(pose),
        "density": DENSITY,
    }
    content = {
        "schema": "planar-scene-1",
        "gravity": list(gravity),
        "dt": 0.02,
        "bodies": [body],
        "constraints": [{"a": "object", **c} for c in constraints],
    }
    return scene_spec_from_dict(content)


def pin(anchor=(-0.25, 0.1), point=(0.3, 0.4), **friction):
    return {
        "type": "revolute",
        "b": "world",
        "anchor_a": list(anchor),
        "anchor_b": list(point),
        **friction,
    }


def anchor_places(table, anchor):
    """World place of a body point before and after every step."""
    state = np.concatenate([table.state[:, 0], table.next_state[-1:, 0]])
    cos, sin = np.cos(state[:, 2]), np.sin(state[:, 2])
    x = state[:, 0] + cos * anchor[0] - sin * anchor[1]
    y = state[:, 1] + sin * anchor[0] + cos * anchor[1]
    return np.column_stack([x, y])


def test_free_box_obeys_newton_and_euler():
    wrench = np.array([2.0, -1.0, 0.3])
    table = record(scene(), np.tile(wrench, (50, 1)))
    acceleration = wrench / [MASS, MASS, INERTIA]
    time = 0.02 * np.arange(1, 51)[:, None]
    expected = np.array([0.1, -0.2, 0.5]) + 0.5 * acceleration * time**2
    np.testing.assert_allclose(table.next_state[:, 0, :3], expected, atol=1e-9)
    np.testing.assert_allclose(
        table.next_state[:, 0, 3:], acceleration * time, atol=1e-9
    )


def test_free_box_keeps_its_twist_after_a_push():
    wrenches = np.zeros((60, 3))
    wrenches[:10] = [1.0, 2.0, 0.5]
    table = record(scene(), wrenches)
    twist = table.next_state[9, 0, 3:]
    assert np.all(np.abs(twist) > 0.01)
    np.testing.assert_allclose(table.next_state[10:, 0, 3:], np.tile(twist, (50, 1)))


def test_free_box_falls_under_gravity_in_the_plane():
    table = record(scene(gravity=(0.0, -GRAVITY)), np.zeros((25, 3)))
    assert table.next_state[-1, 0, 1] == pytest.approx(-0.2 - 0.5 * GRAVITY * 0.25)


@pytest.mark.parametrize("viscous", [0.0, 0.4])
def test_pinned_box_swings_as_a_physical_pendulum(viscous):
    anchor, point = np.array([0.0, 0.15]), np.array([0.3, 0.4])
    truth = scene(pin(anchor, point, viscous=viscous), gravity=(0.0, -GRAVITY))
    table = record(truth, np.zeros((100, 3)), start=np.array([[0.0, 0.0, 0.8]]))
    arm, inertia = 0.15, INERTIA + MASS * 0.15**2

    def derivative(_, y):
        torque = -MASS * GRAVITY * arm * np.sin(y[0]) - viscous * y[1]
        return [y[1], torque / inertia]

    times = 0.02 * np.arange(1, 101)
    path = solve_ivp(
        derivative, (0, 2.0), [0.8, 0.0], t_eval=times, rtol=1e-10, atol=1e-12
    ).y
    np.testing.assert_allclose(table.next_state[:, 0, 2], path[0], atol=1e-6)
    np.testing.assert_allclose(table.next_state[:, 0, 5], path[1], atol=1e-5)
    centre = point + arm * np.column_stack([np.sin(path[0]), -np.cos(path[0])])
    np.testing.assert_allclose(table.next_state[:, 0, :2], centre, atol=1e-6)


def test_period_of_small_swings_is_that_of_the_physical_pendulum():
    truth = scene(pin((0.0, 0.15)), gravity=(0.0, -GRAVITY))
    table = record(truth, np.zeros((200, 3)), start=np.array([[0.0, 0.0, 0.01]]))
    angle = table.next_state[:, 0, 2]
    down = np.flatnonzero((angle[:-1] > 0) & (angle[1:] <= 0))
    crossing = down + angle[down] / (angle[down] - angle[down + 1])
    period = 0.02 * np.mean(np.diff(crossing))
    expected = 2 * np.pi * np.sqrt((INERTIA + MASS * 0.15**2) / (MASS * GRAVITY * 0.15))
    assert period == pytest.approx(expected, rel=2e-4)


@pytest.mark.parametrize("law", ["hinge", "connect"])
def test_pin_holds_within_a_tenth_of_a_millimetre_under_load(law):
    rng = np.random.default_rng(0)
    wrenches = np.repeat(rng.uniform(-1, 1, (20, 3)) * [30.0, 30.0, 4.0], 10, axis=0)
    anchor, point = (-0.25, 0.1), (0.3, 0.4)
    table = record(scene(pin(anchor, point)), wrenches, laws=RecordingLaws(pin=law))
    assert np.ptp(table.next_state[:, 0, 2]) > 0.5
    drift = np.hypot(*(anchor_places(table, anchor) - point).T)
    assert np.max(drift) < 1e-4


def test_dry_joint_friction_holds_small_torques_and_brakes_by_its_limit():
    limit = 0.5
    truth = scene(pin(dry=limit))
    wrenches = np.zeros((100, 3))
    wrenches[:50, 2], wrenches[50:, 2] = 0.8 * limit, 1.6 * limit
    table = record(truth, wrenches)
    assert np.max(np.abs(table.next_state[:50, 0, 5])) < 2e-3
    inertia = INERTIA + MASS * (0.25**2 + 0.1**2)
    gain = table.next_state[-1, 0, 5] - table.state[60, 0, 5]
    assert gain == pytest.approx(0.6 * limit / inertia * 0.8, rel=5e-3)


@pytest.mark.slow
def test_engine_converges_to_a_recorded_cart_at_second_order():
    wheel = {"type": "wheel", "pose": [-0.12, -0.02, 0.05], "viscous": [4.0, 80.0]}
    truth = scene(wheel)
    rng = np.random.default_rng(6)
    table = record_random_pushes(rng, truth, 40, num_episodes=2)
    errors = []
    for num_substeps in (2, 4):
        world = dataclasses.replace(truth.scene, num_substeps=num_substeps)

        def advance(state, wrench, world=world):
            start = State(pose=state[:, :3], twist=state[:, 3:])
            return step(world, truth.params(), start, wrench)[0].array

        ends = jax.jit(jax.vmap(advance))(
            jnp.asarray(table.state), jnp.asarray(table.action)
        )
        errors.append(np.sqrt(np.mean((np.asarray(ends) - table.next_state) ** 2)))
    assert errors[0] < 5e-4
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def sliding_box(truth, direction, *, laws=None, num_coast=40):
    """Push along a direction for 0.2 s, then let it coast; speeds when coasting."""
    wrenches = np.zeros((10 + num_coast, 3))
    wrenches[:10, :2] = 60.0 * np.asarray(direction)
    table = record(truth, wrenches, laws=laws)
    return table.next_state[10:, 0, 3:5] @ direction


@pytest.mark.parametrize("is_lateral", [False, True])
def test_viscous_wheel_lets_speed_decay_exponentially(is_lateral):
    angle = 0.5 + 0.7
    viscous = (2.0, 12.0)
    wheel = {"type": "wheel", "pose": [0.0, 0.0, 0.7], "viscous": list(viscous)}
    along = np.array([np.cos(angle), np.sin(angle)])
    direction = np.array([-along[1], along[0]]) if is_lateral else along
    speed = sliding_box(scene(wheel), direction)
    decay = np.exp(-viscous[is_lateral] / MASS * 0.02 * np.arange(40))
    np.testing.assert_allclose(speed, speed[0] * decay, rtol=1e-6)
    assert speed[0] > 0.1


@pytest.mark.parametrize("law", ["force", "contacts"])
@pytest.mark.parametrize("is_lateral", [False, True])
def test_dry_wheel_slows_down_linearly(law, is_lateral):
    angle = 0.5 + 0.7
    limits = (1.0, 6.0)
    wheel = {"type": "wheel", "pose": [0.0, 0.0, 0.7], "dry": list(limits)}
    along = np.array([np.cos(angle), np.sin(angle)])
    direction = np.array([-along[1], along[0]]) if is_lateral else along
    speed = sliding_box(scene(wheel), direction, laws=RecordingLaws(wheel=law))
    slide = speed[:15]
    assert slide[-1] > 0.2
    deceleration = -np.polyfit(0.02 * np.arange(15), slide, 1)[0]
    # MuJoCo's contacts chatter when they slide; a limited force does not.
    tolerance = 0.05 if law == "contacts" else 1e-6
    assert deceleration == pytest.approx(limits[is_lateral] / MASS, rel=tolerance)


def test_stiff_wheel_off_centre_turns_a_pushed_cart_towards_its_rolling_line():
    wheel = {"type": "wheel", "pose": [-0.2, 0.0, 0.0], "viscous": [0.0, 800.0]}
    wrenches = np.tile([0.0, 2.0, 0.0], (50, 1))
    table = record(scene(wheel, pose=(0.0, 0.0, 0.0)), wrenches)
    state = table.next_state[10:, 0]
    sideways = -np.sin(state[:, 2]) * state[:, 3] + np.cos(state[:, 2]) * state[:, 4]
    at_wheel = sideways - 0.2 * state[:, 5]
    assert np.max(np.abs(at_wheel)) < 0.01 * np.max(np.abs(sideways))


@pytest.mark.parametrize("law", ["feet", "joints"])
def test_floor_friction_brakes_a_sliding_box_and_holds_a_light_push(law):
    friction = 0.3
    truth = scene({"type": "ground", "dry": friction}, pose=(0.0, 0.0, 0.0))
    laws = RecordingLaws(ground=law)
    speed = sliding_box(truth, np.array([1.0, 0.0]), laws=laws)
    slide = speed[speed > 0.2]
    assert len(slide) >= 20
    deceleration = -np.polyfit(0.02 * np.arange(len(slide)), slide, 1)[0]
    # MuJoCo's contacts chatter when they slide: a few per cent over half a second.
    assert deceleration == pytest.approx(friction * GRAVITY, rel=0.04)
    light = np.tile([0.7 * friction * MASS * GRAVITY, 0.0, 0.0], (50, 1))
    table = record(truth, light, laws=laws)
    assert np.abs(table.next_state[-1, 0, 0] - table.state[0, 0, 0]) < 2e-3


def test_episodes_start_from_rest_and_rows_follow_each_other():
    episode = np.repeat([0, 1, 2], 20)
    start = np.array([[0.0, 0.0, 0.1], [1.0, 0.0, 0.2], [0.0, 1.0, 0.3]])
    table = record(scene(), np.ones((60, 3)), episode=episode, start=start)
    np.testing.assert_allclose(table.state[::20, 0, :3], start, atol=1e-12)
    assert np.all(table.state[::20, 0, 3:] == 0)
    history = table.to_history()
    expected = np.tile([False] + [True] * 19, 3)
    np.testing.assert_array_equal(np.asarray(history.is_chained), expected)


@pytest.mark.parametrize("is_chained", [True, False])
def test_reading_noise_has_the_stated_scale_and_is_read_once_or_twice(is_chained):
    table = record(scene(), np.zeros((2000, 3)))
    rng = np.random.default_rng(1)
    noisy = with_reading_noise(rng, table, is_chained=is_chained)
    error = (noisy.next_state - table.next_state)[:, 0]
    scale = np.array(READING_NOISE)[[0, 0, 1, 2, 2, 3]]
    # Sd of 2,000 draws: 1.6 % of it; four of these are passed once in 3,000 runs.
    np.testing.assert_allclose(np.std(error, axis=0), scale, rtol=4 * 0.016)
    correlation = np.corrcoef((noisy.state - table.state)[1:, 0, 0], error[:-1, 0])[
        0, 1
    ]
    assert correlation > 0.999 if is_chained else abs(correlation) < 0.1


@pytest.mark.parametrize("family", FAMILIES)
def test_random_objects_move_at_walking_pace(family):
    rng = np.random.default_rng(2)
    truth = random_object(rng, family)
    table = record_random_pushes(rng, truth, 100, num_episodes=2)
    assert np.all(np.isfinite(table.next_state))
    speed = np.hypot(table.next_state[..., 3], table.next_state[..., 4])
    fastest = speed + truth.bodies[0].reach * np.abs(table.next_state[..., 5])
    assert 0.1 < np.sqrt(np.mean(fastest**2)) < 1.5
    assert 5.0 <= truth.bodies[0].density <= 100.0


def test_hidden_scene_tells_neither_density_nor_constraints():
    truth = random_object(np.random.default_rng(3), "floor table")
    hidden = hide(truth)
    assert hidden.bodies[0].density is None
    assert hidden.constraints == ()
    caps = {kind: cap for kind, cap in hidden.unknown.items() if cap}
    assert caps == {"revolute": 1, "wheel": 1, "ground": 1}
    np.testing.assert_array_equal(hidden.bodies[0].outline, truth.bodies[0].outline)


def test_two_recordings_agree_bit_for_bit():
    truth = random_object(np.random.default_rng(4), "floor box")
    tables = [
        record_random_pushes(np.random.default_rng(5), truth, 20, num_episodes=2)
        for _ in range(2)
    ]
    np.testing.assert_array_equal(tables[0].next_state, tables[1].next_state)


def test_unknown_family_is_refused_by_name():
    with pytest.raises(ValueError, match=r"expected one of box, table.*got sofa"):
        random_object(np.random.default_rng(0), "sofa")


def test_scene_of_two_bodies_is_refused():
    content = scene().to_dict()
    content["bodies"].append({**content["bodies"][0], "name": "other"})
    with pytest.raises(ValueError, match="expected one body, got 2"):
        record(scene_spec_from_dict(content), np.zeros((1, 3)))


def test_two_pins_are_refused():
    truth = scene(pin(), pin((0.1, 0.1)))
    with pytest.raises(ValueError, match="expected at most 1 revolute, got 2"):
        record(truth, np.zeros((1, 3)))


def test_time_step_must_divide_the_record_step():
    with pytest.raises(ValueError, match=r"divides dt = 0\.02 s, got 0\.0007"):
        record(scene(), np.zeros((1, 3)), laws=RecordingLaws(time_step=0.0007))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"wrenches": [[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]},
            r"^wrenches: expected finite numbers, got \[0\.0, nan, 0\.0\] in row 1$",
        ),
        (
            {"wrenches": np.zeros((4, 2))},
            r"^wrenches: expected shape \[time, 3\], got \(4, 2\)$",
        ),
        (
            {"wrenches": np.zeros(3)},
            r"^wrenches: expected shape \[time, 3\], got \(3,\)$",
        ),
        ({"episode": [0, 0, 1]}, r"^episode: expected shape \(4,\), got \(3,\)$"),
        (
            {"episode": [0, 1, 0, 1]},
            "^episode: expected the rows of an episode to follow each other, got one",
        ),
        (
            {"episode": [0, 0, 1, 1], "start": np.zeros((1, 3))},
            r"^start: expected shape \(2, 3\), got \(1, 3\)$",
        ),
        (
            {"start": [[0.0, np.inf, 0.0]]},
            r"^start: expected finite numbers, got \[0\.0, inf, 0\.0\] in row 0$",
        ),
    ],
)
@pytest.mark.usefixtures("no_type_checks")
def test_pushes_that_do_not_fit_each_other_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        record(scene(), **({"wrenches": np.zeros((4, 3))} | changes))


@pytest.mark.usefixtures("no_type_checks")
def test_only_the_angle_of_a_pinned_start_has_to_be_known():
    table = record(scene(pin()), np.zeros((1, 3)), start=[[np.nan, np.nan, 0.3]])
    assert table.state[0, 0, 2] == pytest.approx(0.3)


def test_recording_in_which_mujoco_starts_afresh_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into a file there.
    wrenches = np.zeros((4, 3))
    wrenches[2, 0] = 1e30
    message = r"^wrenches: .* MuJoCo is stable, got \[1e\+30, 0\.0, 0\.0\] in row 2,"
    with pytest.raises(RuntimeError, match=message):
        record(scene(), wrenches)


@pytest.mark.parametrize(
    ("scale", "got"),
    [
        (0.1, r"shape \(\)"),
        ((0.1, 0.1, 0.1), r"shape \(3,\)"),
        ((0.1, 0.1, 0.1, -0.1), r"\[0\.1, 0\.1, 0\.1, -0\.1\]"),
        ((0.1, np.nan, 0.1, 0.1), r"\[0\.1, nan, 0\.1, 0\.1\]"),
    ],
)
@pytest.mark.usefixtures("no_type_checks")
def test_reading_noise_is_four_finite_numbers(scale, got):
    table = record(scene(), np.zeros((1, 3)))
    message = f"^scale: expected four finite numbers, at least 0, got {got}$"
    with pytest.raises(ValueError, match=message):
        with_reading_noise(np.random.default_rng(0), table, scale)


def test_missing_mujoco_is_named_with_its_cure(monkeypatch):
    def no_mujoco(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", no_mujoco)
    with pytest.raises(ImportError, match=r"pip install 'boomdp_jax\[test\]'"):
        record(scene(), np.zeros((1, 3)))
