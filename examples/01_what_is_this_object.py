"""What is this object? Push it a few times, and know.

Four boxes look much the same from above. One is free, one is pinned to the floor, one
stands on a fixed wheel, one hangs from a nail in a vertical plane. MuJoCo pushes each
of them for two seconds and writes down noisy positions and speeds (1 mm, 1 mrad,
5 mm/s, 5 mrad/s). From these files alone we ask: is it pinned, and where? Does it roll,
and which way? How heavy is it? And what will it do next?

Expect each object's true structure to get nearly all of the probability, its pin to a
millimetre, its axle line to a few, its mass to one per cent. A wheel slid
along its own axle looks the same: its place along the axle stays open, and says so.

Needs MuJoCo and matplotlib (`pip install 'boomdp_jax[test]'`). Takes about a minute on
two cores; `--quick` looks at two of the objects.
"""

# %% What to run
import argparse
import os
import pathlib

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA, of programs from disk.

import jax
import numpy as np
from matplotlib.figure import Figure

import boomdp_jax
from boomdp_jax.core.history_file import save_transitions
from boomdp_jax.interop.object_families import hide, random_object, record_random_pushes
from boomdp_jax.interop.recording import with_reading_noise
from boomdp_jax.physics.scene_file import save_scene
from boomdp_jax.viz import draw_posterior, draw_prediction, draw_structure_bars

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--quick", action="store_true", help="two objects instead of four")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--out", type=pathlib.Path, default="out/what_is_this_object")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)
boomdp_jax.keep_programs()  # The next run does not compile again.

FAMILIES = (
    ("table", "cart") if arguments.quick else ("box", "table", "cart", "pendulum")
)
NUM_LEARN, NUM_EPISODES, EPISODE = 100, 6, 25
"""Rows to learn from, runs from rest, rows in each; the last two runs are held out."""


# %% Recordings, as a camera and a force sensor would leave them
def write_rows(path: pathlib.Path, table, rows: slice) -> None:
    save_transitions(
        path,
        state=table.state[rows],
        action=table.action[rows],
        next_state=table.next_state[rows],
        dt=table.dt[rows],
        episode=table.episode[rows],
    )


truths = []
for number, family in enumerate(FAMILIES):
    rng = np.random.default_rng([arguments.seed, number])
    truth = random_object(rng, family)
    table = record_random_pushes(
        rng, truth, NUM_EPISODES * EPISODE, num_episodes=NUM_EPISODES
    )
    table = with_reading_noise(rng, table)
    save_scene(hide(truth), arguments.out / f"{family}.json")
    write_rows(arguments.out / f"{family}_seen.npz", table, slice(0, NUM_LEARN))
    write_rows(arguments.out / f"{family}_later.npz", table, slice(NUM_LEARN, None))
    truths.append(truth)

# %% The public API: what is seen, what happened, what is true
folder = arguments.out
specs, seen, later = [], [], []
for family in FAMILIES:
    spec = boomdp_jax.load_scene(folder / f"{family}.json")
    specs.append(spec)
    seen.append(boomdp_jax.load_history(folder / f"{family}_seen.npz", spec=spec))
    later.append(boomdp_jax.load_history(folder / f"{family}_later.npz", spec=spec))

posteriors = boomdp_jax.infer_batch(
    jax.random.key(arguments.seed), specs, seen, progress=True
)

# %% The table
for family, truth, posterior in zip(FAMILIES, truths, posteriors, strict=True):
    print(f"\n=== {family} ===\n{posterior.summary()}")
    body = truth.bodies[0]
    print(f"truth: mass {body.density * body.area:.4g} kg")
    for constraint in truth.constraints:
        numbers = ", ".join(
            f"{name} {np.array2string(value, precision=4)}"
            for name, value in constraint.numbers.items()
        )
        print(f"truth: {constraint.kind}: {numbers}")

# %% The figure: one row for each object
figure = Figure(figsize=(15, 4.6 * len(FAMILIES)), layout="constrained")
axes = figure.subplots(len(FAMILIES), 3, squeeze=False)
rows = zip(axes, FAMILIES, truths, posteriors, later, strict=True)
for (left, middle, right), family, truth, posterior, history in rows:
    draw_posterior(left, posterior, truth=truth.params())
    draw_structure_bars(middle, posterior)
    draw_prediction(right, posterior, history, num_steps=EPISODE)
    left.set_title(f"{family} ({left.get_title()})", fontsize=10)
    middle.set_title(f"{family}: which structure?", fontsize=10)
    right.set_title(f"{family}: predicted against held-out motion", fontsize=10)
path = arguments.out / "what_is_this_object.png"
figure.savefig(path, dpi=110)
print(f"\nfigure: {path}")
