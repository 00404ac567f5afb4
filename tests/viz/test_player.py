"""The page plays, stops, scrubs and zooms in a browser, and shows what it should."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from boomdp_jax.viz import animate
from boomdp_jax.viz.style import BODY, PIN, ROD, STATIC, WHEEL
from tests.viz.rooms import EVIL, KNOWN, moving, room_spec

# Without a screen a browser draws few frames of its own accord. Clock and hands are
# therefore the test's; what they move and what is reported is the player's own.
DRIVER = """<head><script>
window.requestAnimationFrame = (step) => setTimeout(() => step(performance.now()), 16);
window.addEventListener("load", () => {
  const report = document.documentElement.dataset, log = {};
  const element = (id) => document.getElementById(id);
  const read = (name) => { log[name] = [report.state, Number(report.time),
    Number(report.drawn), element("now").textContent, element("scrub").value]; };
  const centre = () => {
    const view = element("view"), box = view.getBoundingClientRect();
    return { clientX: box.x + box.width / 2, clientY: box.y + box.height / 2 };
  };
  const picture = (name) => { log[name] = element("view").toDataURL(); };
  const acts = [
    [1000, () => { read("running"); element("play").click(); }],
    [1100, () => read("stopped")],
    [1500, () => { read("still"); picture("wide"); }],
    [1510, () => element("view").dispatchEvent(
      new WheelEvent("wheel", { deltaY: -500, ...centre() }))],
    [1600, () => { picture("near"); element("fit").click(); }],
    [1700, () => { picture("fitted"); element("names").click(); }],
    [1800, () => { picture("nameless"); element("scrub").value = 30;
      element("scrub").dispatchEvent(new Event("input")); }],
    [1900, () => { read("scrubbed"); document.body.dispatchEvent(
      new KeyboardEvent("keydown", { key: "ArrowRight", bubbles: true })); }],
    [2000, () => { read("stepped"); element("speed").value = "2";
      element("play").click(); }],
    [4000, () => { read("ended"); element("loop").click(); element("play").click(); }],
    [7000, () => { read("looping"); element("play").click(); }],
    [7100, () => { report.log = JSON.stringify(log); }],
  ];
  for (const [when, act] of acts) setTimeout(act, when);
});
</script>"""


def browse(page: Path, *options: str) -> str:
    """Open a page in a browser without a screen; what it prints."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    browser = next(filter(None, map(shutil.which, names)), None)
    if browser is None:
        pytest.skip(f"no browser: looked for {', '.join(names)}")
    command = [
        browser,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-default-apps",
        "--disable-dev-shm-usage",
        "--disable-sync",
        "--no-first-run",
        "--hide-scrollbars",
        "--window-size=900,600",
        f"--user-data-dir={page.parent / 'profile'}",
        *options,
        page.as_uri(),
    ]
    finished = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False
    )
    assert finished.returncode == 0, finished.stderr[-2000:]
    return finished.stdout


@pytest.mark.slow
def test_the_player_plays_stops_scrubs_and_zooms(tmp_path):
    spec, path = room_spec(KNOWN, wall=EVIL), tmp_path / "film.html"
    animate(spec, moving(spec, 101), path, has_trail=True)
    page = tmp_path / "driven.html"
    page.write_text(path.read_text("utf-8").replace("<head>", DRIVER, 1), "utf-8")
    text = browse(page, "--virtual-time-budget=9000", "--dump-dom")
    root = text[text.index("<html") : text.index("<head>")]
    assert "data-error" not in root
    assert 'data-frames="61"' in root
    log = json.loads(root.split('data-log="')[1].split('"')[0].replace("&quot;", '"'))
    state, time, drawn, label, _ = log["running"]
    assert state == "playing"
    # As much time as has passed; the page starts a little before it is all loaded.
    assert 0.8 < time < 1.3
    assert drawn > 20
    assert float(label) == pytest.approx(time, abs=0.006)
    assert log["stopped"][0] == "paused"
    assert log["still"][1] == log["stopped"][1]
    assert log["near"] != log["wide"]
    assert log["fitted"] == log["wide"]
    assert log["nameless"] != log["wide"]
    assert log["scrubbed"][:2] == ["paused", pytest.approx(1.0, abs=0.011)]
    assert log["scrubbed"][4] == "30"
    assert log["stepped"][4] == "31"
    assert log["ended"][:2] == ["ended", 2.0]
    assert log["ended"][4] == "60"
    # Three seconds at double speed, in a film of two seconds.
    assert log["looping"][0] == "playing"
    assert 0.0 < log["looping"][1] < 2.0
    assert "<title>room.json</title>" in text


@pytest.mark.slow
def test_the_page_is_a_picture_with_something_on_it(tmp_path):
    spec, path = room_spec(KNOWN), tmp_path / "film.html"
    animate(spec, moving(spec, 101), path)
    picture = tmp_path / "page.png"
    browse(path, "--virtual-time-budget=2000", f"--screenshot={picture}")
    image = imread(picture)[..., :3]
    assert image.shape == (600, 900, 3)
    view = image[60:500]
    for colour in (PIN, ROD, WHEEL, STATIC, BODY):
        wanted = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        is_near = np.all(np.abs(view - wanted) < 0.02, axis=-1)
        assert np.count_nonzero(is_near) > 5, f"no {colour} to be seen"
