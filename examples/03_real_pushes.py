"""Push a real block a few times: how slippery is it, and where will it go next?

A robot's finger pushed a triangular block over a board fifty times, slowly, some 15 mm
each (Zhou, Paolini, Bagnell and Mason 2016, A convex polynomial force-motion model for
planar sliding; `hard_3pts2_force.csv` with columns push, time, tip_x, tip_y, fx, fy and
`hard_3pts2_poses.csv` with push, x0, y0, theta0, x1, y1, theta1). Its shape, weight and
three feet are known. What is not: how much the board rubs, and how much the finger.

Hundreds of hypotheses push the block at once, each in the engine's own contact between
finger, block and board; ten pushes give them weights. What is left then says where the
other forty pushes end. Its makers give about 4.2 N for the friction. Expect 4.5 N, as
these forces are, and ends of pushes that are right within a millimetre.

    python examples/03_real_pushes.py PATH/TO/FOLDER_WITH_THE_TWO_FILES
"""

# %% What to run
import argparse
import os
import pathlib

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA, of programs from disk.

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jax.scipy.stats import t as student
from matplotlib.figure import Figure

from boomdp_jax import keep_programs
from boomdp_jax.physics import State, empty_cache, scene_spec_from_dict, step

SOURCE = "https://github.com/robinzhoucmu/Pushing"
MASS, LOAD, DT = 1.518, 1.518 * 9.81, 0.04
"""Of the block [kg], its weight [N]; length of a step [s]."""
TIP, FINGER = 1e-3, 1e5
"""Radius of the finger's tip [m]; a mass [kg] so large that it goes its own way."""
CORNERS = [[-0.05, -0.05], [0.10, -0.05], [-0.05, 0.10]]
FEET = [[-0.04, -0.04], [-0.04, 0.08], [0.08, -0.04]]
POSE_NOISE = np.array([1e-3, 1e-3, 0.01])
"""How well the end of a push is predicted by hypotheses worth keeping [m, m, rad]."""

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("data", type=pathlib.Path, help="folder with the two recordings")
parser.add_argument("--quick", action="store_true", help="fewer hypotheses and pushes")
parser.add_argument("--out", type=pathlib.Path, default="out/real_pushes")
arguments = parser.parse_args()
FILES = [arguments.data / f"hard_3pts2_{what}.csv" for what in ("poses", "force")]
for file in FILES:
    if not file.is_file():
        parser.error(f"{file}: no such recording; it comes from {SOURCE}")
arguments.out.mkdir(parents=True, exist_ok=True)
keep_programs()  # The next run does not compile again.
NUM_LEARNT = 3 if arguments.quick else 10
NUM_BOARD, NUM_FINGER = (10, 6) if arguments.quick else (32, 24)

# %% The pushes, at the same instants
poses, record = (np.genfromtxt(file, delimiter=",", names=True) for file in FILES)
starts = np.stack([poses[name] for name in ("x0", "y0", "theta0")], axis=1)
ends = np.stack([poses[name] for name in ("x1", "y1", "theta1")], axis=1)
num_steps = int(max(record["time"]) / DT)
clock = DT * np.arange(num_steps + 1)
tips, forces = [], []
for push in poses["push"]:
    rows = record[record["push"] == push]
    tip, force = (
        np.stack([np.interp(when, rows["time"], rows[n]) for n in names], axis=1)
        for when, names in ((clock, ("tip_x", "tip_y")), (clock[1:], ("fx", "fy")))
    )
    # The recorded point is where finger and block touch.
    way = (tip[-1] - tip[0]) / np.linalg.norm(tip[-1] - tip[0])
    tips.append(tip - TIP * way)
    forces.append(force)
starts, tips, forces, ends = map(jnp.asarray, (starts, np.array(tips), forces, ends))

# %% The world: a block on three feet, and a finger
surface = {"friction": 0.5, "restitution": 0.0}
spec = scene_spec_from_dict(
    {
        "schema": "planar-scene-1",
        "gravity": [0.0, 0.0],
        "dt": DT,
        "bodies": [
            {
                "name": "block",
                "pose": [0.0, 0.0, 0.0],
                "shape": {"type": "polygon", "vertices": CORNERS},
                "feet": FEET,
                "density": MASS / (0.5 * 0.15**2),
                "contact": surface,
            },
            {
                "name": "finger",
                "pose": [1.0, 0.0, 0.0],
                "shape": {"type": "circle", "radius": TIP},
                "density": FINGER / (np.pi * TIP**2),
                "contact": surface,
            },
        ],
        # Stiff: at 3 mm/s the feet slip and do not creep.
        "constraints": [{"type": "ground", "a": "block", "dry": 0.3, "viscous": 1e5}],
    }
)


def push_block(hypothesis, start, tip):
    """Poses of the block after every step, and forces of the finger on it [N]."""
    board, finger = hypothesis
    params = eqx.tree_at(
        lambda p: (p.ground.dry, p.surface.friction),
        spec.params(),
        (jnp.full((2, 1), board), jnp.full(2, finger)),
    )

    def advance(carry, points):
        pose, twist, cache = carry
        here, there = points
        speed = (there - here) / DT
        state = State(
            jnp.stack([pose, jnp.append(here, 0.0)]),
            jnp.stack([twist, jnp.append(speed, 0.0)]),
        )
        after, info = step(spec.scene, params, state, jnp.zeros((2, 3)), cache=cache)
        force = FINGER * (speed - after.twist[1, :2]) / DT
        return (after.pose[0], after.twist[0], info.cache), (after.pose[0], force)

    first = (start, jnp.zeros(3), empty_cache(spec.scene))
    return jax.lax.scan(advance, first, (tip[:-1], tip[1:]))[1]


