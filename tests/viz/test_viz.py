"""Pictures are made without a display and show what they should."""

import dataclasses
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import imread

from boomdp_jax.core.history import make_history
from boomdp_jax.physics import State, empty_params
from boomdp_jax.viz import (
    draw_posterior,
    draw_prediction,
    draw_scene,
    draw_structure_bars,
    plot_posterior,
)
from boomdp_jax.viz.learning_curves import plot_curves
from tests.inference.made_posteriors import (
    draws_like,
    make_posterior,
    room_spec,
    table_posterior,
    table_spec,
)


@pytest.fixture
def ax():
    return Figure().add_subplot()


def labels(ax) -> list[str]:
    return ax.get_legend_handles_labels()[1]


def free_posterior():
    params = draws_like(empty_params(1, density=20.0), 50)
    return make_posterior(table_spec(), params, params)


def drifting_history(num_rows=20):
    """A body that turns at 2 rad/s and is not pushed."""
    time = 0.02 * np.arange(num_rows + 1)
    reading = np.zeros((num_rows + 1, 1, 6))
    reading[:, 0, 2], reading[:, 0, 5] = 2.0 * time, 2.0
    return make_history(
        reading[:-1], np.zeros((num_rows, 1, 3)), reading[1:], 0.02
    ), reading


def test_a_scene_is_drawn_where_the_bodies_are(ax):
    state = State(
        pose=jnp.array([[0.0, 0, 0], [2.0, 1.0, np.pi / 2], [0.0, 0, 0]]),
        twist=jnp.zeros((3, 3)),
    )
    draw_scene(ax, room_spec(), state)
    corners = ax.patches[1].get_xy()[:4]
    # A quarter turn swaps the sides of 0.6 m and 0.4 m.
    np.testing.assert_allclose(corners.min(axis=0), [1.8, 0.7], atol=1e-6)
    np.testing.assert_allclose(corners.max(axis=0), [2.2, 1.3], atol=1e-6)
    assert [text.get_text() for text in ax.texts] == ["wall", "table", "chair"]
    assert ax.get_xlabel() == "x [m]"


def test_a_circle_is_drawn_at_its_radius(ax):
    spec = table_spec(shape={"type": "circle", "radius": 0.2}, pose=[1.0, 2.0, 0.0])
    draw_scene(ax, spec)
    assert ax.patches[0].get_radius() == pytest.approx(0.2)
    assert ax.patches[0].center == pytest.approx((1.0, 2.0))


def test_a_posterior_shows_pins_wheels_and_truth(ax):
    truth = {"pin": [0.25, 0.1], "wheel": [0.05, 0.0, 0.4]}
    draw_posterior(ax, table_posterior(80), truth=truth)
    text = " ".join(labels(ax))
    assert "pin 1.00" in text
    assert "wheel's axle 0.25" in text
    assert "true pin" in text
    assert "true wheel and its axle" in text
    assert "[m]" in ax.get_xlabel()
    assert "table: mass" in ax.get_title()
    cloud = next(each for each in ax.collections if isinstance(each, PathCollection))
    np.testing.assert_allclose(
        cloud.get_offsets().mean(axis=0), [0.25, 0.1], atol=0.002
    )


def test_the_drawn_axle_is_square_to_the_heading(ax):
    draw_posterior(ax, table_posterior(400))
    axle = next(
        line for line in ax.lines if str(line.get_label()).startswith("wheel's axle")
    )
    points = np.column_stack(axle.get_data())
    direction = points[-1] - points[0]
    angle = np.arctan2(direction[1], direction[0])
    difference = np.mod(angle - (0.4 + np.pi / 2) + np.pi / 2, np.pi) - np.pi / 2
    assert abs(difference) < 0.02


def test_truth_may_be_params(ax):
    posterior = table_posterior(40)
    truth = jax.tree.map(lambda leaf: leaf[0], posterior.params)
    draw_posterior(ax, posterior, truth=truth)
    assert "true wheel and its axle" in labels(ax)


def test_improbable_constraints_are_left_out(ax):
    weights = np.where(np.arange(80) % 4 == 0, 0.01, 1.0)
    draw_posterior(ax, table_posterior(80, weights=weights))
    assert not any("wheel" in label for label in labels(ax))


