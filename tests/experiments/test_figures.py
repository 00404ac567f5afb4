"""Figures of the papers: their runs, their errors, their files."""

import numpy as np
import pytest

from boomdp_jax.cli import main as cli
from boomdp_jax.envs import Pendulum
from boomdp_jax.experiments import AGENTS, TASKS
from boomdp_jax.experiments.figures import FIGURES
from boomdp_jax.experiments.sample_curves import sample_errors
from tests.agents.line_world import LineWorld


def test_every_figure_is_of_agents_and_tasks_that_exist():
    assert cli.FIGURES == ("1a", *FIGURES)
    for figure in FIGURES.values():
        assert figure.task in TASKS
        assert set(figure.agents) <= set(AGENTS)
        # Regret is to the one who knows.
        assert figure.agents[0] == "true"


def test_noise_is_a_quarter_of_a_pixel_and_more():
    """The goal of the successor's cart is 353 pixels away, ours 3.53 m."""
    assert FIGURES["cart-noisy-1"].noise == pytest.approx((0.0025,) * 4)
    assert FIGURES["cart-noisy-16"].noise == pytest.approx((0.04,) * 4)


def test_figures_of_one_setting_share_runs(tmp_path):
    folders = [
        [run.folder for run in FIGURES[name].runs(tmp_path, num_seeds=1, num_steps=3)]
        for name in ("2a", "cart", "cart-noisy-1")
    ]
    assert folders[0][0] == folders[1][0]
    assert not set(folders[1]) & set(folders[2])


def test_who_learns_nothing_has_no_curve():
    task = LineWorld()
    with pytest.raises(ValueError, match=r"agent: expected one that learns.*'true'"):
        sample_errors("true", task, task.default_params(), [0])


@pytest.mark.parametrize("sizes", [(), (0, 5), (5, 5), (9, 3)])
def test_sizes_ascend(sizes):
    task = LineWorld()
    with pytest.raises(ValueError, match="sizes: expected to ascend from at least 1"):
        sample_errors("lr", task, task.default_params(), [0], sizes=sizes)


@pytest.mark.slow
def test_a_linear_law_plateaus_above_zero_and_a_local_one_goes_on():
    """What figure 1a of the paper shows of both."""
    task = Pendulum()
    params = task.default_params()
    sizes = (10, 50, 500)
    errors = {
        agent: next(sample_errors(agent, task, params, [0], sizes=sizes))
        for agent in ("lr", "lwr")
    }
    linear, local = errors["lr"].velocity, errors["lwr"].velocity
    assert linear[2] > 0.5 * linear[1]
    assert local[2] < 0.5 * local[1]
    assert local[2] < 0.5 * linear[2]
    assert np.all(linear[1:] > 1e-3)


@pytest.mark.slow
def test_a_figure_is_one_command_that_goes_on(tmp_path, capsys):
    command = ["figure", "acrobot", "--agents", "random", "--steps", "4"]
    command += ["--out", str(tmp_path)]
    assert cli.main([*command, "--seeds", "2", "--shard", "0/2"]) == 0
    capsys.readouterr()
    assert cli.main([*command, "--seeds", "2"]) == 0
    said = capsys.readouterr()
    assert "1 of 2 were there" in said.err
    assert said.out.splitlines()[2].split()[:2] == ["random", "2"]
    assert (tmp_path / "acrobot.png").read_bytes().startswith(b"\x89PNG")


def test_an_unknown_figure_is_refused(tmp_path, capsys):
    assert cli.main(["figure", "3c", "--out", str(tmp_path)]) == 2
    assert "invalid choice: '3c'" in capsys.readouterr().err


def test_an_agent_that_learns_nothing_is_refused_before_any_other_runs(
    tmp_path, capsys
):
    command = ["figure", "1a", "--agents", "lr", "nonsense", "--seeds", "1"]
    assert cli.main([*command, "--out", str(tmp_path)]) == 2
    assert "agent: expected one that learns" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