# %% Weigh hypotheses by ten pushes
board = jnp.exp(jnp.linspace(jnp.log(0.2), jnp.log(0.45), NUM_BOARD))
finger = jnp.linspace(0.05, 0.95, NUM_FINGER)
noise = jnp.exp(jnp.linspace(jnp.log(0.1), jnp.log(2.0), 12))
grid = jnp.stack(jnp.meshgrid(board, finger, indexing="ij"), axis=-1).reshape(-1, 2)
SECOND = round(1.0 / DT)


def log_likelihood(hypothesis, start, tip, force, end):
    """Of a push, for every size of the noise of forces.

    Forces of a second belong together, so one of each is taken; now and then the finger
    slips off or hesitates, hence Student's t.
    """
    pose, given = push_block(hypothesis, start, tip)
    wrong = (given - force)[::SECOND]
    of_forces = student.logpdf(wrong, 4.0, scale=noise[:, None, None]).sum((1, 2))
    return of_forces + student.logpdf(pose[-1] - end, 4.0, scale=POSE_NOISE).sum()


@jax.jit
def weigh(grid, *pushes):
    """Log likelihood of every hypothesis and noise, all pushes together."""
    of_pushes = jax.vmap(log_likelihood, in_axes=(None, 0, 0, 0, 0))
    return jax.lax.map(lambda h: of_pushes(h, *pushes).sum(0), grid, batch_size=128)


learnt = slice(0, NUM_LEARNT)
scores = weigh(grid, *(a[learnt] for a in (starts, tips, forces, ends)))
weights = jax.nn.softmax(logsumexp(scores, axis=1))
chance = np.asarray(weights.reshape(NUM_BOARD, NUM_FINGER))


def interval(values, weights):
    """Median and the middle nine tenths."""
    below = np.cumsum(weights) - 0.5 * weights
    quantiles = np.interp([0.05, 0.5, 0.95], below, values)
    return f"{quantiles[1]:.2f} ({quantiles[0]:.2f} to {quantiles[2]:.2f})"


print(f"{len(grid)} hypotheses, weighed by {NUM_LEARNT} pushes")
print(f"friction of the board   {interval(board * LOAD, chance.sum(1))} N; about 4.2 N")
print(f"friction of the finger  {interval(finger, chance.sum(0))}")

# %% Where the other pushes end, by draws from what is left
draws = jax.random.choice(jax.random.key(0), grid, (32,), p=weights)
others = slice(NUM_LEARNT, NUM_LEARNT + 5 if arguments.quick else None)


@jax.jit
def predict(draws, starts, tips):
    """Poses and forces `[draw, push, time]`."""
    return jax.lax.map(
        lambda draw: jax.vmap(push_block, in_axes=(None, 0, 0))(draw, starts, tips),
        draws,
    )


found, given = map(np.asarray, predict(draws, starts[others], tips[others]))
miss = found[:, :, -1].mean(0) - np.asarray(ends[others])
way = np.asarray(ends[others] - starts[others])
place, turn = 1e3 * np.hypot(miss[:, 0], miss[:, 1]), np.degrees(np.abs(miss[:, 2]))
print(f"{len(miss)} other pushes: median error of where they end")
print(
    f"  place {np.median(place):.1f} mm (moved "
    f"{1e3 * np.median(np.hypot(way[:, 0], way[:, 1])):.1f} mm)"
)
print(
    f"  angle {np.median(turn):.2f} degrees (turned "
    f"{np.degrees(np.median(np.abs(way[:, 2]))):.2f})"
)

# %% The figure
figure = Figure(figsize=(15, 4.6), layout="constrained")
left, middle, right = figure.subplots(1, 3)
left.pcolormesh(finger, board * LOAD, chance, cmap="Blues", shading="nearest")
left.axhline(4.2, color="tab:red", label="as its makers have it")
left.set(
    xlabel="friction of the finger",
    ylabel="friction of the board [N]",
    title=f"After {NUM_LEARNT} pushes",
)
left.legend(loc="upper right")
measured = np.linalg.norm(np.asarray(forces[others]), axis=-1)
expected = np.linalg.norm(given.mean(0), axis=-1)
# Both touch, and the finger is on its way.
both = (measured > 0.5) & (expected > 0.5) & (np.arange(num_steps) > 0.5 * num_steps)
pushes = np.flatnonzero(both.any(axis=1))
pairs = [[np.median(f[i][both[i]]) for i in pushes] for f in (measured, expected)]
middle.plot(*pairs, "o")
middle.axline((4.0, 4.0), slope=1.0, color="grey")
middle.set(
    xlabel="measured force [N]",
    ylabel="predicted force [N]",
    title="Pushes that were not learnt, second half",
)
right.plot(1e3 * np.hypot(way[:, 0], way[:, 1]), place, "o", label="place [mm]")
right.plot(np.degrees(np.abs(way[:, 2])), turn, "s", label="angle [degrees]")
right.axline((0.0, 0.0), slope=1.0, color="grey", label="no better than staying put")
right.set(
    xlabel="how far it went",
    ylabel="error of the prediction",
    title="Ends of pushes that were not learnt",
)
right.legend(loc="upper left")
path = arguments.out / "real_pushes.png"
figure.savefig(path, dpi=110)
print(f"figure: {path}")
