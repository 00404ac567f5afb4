"""Scores of runs against numbers worked out by hand."""

import json

import numpy as np
import pytest

from boomdp_jax.cli import main as cli
from boomdp_jax.core.json_file import write_json
from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.experiments.run import SCHEMA
from boomdp_jax.experiments.scores import (
    CART_MARKS,
    PUBLISHED,
    band_name,
    check_comparable,
    load_run,
    mark_step,
    mean_band,
    scores,
)

NOISE = [0.0025, 0.01, 0.01, 0.01]


def write_run(folder, agent, rewards, *, num_asked=None, task="cart", noise=None):
    """A run with these rewards, as `run` would have written it."""
    folder.mkdir()
    rewards = np.asarray(rewards, float)
    content = {"task": task, "agent": agent, "num_seeds": num_asked or len(rewards)}
    content |= {"schema": SCHEMA, "num_steps": rewards.shape[1], "noise": noise}
    write_json(folder / "run.json", content)
    for seed, reward in enumerate(rewards):
        is_done = reward == 0
        record = {
            "reward": reward,
            "action": np.where(is_done, -1, 0),
            "state": np.zeros((len(reward), 1, 6)),
            "model_error": np.where(is_done, np.nan, 0.1),
            "plan_seconds": np.where(is_done, 0.0, 0.02),
            "learn_seconds": np.where(is_done, 0.0, 0.03),
        }
        write_npz(folder / f"seed-{seed:05d}.npz", record)
    return folder


@pytest.fixture
def folders(tmp_path):
    known = [[-4.0, -2.0, 0.0, 0.0], [-4.0, -4.0, -2.0, 0.0]]
    learner = [[-4.0, -4.0, -2.0, 0.0], [-4.0, -4.0, -4.0, -2.0]]
    return [
        write_run(tmp_path / "physics", "physics", learner),
        write_run(tmp_path / "true", "true", known),
    ]


def test_a_mark_is_the_step_from_which_a_curve_stays_inside():
    curve = np.array([-100.0, -4.0, -50.0, -5.0, -0.5, 0.0])
    assert mark_step(curve, 0.05) == 4
    assert mark_step(curve, 0.01) == 5
    assert mark_step(curve, 1.0) == 1
    assert mark_step(curve[:3], 0.05) is None


def test_scores_by_hand(folders):
    best, second = scores([load_run(folder) for folder in folders])
    assert (best.agent, second.agent) == ("true", "physics")
    # Sums: -6 and -10; -10 and -14.
    assert (best.total, second.total) == (-8.0, -12.0)
    np.testing.assert_allclose(best.total_error, np.sqrt(8.0) / np.sqrt(2))
    assert best.regret == 0.0
    assert second.regret == 0.5
    assert best.marks == (4, 4, 4)
    assert second.marks == (None, None, None)
    assert (best.decision, best.learning) == (0.02, pytest.approx(0.03))


def test_without_the_true_agent_there_is_no_regret(folders):
    (score,) = scores([load_run(folders[0])])
    assert score.regret is None


def test_the_band_is_that_of_a_mean():
    rng = np.random.default_rng(3)
    values = rng.normal(2.0, 1.0, size=(200, 3))
    values[:, 2] = np.nan
    mean, low, high = mean_band(values)
    np.testing.assert_allclose(mean[:2], values.mean(axis=0)[:2])
    half = 1.96 * values.std(axis=0)[:2] / np.sqrt(200)
    np.testing.assert_allclose(high[:2] - mean[:2], half, rtol=0.15)
    np.testing.assert_allclose(mean[:2] - low[:2], half, rtol=0.15)
    assert np.all(np.isnan([mean[2], low[2], high[2]]))
    # An episode that is over does not count.
    values[50:, 0] = np.nan
    np.testing.assert_allclose(mean_band(values)[0][0], values[:50, 0].mean())


def test_few_episodes_that_are_left_of_many_have_no_band():
    values = np.random.default_rng(0).normal(size=(20, 3))
    values[5:, 1] = values[4:, 2] = np.nan
    mean, low, high = mean_band(values)
    assert np.isfinite(mean).all()
    assert (
        np.isfinite(low).tolist() == np.isfinite(high).tolist() == [True, True, False]
    )
    # What had few from the beginning has one all the same.
    assert np.isfinite(mean_band(values[:3])[1]).all()


