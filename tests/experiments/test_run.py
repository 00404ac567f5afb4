"""Runs in a folder: resumed to the same bits, shared between shards, never mixed."""

import re

import jax
import numpy as np
import pytest

from boomdp_jax.agents import run_episode
from boomdp_jax.cli import main as cli
from boomdp_jax.core.npz_file import read_npz
from boomdp_jax.envs import CART_WORLDS
from boomdp_jax.experiments import (
    AGENTS,
    CHARACTERS,
    TASKS,
    agent_of,
    begin_run,
    make_task,
)
from boomdp_jax.experiments.scores import load_run

STEPS = 6


def begin(folder, **options):
    settings = {"num_seeds": 3, "num_steps": STEPS, **options}
    return begin_run("pendulum", "random", folder, **settings)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    run = begin(tmp_path_factory.mktemp("whole"))
    run.run_seeds(run.missing())
    return run, run.collect()


@pytest.mark.slow
def test_results_have_a_row_for_each_seed(whole):
    run, results = whole
    assert results["reward"].shape == (3, STEPS)
    assert results["state"].shape == (3, STEPS, 1, 6)
    assert np.all(results["reward"] < 0)
    assert np.ptp(results["reward"][:, 0]) > 1e-3
    stored = read_npz(run.folder / "results.npz")
    for field, values in results.items():
        np.testing.assert_array_equal(stored[field], values)


@pytest.mark.slow
def test_a_run_goes_on_to_the_same_bits(whole, tmp_path):
    _, results = whole
    run = begin(tmp_path)
    run.run_seeds([1])
    # A file that a killed process was writing is not one of the run's.
    (tmp_path / ".seed-00000.npz.0123.part").write_bytes(b"half")
    again = begin(tmp_path)
    assert again.missing() == [0, 2]
    assert again.collect() is None
    again.run_seeds(again.missing())
    resumed = again.collect()
    for field in ("reward", "action", "state", "model_error"):
        np.testing.assert_array_equal(resumed[field], results[field])


@pytest.mark.slow
def test_shards_share_the_work(whole, tmp_path):
    _, results = whole
    for place in (1, 0):
        run = begin(tmp_path)
        seeds = run.missing((place, 2))
        assert seeds == list(range(place, 3, 2))
        run.run_seeds(seeds)
    np.testing.assert_array_equal(run.collect()["reward"], results["reward"])
    with pytest.raises(ValueError, match=r"shard: expected 0 <= place < number"):
        run.missing((2, 2))


def test_more_seeds_are_added_and_none_is_taken_away(whole, tmp_path):
    _, results = whole
    run = begin(tmp_path, num_seeds=1)
    run.run_seeds(run.missing())
    run.collect()
    before = run.path(0).stat().st_mtime_ns
    more = begin(tmp_path)
    assert more.missing() == [1, 2]
    assert load_run(tmp_path).num_asked == 3
    more.run_seeds(more.missing())
    np.testing.assert_array_equal(more.collect()["reward"], results["reward"])
    assert run.path(0).stat().st_mtime_ns == before
    with pytest.raises(ValueError, match=r"num_seeds: expected 3, .* got 2"):
        begin(tmp_path, num_seeds=2)


