"""`simulate`: recordings that follow closed forms, episode by episode."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.cli.main import main
from boomdp_jax.core.history_file import load_transitions
from boomdp_jax.physics import rollout
from boomdp_jax.physics.scene_file import load_scene
from tests.inference.made_posteriors import make_posterior

DENSITY, HALF_EXTENTS, DT = 10.0, (0.5, 0.3), 0.02
MASS = DENSITY * 4 * HALF_EXTENTS[0] * HALF_EXTENTS[1]
INERTIA = MASS * (HALF_EXTENTS[0] ** 2 + HALF_EXTENTS[1] ** 2) / 3


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a free box beside a wall."""
    monkeypatch.chdir(tmp_path)
    scene = {
        "schema": "planar-scene-1",
        "gravity": [0, 0],
        "dt": DT,
        "bodies": [
            {
                "name": "wall",
                "pose": [9, 0, 0],
                "shape": {"type": "box", "half_extents": [0.1, 4]},
                "static": True,
            },
            {
                "name": "box",
                "pose": [1, 2, 0.5],
                "twist": [0.3, -0.1, 0.2],
                "shape": {"type": "box", "half_extents": list(HALF_EXTENTS)},
                "density": DENSITY,
            },
        ],
    }
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    return tmp_path


def _action(num_rows: int, wrench: tuple[float, float, float]) -> np.ndarray:
    action = np.zeros((num_rows, 2, 3))
    action[:, 1] = wrench
    return action


def _simulate(options: str = "") -> None:
    command = f"simulate scene.json --actions a.npz --out out.npz {options}"
    assert main(command.split()) == 0


def test_a_constant_wrench_accelerates_uniformly(folder: Path):
    np.savez("a.npz", action=_action(25, (3.0, -2.0, 0.4)))
    _simulate()
    table = load_transitions("out.npz", spec=load_scene("scene.json"))
    time = DT * np.arange(1, 26)[:, None]
    rate = np.array([3.0 / MASS, -2.0 / MASS, 0.4 / INERTIA])
    twist = np.array([0.3, -0.1, 0.2]) + rate * time
    pose = np.array([1, 2, 0.5]) + np.array([0.3, -0.1, 0.2]) * time
    np.testing.assert_allclose(table.next_state[:, 1, 3:], twist, rtol=1e-12)
    np.testing.assert_allclose(
        table.next_state[:, 1, :3], pose + rate * time**2 / 2, rtol=1e-10
    )
    np.testing.assert_array_equal(table.state[0, 1], [1, 2, 0.5, 0.3, -0.1, 0.2])
    np.testing.assert_array_equal(table.state[1:], table.next_state[:-1])
    np.testing.assert_array_equal(table.state[:, 0], table.next_state[:, 0])


def test_a_force_at_a_point_turns_the_box(folder: Path):
    arm = np.array([0.2, -0.1])
    point = np.zeros((1, 2, 2))
    point[0, 1] = np.array([1.0, 2.0]) + arm
    np.savez("a.npz", action=_action(1, (3.0, -2.0, 0.4)), point=point)
    _simulate()
    table = load_transitions("out.npz")
    torque = 0.4 + arm[0] * -2.0 - arm[1] * 3.0
    spin = 0.2 + DT * torque / INERTIA
    np.testing.assert_allclose(table.next_state[0, 1, 5], spin, rtol=1e-10)
    np.testing.assert_array_equal(table.point, point)
    # Read back, the recording holds the same wrench about the centre of mass.
    np.testing.assert_allclose(table.to_history().action[0, 1, 2], torque, rtol=1e-10)


