"""Curves of agents can be told apart, whichever are shown together."""

import itertools

import numpy as np

from boomdp_jax.cli.main import AGENTS
from boomdp_jax.viz import style
from boomdp_jax.viz.learning_curves import lines_of, plot_curves, plot_sample_curves


def looks_of(lines) -> dict:
    """Colour and stroke of each line by its name; of a broken one its pattern too."""
    return {
        line.get_label(): (
            line.get_color(),
            line.get_linestyle(),
            str(line._dash_pattern),
        )
        for line in lines
    }


def test_curves_of_a_figure_differ_and_look_alike_in_both_halves_and_below():
    """All agents at once, the right half without the first and in another order."""
    names = [f"{agent} (20 seeds)" for agent in AGENTS]
    reward = dict.fromkeys(names, (np.full(3, 0.5),) * 3)
    error = {name: reward[name] for name in names[:0:-1]}
    figure = plot_curves(reward, error, title="all")
    left, right = (looks_of(ax.get_lines()) for ax in figure.axes)
    assert list(left) == names
    assert len(set(left.values())) == len(names)
    assert {name: left[name] for name in error} == right
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == names
    shown = looks_of(legend.get_lines())
    assert list(shown.values()) == list(left.values())
    # A pattern is longer than two letters.
    assert min(line.get_xdata()[-1] for line in legend.get_lines()) > 30.0


def test_a_pair_of_one_colour_differs_by_its_strokes():
    for one, other in itertools.combinations(AGENTS, 2):
        first, second = lines_of([one, other]).values()
        assert first != second
        assert first[1] == "-"
        assert (first[0] == second[0]) == (second[1] != "-")


def test_committed_figures_keep_their_colours():
    """Those of the README, whose lines are all solid."""
    shown = [
        ("true", "physics", "physics-pretrained", "lwr-pretrained", "lwr"),
        ("true", "physics", "lwr-world", "lr"),
        ("true", "physics", "papers"),
        ("true", "physics", "physics-kinds"),
        ("lr", "lwr", "physics"),
    ]
    colours = {
        "true": style.EDGE,
        "physics": style.PREDICTION,
        "physics-pretrained": style.SLIDE,
        "physics-kinds": style.FLOOR,
        "papers": style.ROD,
        "lr": style.ROD,
        "lwr": style.BASELINE,
        "lwr-world": style.BASELINE,
        "lwr-pretrained": style.PIN,
    }
    for names in shown:
        assert lines_of(names) == {name: (colours[name], "-") for name in names}


def test_the_same_agent_twice_is_told_apart():
    lines = lines_of(["physics (20 seeds)", "physics (3 of 20 seeds)"])
    assert list(lines.values()) == [(style.PREDICTION, "-"), (style.PREDICTION, "--")]


def test_halves_of_a_figure_by_samples_look_alike():
    band = (np.full(2, 0.5),) * 3
    figure = plot_sample_curves(
        {"lr": band, "papers": band}, {"papers": band, "lr": band}, [1, 2], title="few"
    )
    left, right = (looks_of(ax.get_lines()) for ax in figure.axes)
    assert left == right
    assert left["lr"] != left["papers"]
