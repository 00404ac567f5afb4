"""A table is in the way: it looks easiest to move, turns in place, and is left alone.

The papers' picture story, played out. A robot has to get to the other side of a wall
whose opening a couch and a round table stand in. It expects the table to cost least,
takes hold of it and pushes; the table turns about a pin that nobody saw. After a push
or two the robot is sure of that pin, and moves the couch instead.

Four panels: the room at first; what it expected of the table, as if that were free;
what happened, with its belief over kinds before and after as bars; how it ended. And a
film.

Two minutes on two cores, all but ten seconds of it compilation; `--quick` does the same
with a smaller film.
"""

# %% What to run
import argparse
import os
import pathlib

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA, of programs from disk.

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from boomdp_jax import keep_programs
from boomdp_jax.envs import room_params, room_scene, story_room
from boomdp_jax.experiments import namo_episode
from boomdp_jax.physics import State
from boomdp_jax.viz import animate, draw

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--quick", action="store_true", help="a film of fewer frames")
parser.add_argument("--out", type=pathlib.Path, default="out/namo")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)
keep_programs()  # The next run does not compile again.

# %% What the robot does, and what it expected
room = story_room(arguments.seed)
record, _ = namo_episode("physics", room, arguments.seed)
couch, table = room.things
as_expected = room._replace(things=(couch, table._replace(kind="free")))
expected, _ = namo_episode("prior", as_expected, arguments.seed)

for one in record.tries:
    name = room.things[one.thing].name
    kinds = {
        kind: round(share, 2) for kind, share in one.shares[-1].items() if share > 0
    }
    what = "opened the way" if one.opened else "did not open the way"
    print(f"{name}: {one.num_pushes} pushes, {what}; believed now: {kinds}")
print(
    f"goal reached: {record.is_solved}, after {record.seconds:.0f} s and "
    f"{record.num_pushes} pushes, {record.num_wasted} of them wasted"
)

# %% The story as one figure
spec = room_scene(room)
truth = room_params(room, spec)
first = record.tries[0]
moments = {
    "at first": (record.poses, 0, None),
    "expected": (expected.poses, expected.tries[0].end, None),
    "what happened": (record.poses, first.end, truth),
    "in the end": (record.poses, -1, truth),
}
figure = Figure(figsize=(11, 9), layout="constrained")
axes = figure.subplots(2, 2).reshape(-1)
for ax, (title, (poses, index, params)) in zip(axes, moments.items(), strict=True):
    pose = jnp.asarray(poses[index])
    draw(spec, State(pose, jnp.zeros_like(pose)), params=params, ax=ax)
    place = poses[: index + 1 if index >= 0 else None, room.num_things, :2]
    ax.plot(*place.T, color="#0072B2", linewidth=1.0)
    ax.plot(*room.goal, marker="*", markersize=14, color="#D55E00")
    ax.set(title=title, xlim=(-0.3, 8.3), ylim=(-0.3, 6.3))
    ax.set_aspect("equal", adjustable="box")
    ax.set_axis_off()

# What it believed of the table, before and after.
bars = axes[2].inset_axes([0.66, 0.62, 0.32, 0.34])
kinds = list(first.shares[0])
for offset, (shares, label, color) in enumerate(
    ((first.shares[0], "before", "#BBBBBB"), (first.shares[-1], "after", "#D55E00"))
):
    places = np.arange(len(kinds)) + 0.4 * offset
    heights = [shares[kind] for kind in kinds]
    bars.barh(places, heights, height=0.4, color=color, label=label)
bars.set_yticks(np.arange(len(kinds)) + 0.2, kinds, fontsize=7)
bars.set_title(f"belief: the {room.things[first.thing].name} is", fontsize=8)
bars.legend(fontsize=6, loc="lower right")
bars.set(xlim=(0, 1), xticks=(0, 0.5, 1))
bars.set_xlabel("probability", fontsize=7)
bars.tick_params(axis="x", labelsize=7)
path = arguments.out / "namo.png"
figure.savefig(path, dpi=110)
print(path)

# %% A film
every = 4 if arguments.quick else 1
shown = jnp.asarray(record.poses[::every])
film = arguments.out / "namo.gif"
animate(
    spec,
    State(shown, jnp.zeros_like(shown)),
    film,
    dt=0.1 * every,
    params=truth,
    fps=10,
    title="moving furniture out of the way",
)
print(film)
