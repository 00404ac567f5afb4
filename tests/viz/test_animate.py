"""Moving pictures show the motion, in real time, and say so where they cannot."""

import json
import math
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from boomdp_jax.physics import WORLD, Params, State, empty_params
from boomdp_jax.physics.params import Distance, Revolute, Wheel
from boomdp_jax.viz import animate, draw
from boomdp_jax.viz.film import nearest_states
from boomdp_jax.viz.style import PIN, ROD, WHEEL
from tests.viz.rooms import EVIL, KNOWN, moving, room_spec


def joined_params() -> Params:
    """A pin, a rod and a pair of wheels, and a slot of each that is not active."""
    on = jnp.array([True, False])
    ends = {"body_a": jnp.array([0, 1]), "body_b": jnp.array([WORLD, 2])}
    place = {"anchor_a": jnp.full((2, 2), 0.1), "anchor_b": jnp.full((2, 2), 0.2)}
    numbers = {"viscous": jnp.zeros(2), "dry": jnp.zeros(2)}
    pins = Revolute(active=on, **ends, **place, **numbers)
    rods = Distance(active=~on, **ends, **place, length=jnp.ones(2))
    active = jnp.zeros((4, 1), bool).at[1].set(True)
    wheels = Wheel(
        active=active,
        position=jnp.full((4, 1, 2), 0.1),
        heading=jnp.full((4, 1), math.pi / 2),
        viscous=jnp.zeros((4, 1, 2)),
        dry=jnp.zeros((4, 1, 2)),
        half_track=jnp.full((4, 1), 0.15),
    )
    bare = empty_params(4)
    fields = {"revolute": pins, "distance": rods, "wheel": wheels}
    return Params(**{**vars(bare), **fields})


def page_data(path: Path) -> dict:
    """What the page's player reads."""
    text = path.read_text(encoding="utf-8")
    found = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', text
    )
    assert len(found) == 1
    return json.loads(found[0])


def frames_of(path: Path) -> tuple[list[np.ndarray], list[int]]:
    """Pictures of a GIF, and how long each is shown [ms]."""
    pictures, lengths = [], []
    with Image.open(path) as image:
        for index in range(image.n_frames):
            image.seek(index)
            pictures.append(np.asarray(image.convert("RGB"), float))
            lengths.append(image.info["duration"])
    return pictures, lengths


def colours_of(ax) -> list[str]:
    return [line.get_color() for line in ax.lines] + [
        line.get_markeredgecolor() for line in ax.lines
    ]


# --- Stills ---------------------------------------------------------------------------


def test_a_scene_is_drawn_on_a_figure_of_its_own_or_on_given_axes():
    spec = room_spec()
    ax = draw(spec)
    assert isinstance(ax.figure, Figure)
    assert len(ax.patches) == 4
    assert [text.get_text() for text in ax.texts] == list(spec.names)
    given = Figure().add_subplot()
    assert draw(spec, ax=given) is given
    assert len(given.patches) == 4


def test_joints_of_the_params_are_drawn_where_they_are():
    state = State(
        pose=jnp.array([[1.0, 2, math.pi / 2], [2, 0, 0], [0, 1.5, 0], [1, -1, 0]]),
        twist=jnp.zeros((4, 3)),
    )
    ax = draw(room_spec(), state, params=joined_params())
    rings = {
        tuple(np.round([line.get_xdata()[0], line.get_ydata()[0]], 6)): line
        for line in ax.lines
        if line.get_marker() == "o"
    }
    # A quarter turn takes (0.1, 0.1) to (-0.1, 0.1).
    assert rings[0.9, 2.1].get_markeredgecolor() == PIN
    assert rings[0.2, 0.2].get_markeredgecolor() == PIN
    assert rings[2.1, 0.1].get_markeredgecolor() == ROD
    assert rings[0.2, 1.7].get_markeredgecolor() == ROD
    assert len(rings) == 4
    wheels = [patch.get_xy()[:4] for patch in ax.patches[4:]]
    # The axle of a wheel that rolls along y lies along x.
    centres = [np.round(corners.mean(axis=0), 6).tolist() for corners in wheels]
    assert sorted(centres) == [[1.95, 0.1], [2.25, 0.1]]
    assert all(np.ptp(corners[:, 1]) > np.ptp(corners[:, 0]) for corners in wheels)


