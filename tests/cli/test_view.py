"""`view`: recordings become moving pictures, or one line that says why not."""

import importlib.util
import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from boomdp_jax.cli.main import main
from boomdp_jax.core.history_file import save_transitions

DT = 0.04
SCENE = {
    "schema": "planar-scene-1",
    "dt": DT,
    "bodies": [
        {
            "name": "cart",
            "shape": {"type": "polygon", "vertices": [[0, 0], [0.6, 0], [0, 0.3]]},
        },
        {
            "name": "wall",
            "pose": [2, 0, 0],
            "shape": {"type": "box", "half_extents": [0.1, 1]},
            "static": True,
        },
    ],
    "unknown": {"wheel": 1},
}


def recording(num_rows: int = 10, start: float = 0.0) -> dict[str, np.ndarray]:
    """A cart that goes right at 1 m/s, beside a wall."""
    reading = np.zeros((num_rows + 1, 2, 6))
    reading[:, 0, 0] = start + DT * np.arange(num_rows + 1)
    reading[:, 0, 3], reading[:, 1, 0] = 1.0, 2.0
    action = np.zeros((num_rows, 2, 3))
    next_state = reading[1:].copy()
    return {"state": reading[:-1], "action": action, "next_state": next_state}


def save(path: str, rows: dict[str, np.ndarray], **fields) -> None:
    save_transitions(path, **rows, **{"dt": DT, **fields})


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a scene, recordings, and a run that holds both."""
    monkeypatch.chdir(tmp_path)
    for place in (".", "run", "bare", "empty"):
        Path(place).mkdir(exist_ok=True)
    Path("scene.json").write_text(json.dumps(SCENE))
    Path("run/scene.json").write_text(json.dumps(SCENE))
    Path("empty/scene.json").write_text(json.dumps(SCENE))
    save("data.npz", recording())
    save("bare/data.npz", recording())
    save("run/b.npz", recording(4))
    save("run/a.npz", recording(2))
    both = {
        name: np.concatenate([array, recording(5, start=7.0)[name]])
        for name, array in recording(3).items()
    }
    save("episodes.npz", both, episode=np.repeat([2, 5], [3, 5]))
    nothing = recording()
    nothing["state"][:, 0] = nothing["next_state"][:, 0] = np.nan
    save("unseen.npz", nothing)
    save("rowless.npz", recording(0))
    return tmp_path


def page_data(path: str) -> dict:
    text = Path(path).read_text(encoding="utf-8")
    return json.loads(re.findall(r'id="data">(.*?)</script>', text)[0])


def positions(path: str) -> np.ndarray:
    """Where the cart is in every frame."""
    return np.array(page_data(path)["poses"])[:, 0]


def test_a_recording_becomes_a_page(folder: Path, capsys: pytest.CaptureFixture):
    assert main("view data.npz --scene scene.json --out film.html".split()) == 0
    data = page_data("film.html")
    assert data["title"] == "data"
    assert [body["name"] for body in data["bodies"]] == ["cart", "wall"]
    np.testing.assert_allclose(data["times"], DT * np.arange(11), atol=1e-9)
    np.testing.assert_allclose(positions("film.html"), DT * np.arange(11), atol=1e-9)
    output = capsys.readouterr()
    assert output.out == ""
    assert "body 'cart': the centre of mass" in output.err


def test_a_recording_becomes_a_gif_that_plays_in_real_time(folder: Path):
    assert main("view data.npz --scene scene.json --out film.gif".split()) == 0
    with Image.open("film.gif") as image:
        assert image.n_frames == 11
        assert image.info["duration"] == 40


def test_less_fps_are_fewer_frames(folder: Path):
    command = "view data.npz --scene scene.json --out film.html --fps 5"
    assert main(command.split()) == 0
    np.testing.assert_allclose(page_data("film.html")["times"], [0.0, 0.2, 0.4])


def test_every_recording_of_a_folder_has_a_page_by_name(folder: Path):
    assert main("view run --out film.html".split()) == 0
    assert page_data("film-0.html")["title"] == "a"
    assert len(page_data("film-0.html")["times"]) == 3
    assert page_data("film-1.html")["title"] == "b"
    assert len(page_data("film-1.html")["times"]) == 5


def test_a_scene_given_beside_a_folder_comes_first(folder: Path):
    assert main("view bare --scene scene.json --out film.html".split()) == 0
    assert page_data("film.html")["title"] == "data"


def test_one_episode_is_shown_the_first_unless_told(
    folder: Path, capsys: pytest.CaptureFixture
):
    command = "view episodes.npz --scene scene.json --out film.html"
    assert main(command.split()) == 0
    assert len(positions("film.html")) == 4
    assert "shown is episode 2, of 2 from 2 to 5" in capsys.readouterr().err
    assert main([*command.split(), "--episode", "5"]) == 0
    np.testing.assert_allclose(positions("film.html"), 7.0 + DT * np.arange(6))
    assert "shown is" not in capsys.readouterr().err


def test_missing_readings_are_drawn_between_others(
    folder: Path, capsys: pytest.CaptureFixture
):
    rows = recording()
    # A reading that is missing after a row is there before the next.
    rows["next_state"][2, 0] = np.nan
    rows["next_state"][5, 0] = rows["state"][6, 0] = np.nan
    rows["state"][0, 0] = np.nan
    save("gaps.npz", rows)
    assert main("view gaps.npz --scene scene.json --out film.html".split()) == 0
    expected = DT * np.array([1, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10])
    np.testing.assert_allclose(positions("film.html"), expected, atol=1e-9)
    assert "2 missing poses are drawn between others" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("view data.npz --scene scene.json", "required: --out"),
        ("view data.npz --out film.html", "data.npz: --scene: expected a scene beside"),
        (
            "view data.npz --scene scene.json --out film.mp4",
            "film.mp4: expected a file",
        ),
        (
            "view data.npz --scene scene.json --out no/a.gif",
            "expected an existing folder",
        ),
        ("view none.npz --scene scene.json --out film.gif", "none.npz: No such file"),
        ("view none.npz --out film.gif", "none.npz: No such file"),
        ("view none --out film.html", "none: No such file"),
        ("view data.npz --scene none.json --out film.gif", "none.json: No such file"),
        ("view scene.json --scene scene.json --out film.gif", "expected an NPZ file"),
        ("view bare --out film.html", "bare: expected scene.json in the folder, got"),
        (
            "view empty --out film.html",
            "empty: expected a .npz file in the folder, got",
        ),
        ("view rowless.npz --scene scene.json --out film.html", "at least one row"),
        (
            "view episodes.npz --scene scene.json --out film.html --episode 3",
            "episodes.npz: --episode: expected one of 2, 5, got 3",
        ),
        (
            "view data.npz --scene scene.json --out film.html --episode 1",
            "data.npz: --episode: expected 0, got 1",
        ),
        (
            "view data.npz --scene scene.json --out film.html --episode -1",
            "--episode: expected a whole number, at least 0, got '-1'",
        ),
        (
            "view data.npz --scene scene.json --out film.html --fps 0",
            "--fps: expected a whole number, 1 to 1000, got '0'",
        ),
        (
            "view unseen.npz --scene scene.json --out film.html",
            "unseen.npz: body 'cart': expected a pose that is read at least once",
        ),
    ],
)
def test_bad_input_is_one_line_status_2_and_nothing_written(
    folder: Path, capsys: pytest.CaptureFixture, command: str, message: str
):
    before = sorted(folder.iterdir())
    assert main(command.split()) == 2
    output = capsys.readouterr()
    assert output.out == ""
    errors = [line for line in output.err.splitlines() if ": error: " in line]
    assert len(errors) == 1
    assert message in errors[0]
    assert sorted(folder.iterdir()) == before


def test_one_bad_recording_of_a_folder_keeps_all_from_being_written(
    folder: Path, capsys: pytest.CaptureFixture
):
    np.savez("run/c.npz", action=np.zeros((3, 2, 3)))
    before = sorted(folder.iterdir())
    assert main("view run --out film.html".split()) == 2
    assert "c.npz" in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before


def test_a_gif_without_matplotlib_is_refused_and_a_page_is_not(
    folder: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *rest: None if name == "matplotlib" else find(name, *rest),
    )
    command = "view data.npz --scene scene.json --out film"
    assert main(f"{command}.gif".split()) == 2
    assert "film.gif: expected matplotlib, got none" in capsys.readouterr().err
    assert main(f"{command}.html".split()) == 0