def test_bars_are_as_long_as_the_probabilities(ax):
    draw_structure_bars(ax, table_posterior(80))
    widths = [bar.get_width() for bar in ax.patches]
    # Structures that are possible and have no draw are shown as such.
    assert widths == pytest.approx([0.75, 0.25, 0.0])
    names = [label.get_text() for label in ax.get_yticklabels()]
    assert names == ["pin", "pin + wheel", "all others"]
    assert [text.get_text() for text in ax.texts] == ["0.750", "0.250", "< 0.001"]


def test_bars_beyond_the_most_are_put_together(ax):
    draw_structure_bars(ax, table_posterior(80), num_bars=1)
    names = [label.get_text() for label in ax.get_yticklabels()]
    assert names == ["pin", "all others"]
    assert [bar.get_width() for bar in ax.patches] == pytest.approx([0.75, 0.25])


def test_a_prediction_lies_on_unpushed_motion(ax):
    history, reading = drifting_history()
    draw_prediction(ax, free_posterior(), history)
    assert ax.get_ylabel() == "table: angle [rad]"
    assert ax.get_xlabel() == "time ahead [s]"
    lines = {line.get_label(): line for line in ax.lines}
    median = lines["predicted, median"].get_ydata()
    # Noise of 1 mrad and of 5 mrad/s over 0.4 s: the median of 50 draws is within it.
    np.testing.assert_allclose(median, reading[1:, 0, 2], atol=0.003)
    np.testing.assert_allclose(
        lines["held-out readings"].get_ydata(), reading[:, 0, 2], atol=1e-6
    )


def test_a_prediction_of_a_camera_starts_from_all_poses_until_then(ax):
    history, reading = drifting_history()
    unread = history.state_mask.at[..., 3:].set(False)
    camera = dataclasses.replace(history, state_mask=unread, next_state_mask=unread)
    draw_prediction(ax, free_posterior(), camera)
    lines = {line.get_label(): line for line in ax.lines}
    median = lines["predicted, median"].get_ydata()
    # From the second row on, with 1 mrad of noise of both and no more readings: 14 mrad
    # after 0.4 s are 0.5 sd.
    first = len(reading) - 1 - len(median)
    assert first == 1
    np.testing.assert_allclose(median, reading[2:, 0, 2], atol=0.03)


def test_a_prediction_needs_a_reading_and_room_for_it(ax):
    history, _ = drifting_history()
    with pytest.raises(ValueError, match="start: expected 20 rows after it, got row 5"):
        draw_prediction(ax, free_posterior(), history, start=5)
    with pytest.raises(ValueError, match="quantity: expected one of"):
        draw_prediction(ax, free_posterior(), history, quantity="speed")
    blind = np.full((4, 1, 6), np.nan)
    nothing = make_history(blind, np.zeros((4, 1, 3)), blind, 0.02)
    with pytest.raises(ValueError, match="expected a row with a complete reading"):
        draw_prediction(ax, free_posterior(), nothing)


def test_the_figure_is_a_picture_with_something_on_it(tmp_path):
    history, _ = drifting_history()
    path = tmp_path / "post.png"
    figure = free_posterior().plot(path, history)
    assert len(figure.axes) == 3
    assert np.ptp(imread(path)[..., :3]) > 0.5


def test_every_body_that_moves_has_a_panel(tmp_path):
    params = draws_like(empty_params(3, num_revolute=2, num_wheel=2), 20)
    path = tmp_path / "room.svg"
    figure = plot_posterior(make_posterior(room_spec(), params, params), path)
    titles = [axes.get_title().split(":")[0] for axes in figure.axes]
    assert titles == ["table", "chair", ""]
    assert path.read_text().startswith("<?xml")


@pytest.mark.filterwarnings("error")
def test_an_axis_without_a_curve_is_no_reason_to_warn():
    band = (np.full(3, 0.5),) * 3
    figure = plot_curves({"true": band}, {"true": (np.zeros(3),) * 3}, title="short")
    assert figure.axes[0].get_xlim()[0] == 1.0


def test_importing_viz_does_not_import_matplotlib():
    code = "import sys, boomdp_jax.viz; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