def test_each_episode_starts_from_the_initial_state(folder: Path):
    start = np.array([[9.0, 0, 0, 0, 0, 0], [0, 0, 0, 1.0, 0, 0]])
    np.savez(
        "a.npz",
        action=_action(6, (0.0, 0.0, 0.0)),
        episode=np.array([0, 0, 0, 1, 1, 1]),
        initial_state=start,
        dt=np.array([0.02, 0.02, 0.02, 0.04, 0.04, 0.04]),
    )
    command = "simulate scene.json --actions a.npz --out out.npz"
    assert main(command.split()) == 0
    table = load_transitions("out.npz")
    np.testing.assert_allclose(
        table.next_state[:, 1, 0], [0.02, 0.04, 0.06, 0.04, 0.08, 0.12], rtol=1e-12
    )
    np.testing.assert_array_equal(table.state[[0, 3]], np.stack([start, start]))
    np.testing.assert_array_equal(table.episode, [0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(table.dt, [0.02, 0.02, 0.02, 0.04, 0.04, 0.04])


@pytest.mark.slow
def test_a_noisy_instant_is_read_once_and_episodes_start_afresh(folder: Path):
    num_rows = 4000
    episode = np.repeat([0, 1], num_rows // 2)
    np.savez("a.npz", action=_action(num_rows, (0.5, 0.2, 0.0)), episode=episode)
    _simulate()
    true = load_transitions("out.npz")
    _simulate("--noise 0.001 0.002 0.03 0.04 --seed 7")
    noisy = load_transitions("out.npz", spec=load_scene("scene.json"))
    is_start = np.isin(np.arange(num_rows), [0, num_rows // 2])
    previous = np.roll(noisy.next_state, 1, axis=0)
    np.testing.assert_array_equal(noisy.state[~is_start], previous[~is_start])
    assert np.all(noisy.state[is_start, 1] != true.state[is_start, 1])
    error = (noisy.next_state - true.next_state)[:, 1]
    scale = np.array([0.001, 0.001, 0.002, 0.03, 0.03, 0.04])
    # The relative error of a standard deviation is 1 / sqrt(2 n) = 1.1 %: five of these
    # in six channels is a false alarm in 300,000 runs.
    np.testing.assert_allclose(np.std(error, axis=0), scale, rtol=0.056)
    np.testing.assert_allclose(
        np.mean(error, axis=0) / scale, 0.0, atol=5 / np.sqrt(num_rows)
    )
    correlation = np.corrcoef(error.T) - np.eye(6)
    np.testing.assert_allclose(correlation, 0.0, atol=5 / np.sqrt(num_rows))


def test_the_same_seed_gives_the_same_file(folder: Path):
    np.savez("a.npz", action=_action(5, (0.5, 0.2, 0.1)))
    contents = []
    for seed in (3, 3, 4):
        _simulate(f"--noise 0.01 0.01 0.01 0.01 --seed {seed}")
        contents.append(Path("out.npz").read_bytes())
    assert contents[0] == contents[1] != contents[2]


def test_the_file_says_where_it_comes_from(folder: Path):
    np.savez("a.npz", action=_action(2, (0.5, 0.2, 0.1)))
    _simulate("--noise 0.1 0.1 0.1 0.1 --seed 3")
    origin = json.loads(load_transitions("out.npz").params)
    assert origin["seed"] == 3
    assert origin["noise"] == [0.1, 0.1, 0.1, 0.1]
    assert origin["scene"] == load_scene("scene.json").to_dict()
    assert "jax" in origin["versions"]


def test_another_step_length_is_told_on_standard_error(
    folder: Path, capsys: pytest.CaptureFixture
):
    np.savez("a.npz", action=_action(2, (0.5, 0.2, 0.1)), dt=0.05)
    _simulate()
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.splitlines() == [
        "boomdp_jax: warning: a.npz: dt: 0.05 s overrides the scene's 0.02 s"
    ]


def _change_scene(**fields) -> None:
    scene = json.loads(Path("scene.json").read_text())
    Path("scene.json").write_text(json.dumps(scene | fields))


def _notes(capsys: pytest.CaptureFixture) -> list[str]:
    lines = capsys.readouterr().err.splitlines()
    return [line.removeprefix("boomdp_jax: note: ") for line in lines]


def test_what_stands_in_for_unknown_numbers_is_told(
    folder: Path, capsys: pytest.CaptureFixture
):
    unknown = {"actuator": ["gain", "delay"], "center_of_mass": True, "wheel": 1}
    _change_scene(unknown=unknown)
    np.savez("a.npz", action=_action(2, (0.5, 0.2, 0.1)))
    _simulate()
    assert _notes(capsys) == [
        "scene.json: unknown constraints are taken to be absent",
        "scene.json: unknown.actuator.gain is taken to be 1",
        "scene.json: unknown.actuator.delay is taken to be 0 s",
        "scene.json: unknown.center_of_mass is taken to be where the pose is",
    ]


def test_what_stands_in_for_unknown_contact_is_told(
    folder: Path, capsys: pytest.CaptureFixture
):
    bodies = json.loads(Path("scene.json").read_text())["bodies"]
    bodies[0]["contact"] = {"friction": 0.3, "restitution": None}
    bodies[1]["contact"] = {"friction": None}
    # Refused afterwards, which spares the test a program with contact.
    del bodies[1]["density"]
    _change_scene(bodies=bodies)
    np.savez("a.npz", action=_action(1, (0.5, 0.2, 0.1)))
    assert main("simulate scene.json --actions a.npz --out out.npz".split()) == 2
    assert _notes(capsys)[:-1] == [
        "scene.json: body 'box': unknown contact.friction is taken to be 0.5",
        "scene.json: body 'wall': unknown contact.restitution is taken to be 0",
    ]


def test_a_start_off_a_joint_is_told(folder: Path, capsys: pytest.CaptureFixture):
    pin = {"type": "revolute", "a": "box", "b": "world", "anchor_a": [0, 0]}
    _change_scene(constraints=[pin | {"anchor_b": [1, 2]}])
    np.savez("a.npz", action=_action(2, (0.0, 0.0, 0.1)))
    _simulate()
    assert _notes(capsys) == []
    start = np.zeros((2, 6))
    start[1, :2] = [1.0, 7.0]
    np.savez("a.npz", action=_action(2, (0.0, 0.0, 0.1)), initial_state=start)
    _simulate()
    off = (
        "body 'box' starts 5 m off its pin to the world; the first step takes it there"
    )
    assert _notes(capsys) == [f"a.npz: initial_state: {off}"]
    table = load_transitions("out.npz")
    np.testing.assert_allclose(table.next_state[0, 1, :2], [1, 2], atol=1e-6)
    np.savez("a.npz", action=_action(2, (0.0, 0.0, 0.1)))
    _change_scene(constraints=[pin | {"anchor_b": [1, -3]}])
    _simulate()
    assert _notes(capsys) == [f"scene.json: pose: {off}"]


def test_a_start_outside_a_range_is_told(folder: Path, capsys: pytest.CaptureFixture):
    pin = {"type": "revolute", "a": "box", "b": "world", "anchor_a": [0, 0]}
    _change_scene(constraints=[pin | {"anchor_b": [1, 2], "lower": -0.5, "upper": 0.5}])
    start = np.zeros((2, 6))
    start[1, :3] = [1.0, 2.0, 0.6]
    np.savez("a.npz", action=_action(1, (0.0, 0.0, 0.0)), initial_state=start)
    _simulate()
    assert _notes(capsys) == [
        "a.npz: initial_state: body 'box' starts 0.1 rad outside the range of its pin "
        "to the world; the first step takes it there"
    ]
    table = load_transitions("out.npz")
    np.testing.assert_allclose(table.next_state[0, 1, 2], 0.5, atol=1e-6)


def test_a_prior_of_unknown_names_is_refused(
    folder: Path, capsys: pytest.CaptureFixture
):
    np.savez("a.npz", action=_action(1, (0.0, 0.0, 0.0)))
    command = "simulate scene.json --actions a.npz --out out.npz"
    _change_scene(prior={"nonsense": 1})
    assert main(command.split()) == 2
    error = capsys.readouterr().err
    assert "scene.json: prior: expected one of density" in error
    assert "got 'nonsense'" in error
    assert not Path("out.npz").exists()
    _change_scene(prior={"density": {"center": 20.0}})
    _simulate()


@pytest.mark.parametrize(("told", "expected"), [({}, 5), ({"substeps": 3}, 3)])
def test_a_draw_is_moved_in_the_parts_that_it_was_inferred_with(
    folder: Path, told: dict, expected: int
):
    spec = dataclasses.replace(load_scene("scene.json"), substeps=5)
    draws = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), spec.params())
    make_posterior(spec, draws, draws).save("post.npz")
    np.savez("a.npz", action=_action(2, (0.5, 0.2, 0.1)))
    _change_scene(**told)
    _simulate("--posterior post.npz")
    origin = json.loads(str(np.load("out.npz")["params"]))
    assert origin["scene"]["substeps"] == expected


def test_a_posterior_of_another_outline_is_refused(
    folder: Path, capsys: pytest.CaptureFixture
):
    spec = load_scene("scene.json")
    draws = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), spec.params())
    make_posterior(spec, draws, draws).save("post.npz")
    np.savez("a.npz", action=_action(2, (0.5, 0.2, 0.1)))
    _simulate("--posterior post.npz --draw 1")
    Path("out.npz").unlink()
    bodies = json.loads(Path("scene.json").read_text())["bodies"]
    bodies[1]["shape"]["half_extents"] = [5, 3]
    _change_scene(bodies=bodies)
    command = "simulate scene.json --actions a.npz --out out.npz --posterior post.npz"
    assert main(command.split()) == 2
    assert capsys.readouterr().err.splitlines() == [
        "boomdp_jax: error: post.npz: body 'box': shape.half_extents: expected "
        "[5.0, 3.0], as in scene.json, got [0.5, 0.3]"
    ]
    assert not Path("out.npz").exists()


def test_a_missing_start_is_refused(folder: Path, capsys: pytest.CaptureFixture):
    scene = Path("scene.json").read_text().replace('"pose": [1, 2, 0.5], ', "")
    Path("scene.json").write_text(scene)
    np.savez("a.npz", action=_action(2, (0.5, 0.2, 0.1)))
    assert main("simulate scene.json --actions a.npz --out out.npz".split()) == 2
    assert "body 'box': pose: expected a pose" in capsys.readouterr().err
    assert not Path("out.npz").exists()


def test_a_motion_that_overflows_is_refused(
    folder: Path, capsys: pytest.CaptureFixture
):
    np.savez("a.npz", action=_action(3, (1e308, 1e308, 0.0)), dt=1e3)
    assert main("simulate scene.json --actions a.npz --out out.npz".split()) == 2
    assert "body 'box': expected a motion that stays finite" in capsys.readouterr().err
    assert not Path("out.npz").exists()


@pytest.mark.slow
def test_bodies_in_contact_move_as_in_a_rollout(folder: Path):
    scene = json.loads(Path("scene.json").read_text())
    scene["gravity"] = [0, -9.81]
    scene["bodies"][0] |= {"pose": [0, -0.1, 0], "contact": {"friction": 0.4}}
    scene["bodies"][0]["shape"]["half_extents"] = [4, 0.1]
    scene["bodies"][1] |= {"pose": [0, 0.3, 0], "twist": [1.0, 0.0, 0.0]}
    Path("scene.json").write_text(json.dumps(scene))
    action = _action(30, (0.0, 0.0, 0.0))
    np.savez("a.npz", action=action)
    _simulate()
    spec = load_scene("scene.json")
    table = load_transitions("out.npz", spec=spec)
    states, _ = rollout(
        spec.scene, spec.params(), spec.initial_state(), jnp.asarray(action)
    )
    np.testing.assert_allclose(table.next_state[..., :3], states.pose, atol=1e-9)
    np.testing.assert_allclose(table.next_state[..., 3:], states.twist, atol=1e-9)


@pytest.mark.parametrize(("rate", "parts"), [(5.0, None), (25.0, 4)])
def test_steps_are_cut_by_how_far_a_body_turns(folder: Path, capsys, rate, parts):
    scene = json.loads((folder / "scene.json").read_text())
    scene["bodies"][1]["twist"] = [0.0, 0.0, rate]
    (folder / "scene.json").write_text(json.dumps(scene))
    np.savez("a.npz", action=_action(10, (3.0, -2.0, 0.0)))
    _simulate()
    said = f"steps are made in {parts} parts for how far bodies turn in one"
    assert (said in capsys.readouterr().err) == (parts is not None)
    origin = json.loads(str(np.load("out.npz")["params"]))
    assert origin["scene"].get("substeps") == parts
    # What a scene says goes first.
    scene["substeps"] = 3
    (folder / "scene.json").write_text(json.dumps(scene))
    _simulate()
    assert "parts" not in capsys.readouterr().err
    assert json.loads(str(np.load("out.npz")["params"]))["scene"]["substeps"] == 3