def test_without_params_what_the_file_knows_is_drawn():
    ax = draw(room_spec(KNOWN))
    assert {PIN, ROD, WHEEL} <= set(colours_of(ax))
    # The wheel whose place is unknown is nowhere.
    assert len(ax.patches) == 5
    assert not {PIN, ROD, WHEEL} & set(colours_of(draw(room_spec())))
    assert not {PIN, ROD} & set(
        colours_of(draw(room_spec(KNOWN), params=empty_params(4)))
    )


# --- Frames ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("num_states", "dt", "period"),
    [(101, 0.02, 0.04), (51, 0.02, 1 / 30), (11, 0.5, 0.1), (1, 0.02, 0.04)],
)
def test_frames_show_the_nearest_state_and_the_last(num_states, dt, period):
    times = dt * np.arange(num_states)
    shown = nearest_states(times, period)
    assert len(shown) == math.ceil(times[-1] / period - 1e-6) + 1
    assert shown[0] == 0
    assert shown[-1] == num_states - 1
    wanted = np.minimum(period * np.arange(len(shown)), times[-1])
    best = np.min(np.abs(times[None] - wanted[:, None]), axis=1)
    np.testing.assert_allclose(np.abs(times[shown] - wanted), best, atol=1e-12)


def test_states_at_uneven_times_are_shown_when_they_were():
    times = np.array([0.0, 0.3, 0.35, 1.0])
    shown = nearest_states(times, 0.1)
    np.testing.assert_array_equal(shown, [0, 0, 1, 1, 2, 2, 2, 3, 3, 3, 3])


# --- GIF ------------------------------------------------------------------------------


def test_a_gif_plays_in_real_time_and_moves_what_moves(tmp_path):
    spec, path = room_spec(KNOWN), tmp_path / "film.gif"
    animate(spec, moving(spec, 26), path, fps=10, has_trail=True)
    pictures, lengths = frames_of(path)
    # Half a second in tenths, both ends shown.
    assert lengths == [100] * 6
    assert {picture.shape for picture in pictures} == {pictures[0].shape}
    assert len({picture.tobytes() for picture in pictures}) == 6
    # A GIF's colours are rounded anew in every frame.
    changed = np.argwhere(np.any(np.abs(pictures[0] - pictures[-1]) > 60, axis=-1))
    height, width = pictures[0].shape[:2]
    # The ball above and the wall below stay; the axes do not tremble.
    assert changed[:, 1].max() < width - 5
    below = changed[changed[:, 0] > 0.75 * height]
    assert not len(below)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["film.gif"]


@pytest.mark.parametrize(
    ("dt", "fps", "expected"), [(0.02, 30, 40), (0.02, 200, 20), (0.25, 30, 250)]
)
def test_a_gif_has_no_more_frames_than_asked_for_and_no_more_than_states(
    tmp_path, dt, fps, expected
):
    spec = room_spec()
    animate(spec, moving(spec, 3, dt), tmp_path / "film.gif", dt=dt, fps=fps)
    assert set(frames_of(tmp_path / "film.gif")[1]) == {expected}


def test_a_gif_of_too_many_frames_is_refused(tmp_path):
    spec = room_spec()
    message = (
        "expected at most 1500 frames, got 2001; give less fps, fewer states, or a"
    )
    with pytest.raises(ValueError, match=message):
        animate(spec, moving(spec, 2001), tmp_path / "film.gif", fps=50)
    assert not list(tmp_path.iterdir())


# --- Pages ----------------------------------------------------------------------------


def test_a_page_holds_the_scene_its_joints_and_every_frame(tmp_path):
    spec, path = room_spec(), tmp_path / "film.html"
    states = moving(spec, 301)
    animate(spec, states, path, params=joined_params(), title="pushes", has_trail=True)
    data = page_data(path)
    assert data["title"] == "pushes"
    assert data["trail"] is True
    assert [body["name"] for body in data["bodies"]] == list(spec.names)
    assert [body["isStatic"] for body in data["bodies"]] == [False] * 3 + [True]
    assert data["bodies"][2] | {"name": ""} == {
        "name": "",
        "isStatic": False,
        "radius": 0.25,
        "vertices": [],
    }
    np.testing.assert_allclose(data["bodies"][0]["vertices"], spec.bodies[0].vertices)
    assert [(link["kind"], link["a"], link["b"]) for link in data["links"]] == [
        ("revolute", 0, -1),
        ("distance", 1, 2),
    ]
    assert [wheel["body"] for wheel in data["wheels"]] == [1, 1]
    times, poses = np.array(data["times"]), np.array(data["poses"])
    assert times[0] == 0.0
    assert times[-1] == pytest.approx(6.0)
    # 30 of 50 states a second, at most.
    assert len(times) == len(poses) == 181
    np.testing.assert_allclose(poses.reshape(-1, 4, 3)[:, 0, 0], times, atol=1e-6)
    np.testing.assert_allclose(poses.reshape(-1, 4, 3)[:, 1, 2], 3 * times, atol=1e-6)
    low, high = np.array(data["bounds"])
    assert np.all(low < [-0.3, -1.2])
    assert np.all(high > [6.3, 1.75])