def test_time_to_learn_is_that_of_an_episode_that_compiles_nothing(tmp_path):
    folder = write_run(tmp_path / "run", "physics", [[-1.0, -1.0, 0.0]] * 3)
    path = folder / "seed-00000.npz"
    record = read_npz(path)
    record["learn_seconds"] = np.array([100.0, 0.03, 0.0])
    write_npz(path, record)
    assert load_run(folder).learning == pytest.approx(0.03)
    nothing = write_run(tmp_path / "nothing", "physics", [[0.0, 0.0]])
    path = nothing / "seed-00000.npz"
    write_npz(path, read_npz(path) | {"plan_seconds": np.array([0.02, 0.0])})
    assert np.isnan(load_run(nothing).learning)


def test_published_curves_are_those_of_the_papers():
    true, physics = PUBLISHED["cart"][:2]
    assert (true.marks[0], physics.marks[0]) == (21, 27)
    np.testing.assert_allclose(physics.regret, 0.29, atol=0.005)
    np.testing.assert_allclose(np.array(CART_MARKS) * 370, [20, 5, 1])
    assert PUBLISHED["living-room"][1].marks == (166, 206, 252)


def test_runs_that_differ_are_not_put_side_by_side(folders, tmp_path):
    loaded = load_run(folders[0])
    noisy = write_run(tmp_path / "noisy", "true", [[-1.0, 0, 0, 0]], noise=NOISE)
    with pytest.raises(ValueError, match=r"expected cart of 4 steps.*got cart, noisy"):
        check_comparable([loaded, load_run(noisy)])
    louder = write_run(
        tmp_path / "louder", "true", [[-1.0, 0, 0, 0]], noise=[2 * n for n in NOISE]
    )
    with pytest.raises(ValueError, match=r"louder: noise: expected \(.*noisy, got \("):
        check_comparable([load_run(noisy), load_run(louder)])
    short = write_run(tmp_path / "short", "true", [[-1.0, 0.0]])
    with pytest.raises(ValueError, match=r"expected cart of 4 steps.*got cart of 2"):
        check_comparable([loaded, load_run(short)])


@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        ((5, 20), "95 % band"),
        ((2,), "bootstrap range of few seeds"),
        ((4, 1), "bootstrap range of few seeds"),
        ((20, 4), "95 % band; under 5 seeds bootstrap range"),
    ],
)
def test_bands_of_few_seeds_are_called_what_they_are(
    tmp_path, monkeypatch, counts, expected
):
    folders = [
        write_run(tmp_path / str(count), "physics", np.full((count, 3), -1.0))
        for count in counts
    ]
    assert band_name([load_run(folder) for folder in folders]) == expected
    pytest.importorskip("matplotlib")
    labels = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.savefig",
        lambda figure, *_, **__: labels.append(figure.axes[0].get_ylabel().split()),
    )
    assert cli.main(["plot", *map(str, folders)]) == 0
    assert labels == [f"mean reward of a step, {expected}".split()]


@pytest.mark.parametrize("options", ["", " --out new.png"])
def test_what_is_no_run_is_named(tmp_path, monkeypatch, capsys, options):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    where = {"nothere": "none there", ".": "one without run.json", "file": "a file"}
    for name, got in where.items():
        assert cli.main(f"plot {name}{options}".split()) == 2
        assert capsys.readouterr().err.splitlines() == [
            f"boomdp_jax: error: {name}: is not a run: expected a folder written by "
            f"`run`, got {got}"
        ]


def test_the_command_draws_and_tells(folders, capsys):
    pytest.importorskip("matplotlib")
    command = ["plot", *map(str, folders)]
    assert cli.main(command) == 0
    assert (folders[0] / "curves.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out.splitlines()
    assert said[2].split()[:4] == ["true", "2", "-8.0", "2.0"]
    assert said[3].split()[4] == "0.50"
    assert any("published: PBRL" in line and "0.29" in line for line in said)
    other = folders[0] / "other.pdf"
    assert cli.main([*command, "--json", "--out", str(other)]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["agent"] for line in lines] == ["true", "physics"]
    assert lines[1]["regret"] == 0.5
    assert other.exists()


def test_the_command_names_what_is_missing(folders, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    assert cli.main(["plot", str(tmp_path / "nowhere")]) == 2
    assert "nowhere" in capsys.readouterr().err
    (folders[0] / "seed-00000.npz").unlink()
    assert cli.main(["plot", str(folders[0]), "--out", str(tmp_path / "a.png")]) == 0
    for seed in folders[0].glob("seed-*.npz"):
        seed.unlink()
    assert cli.main(["plot", str(folders[0])]) == 2
    assert "expected at least one episode" in capsys.readouterr().err
