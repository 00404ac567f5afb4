"""`view`: from recordings to moving pictures."""

import argparse
import importlib.util
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from boomdp_jax.cli.output import check_writable, numbered, print_notes
from boomdp_jax.core.history_file import load_transitions
from boomdp_jax.core.transition_table import TransitionTable
from boomdp_jax.experiments.replay import replay
from boomdp_jax.physics.scene_file import load_scene
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State
from boomdp_jax.viz.animation import ANIMATION_SUFFIXES, animate

_SCENE_NAME = "scene.json"


def run(arguments: argparse.Namespace) -> None:
    """Show one episode of each recording; all is read before anything is written.

    Args:
        arguments: what `cli.main` parsed.

    Raises:
        ValueError: bad input; nothing has been written then.
    """
    check_animation(arguments.out)
    if (Path(arguments.data) / "run.json").is_file():
        _view_run(arguments)
        return
    scene_path, data_paths = find_files(arguments.data, arguments.scene)
    spec = load_scene(scene_path)
    print_notes(spec.notes)
    films = []
    for path in data_paths:
        table = load_transitions(path, spec=spec)
        films.append((path, *poses_of_episode(table, spec, arguments.episode)))
    for index, (path, poses, intervals) in enumerate(films):
        states = State(pose=jnp.asarray(poses, float), twist=jnp.zeros(poses.shape))
        out = numbered(arguments.out, index, len(films))
        title = Path(path).stem
        animate(spec, states, out, dt=intervals, fps=arguments.fps, title=title)
        print(out, file=sys.stderr)


def _view_run(arguments: argparse.Namespace) -> None:
    """Show an episode of a run, among all that can be seen."""
    if arguments.scene is not None:
        raise ValueError(
            f"{arguments.data}: --scene: expected none for a run, which has its own, "
            f"got {arguments.scene}"
        )
    shown = replay(arguments.data, arguments.episode)
    animate(
        shown.spec,
        shown.states,
        arguments.out,
        dt=shown.dt,
        params=shown.params,
        fps=arguments.fps,
        title=shown.title,
        has_trail=True,
    )
    print(arguments.out, file=sys.stderr)


def check_animation(path: str) -> None:
    """Make sure before anything is read that the picture can be made.

    Args:
        path: where to.

    Raises:
        ValueError: it cannot be written, the kind of file is not known, or matplotlib
            is missing for a GIF.
    """
    check_writable(path)
    suffix = Path(path).suffix.lower()
    if suffix not in ANIMATION_SUFFIXES:
        raise ValueError(
            f"{path}: expected a file that ends in {' or '.join(ANIMATION_SUFFIXES)}, "
            f"got {suffix!r}"
        )
    if suffix == ".gif" and importlib.util.find_spec("matplotlib") is None:
        raise ValueError(
            f"{path}: expected matplotlib, got none; pip install 'boomdp_jax[plot]', "
            "or give a path that ends in .html"
        )


def find_files(data: str, scene: str | None) -> tuple[str, list[str]]:
    """The scene and the recordings that are meant.

    Args:
        data: a transition file, or a folder that holds `scene.json` and one or more
            transition files.
        scene: a scene file; None: the one in the folder.

    Returns:
        Path of the scene, and those of the recordings in the order of their names.

    Raises:
        ValueError: a file without a scene, or a folder without either.
        OSError: there is no such file or folder.
    """
    folder = Path(data)
    folder.stat()  # Before anything is asked for that goes with it.
    if not folder.is_dir():
        if scene is None:
            raise ValueError(
                f"{data}: --scene: expected a scene beside a data file, which has no "
                "outlines, got none"
            )
        return scene, [data]
    own_scene = folder / _SCENE_NAME
    if scene is None and not own_scene.is_file():
        raise ValueError(f"{data}: expected {_SCENE_NAME} in the folder, got none")
    recordings = sorted(map(str, folder.glob("*.npz")))
    if not recordings:
        raise ValueError(f"{data}: expected a .npz file in the folder, got none")
    return scene or str(own_scene), recordings


def poses_of_episode(
    table: TransitionTable, spec: SceneSpec, episode: int | None
) -> tuple[Float[np.ndarray, "time body 3"], Float[np.ndarray, " interval"]]:
    """Poses along one episode, with missing readings filled in.

    Args:
        table: the recording.
        spec: its scene, for names.
        episode: number of the episode in the file; None: the first one, with a note
            that there are others.

    Returns:
        Poses before the first row and after every row [m, m, rad], and the time from
        each to the next [s].

    Raises:
        ValueError: no rows, no such episode, or a body that is never read in it.
    """
    if not table.num_rows:
        raise ValueError(f"{table.source}: expected at least one row, got none")
    numbers = list(dict.fromkeys(table.episode.tolist()))
    shown = numbers[0] if episode is None else episode
    if shown not in numbers:
        raise ValueError(
            f"{table.source}: --episode: expected {_span(numbers)}, got {shown}"
        )
    if episode is None and len(numbers) > 1:
        print_notes(
            [
                f"{table.source}: shown is episode {shown}, of {len(numbers)} from "
                f"{min(numbers)} to {max(numbers)}"
            ]
        )
    rows = table.episode == shown
    before, after = table.state[rows, :, :3], table.next_state[rows, :, :3]
    # Where the reading after a row is missing, there may be one before the next.
    after[:-1] = np.where(np.isnan(after[:-1]), before[1:], after[:-1])
    poses, intervals = np.concatenate([before[:1], after]), table.dt[rows]
    times = np.concatenate([[0.0], np.cumsum(intervals)])
    is_missing = np.isnan(poses)
    for body, axis in np.argwhere(is_missing.any(axis=0)):
        is_read = ~is_missing[:, body, axis]
        if not is_read.any():
            raise ValueError(
                f"{table.source}: body {spec.names[body]!r}: expected a pose that is "
                f"read at least once in episode {shown}, got none"
            )
        column = poses[:, body, axis]
        poses[:, body, axis] = np.interp(times, times[is_read], column[is_read])
    num_missing = int(is_missing.any(axis=-1).sum())
    if num_missing:
        print_notes(
            [f"{table.source}: {num_missing} missing poses are drawn between others"]
        )
    return poses, intervals


def _span(numbers: list[int]) -> str:
    """The numbers that there are, in few words."""
    if len(numbers) == 1:
        return str(numbers[0])
    if sorted(numbers) == list(range(min(numbers), max(numbers) + 1)):
        return f"a number from {min(numbers)} to {max(numbers)}"
    return f"one of {', '.join(map(str, numbers))[:200]}"