def test_a_page_needs_nothing_from_outside(tmp_path):
    spec, path = room_spec(), tmp_path / "film.html"
    animate(spec, moving(spec, 11), path)
    text = path.read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert not re.search(r"\b(src|href)\s*=|url\(|import\s|https?:", text)


def test_a_name_cannot_end_the_script_that_holds_it(tmp_path):
    spec, path = room_spec(wall=EVIL), tmp_path / "film.html"
    animate(spec, moving(spec, 3), path, title="<!-- \u2028" + EVIL)
    data = page_data(path)
    assert data["bodies"][3]["name"] == EVIL
    assert data["title"] == "<!-- \u2028" + EVIL
    text = path.read_text(encoding="utf-8")
    assert "<b>" not in text
    assert "<!--" not in text
    assert "\u2028" not in text
    assert text.count("</script>") == 3


def test_steps_of_different_length_keep_their_times(tmp_path):
    spec, path = room_spec(), tmp_path / "film.html"
    animate(spec, moving(spec, 4), path, dt=np.array([0.1, 0.5, 0.2]))
    assert page_data(path)["times"] == pytest.approx([0.0, 0.1, 0.6, 0.8])
    animate(spec, moving(spec, 4), path, dt=jnp.asarray(0.5))
    assert page_data(path)["times"] == pytest.approx([0.0, 0.5, 1.0, 1.5])


def test_one_state_is_a_still(tmp_path):
    spec = room_spec()
    for kind in ("html", "gif"):
        animate(spec, moving(spec, 1), tmp_path / f"film.{kind}")
    assert page_data(tmp_path / "film.html")["times"] == [0.0]
    assert len(frames_of(tmp_path / "film.gif")[0]) == 1


# --- Refusals -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": "film.mp4"}, "film.mp4: expected a file that ends in .gif or .html"),
        ({"path": "film"}, "expected a file that ends in .gif or .html, got ''"),
        ({"fps": 0}, "fps: expected a finite number above 0, got 0"),
        ({"dt": 0.0}, "dt: expected finite numbers above 0, got 0.0"),
        ({"dt": np.array([0.1, np.nan])}, "dt: expected finite numbers above 0, got"),
        ({"dt": np.ones(3)}, r"dt: expected one number or 2, .* got shape \(3,\)"),
        (
            {"params": empty_params(2)},
            r"params: expected one hypothesis about 4 bodies",
        ),
        (
            {"params": jax.tree.map(lambda leaf: leaf[None], empty_params(4))},
            r"params: .* densities of shape \(1, 4\)",
        ),
        (
            {"pose": np.zeros((3, 2, 3))},
            r"poses: expected one or more frames of 4 bodies, .* got \[3, 2, 3\]",
        ),
        ({"pose": np.zeros((4, 3))}, r"poses: .* got \[4, 3\]"),
        ({"pose": np.zeros((0, 4, 3))}, r"poses: .* got \[0, 4, 3\]"),
        (
            {"pose": np.tile([0, np.nan, 0], (3, 4, 1))},
            r"poses: expected finite numbers, got \[0.0, nan, 0.0\] in frame 0, body",
        ),
    ],
)
def test_what_cannot_be_shown_is_refused_and_nothing_written(
    tmp_path, monkeypatch, change, message
):
    monkeypatch.chdir(tmp_path)
    spec = room_spec()
    arguments = {"path": "film.html", "states": moving(spec, 3), **change}
    if "pose" in change:
        pose = jnp.asarray(arguments.pop("pose"))
        arguments["states"] = State(pose=pose, twist=jnp.zeros_like(pose))
    with pytest.raises(ValueError, match=message):
        animate(spec, **arguments)
    assert not list(tmp_path.iterdir())


def test_a_still_of_poses_that_are_not_finite_is_refused():
    spec = room_spec()
    pose = spec.initial_state().pose.at[1, 2].set(jnp.inf)
    with pytest.raises(ValueError, match="in frame 0, body 'cart'"):
        draw(spec, State(pose=pose, twist=jnp.zeros_like(pose)))