def test_a_damaged_episode_is_run_again(whole, tmp_path):
    run, results = whole
    again = begin(tmp_path)
    content = run.path(0).read_bytes()
    again.path(0).write_bytes(content[: len(content) // 2])
    again.path(1).write_bytes(b"")
    again.path(2).write_bytes(run.path(2).read_bytes())
    assert again.missing() == [0, 1]
    again.run_seeds([0, 1])
    np.testing.assert_array_equal(again.collect()["reward"], results["reward"])


def test_an_episode_of_another_run_is_refused(whole, tmp_path):
    run, _ = whole
    again = begin(tmp_path)
    again.path(1).write_bytes(run.path(2).read_bytes())
    with pytest.raises(ValueError, match=r"seed-00001.npz: seed: expected 1, .* got 2"):
        again.missing()
    long = begin(tmp_path / "long", num_steps=STEPS + 1)
    long.path(0).write_bytes(run.path(0).read_bytes())
    message = rf"seed-00000.npz: reward: expected {STEPS + 1} steps, got {STEPS}"
    with pytest.raises(ValueError, match=message):
        long.missing()


def test_another_run_does_not_go_into_the_folder(whole):
    run, _ = whole
    with pytest.raises(ValueError, match="num_steps"):
        begin(run.folder, num_steps=STEPS + 1)
    with pytest.raises(ValueError, match="noise"):
        begin(run.folder, noise=(0.1, 0.1, 0.1, 0.1))


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        (
            ("sea", "random"),
            {},
            "task: expected one of pendulum, cart, acrobot, living-room; got",
        ),
        (("cart", "lucky"), {}, "agent: expected one of true, physics"),
        (
            ("cart", "physics-kinds"),
            {},
            "agent: expected one that can do cart; physics-kinds does living-room al",
        ),
        (
            ("pendulum", "papers"),
            {},
            "agent: expected one that can do pendulum; papers does cart alone",
        ),
        (("cart", "true"), {"num_seeds": 0}, "num_seeds: expected at least 1, got 0"),
        (("cart", "true"), {"num_steps": 0}, "num_steps: expected at least 1, got 0"),
        (
            ("cart", "true"),
            {"noise": (1.0, 2.0)},
            "noise: expected four finite numbers",
        ),
        (
            ("cart", "true"),
            {"noise": (1.0, 2.0, 3.0, -4.0)},
            "noise: expected four finite numbers",
        ),
    ],
)
def test_what_cannot_be_is_refused(arguments, options, message, tmp_path):
    settings = {"num_seeds": 1, **options}
    with pytest.raises(ValueError, match=message):
        begin_run(*arguments, tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_the_command_line_knows_the_same_names():
    # Robots among furniture are runs of another kind (`namo_run`).
    assert cli.TASKS == (*TASKS, "namo")
    assert cli.AGENTS == (*AGENTS, *(n for n in CHARACTERS if n not in AGENTS))
    assert cli.WORLDS == tuple(CART_WORLDS)


@pytest.mark.slow
def test_a_run_in_another_world_says_so(tmp_path):
    """In the box's world the outline is told wrong, and nothing else differs."""
    settings = {"num_seeds": 1, "num_steps": 3}
    run = begin_run("cart", "random", tmp_path, world="box", **settings)
    run.run_seeds([0])
    assert load_run(tmp_path).setting == "cart, box"
    with pytest.raises(ValueError, match="world"):
        begin_run("cart", "random", tmp_path, world="large", **settings)
    with pytest.raises(ValueError, match="world: expected none for pendulum, got"):
        begin(tmp_path / "other", world="box")


def test_the_living_room_has_no_residual_physics():
    task = make_task("living-room", 2)
    with pytest.raises(ValueError, match="agent: expected one that can do living-room"):
        agent_of("physics-residual", task, task.default_params())


def test_the_command_line_runs_and_goes_on(tmp_path, capsys):
    folder = tmp_path / "out"
    command = ["run", "pendulum", "--agent", "random", "--steps", "4", "--seeds", "2"]
    assert cli.main([*command, "--out", str(folder), "--shard", "1/2"]) == 0
    assert "1 seeds are missing" in capsys.readouterr().err
    assert cli.main([*command, "--out", str(folder)]) == 0
    said = capsys.readouterr()
    assert "1 of 2 were there" in said.err
    assert "pendulum, random: return" in said.out
    stored = read_npz(folder / "results.npz")
    assert stored["reward"].shape == (2, 4)
    assert cli.main([*command, "--out", str(folder), "--noise", *"1111"]) == 2
    assert "noise" in capsys.readouterr().err


def test_one_seed_has_no_standard_error(tmp_path, capsys):
    folder = tmp_path / "out"
    command = ["run", "pendulum", "--agent", "random", "--steps", "4", "--seeds", "1"]
    assert cli.main([*command, "--out", str(folder)]) == 0
    said = capsys.readouterr().out
    assert re.match(r"pendulum, random: return -\d+\.\d \(1 seed\); ", said)
    assert cli.main(["plot", str(folder)]) == 0
    assert "nan" not in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("name", ["true", "lr", "oo-lwr", "gp", "ensemble", "random"])
def test_every_agent_acts_on_the_cart(name):
    task = make_task("cart", 8)
    params = task.default_params()
    agent = agent_of(name, task, params)
    record, _ = run_episode(jax.random.key(0), task, params, agent)
    assert np.all(np.isfinite(record.reward))
    assert np.all(record.reward < 0)
