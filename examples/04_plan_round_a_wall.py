"""Which way round? Plan for a cart that cannot go sideways, behind a wall.

A cart with fixed wheels at its handle stands in the papers' room (1 pixel there is 1 cm
here). Its goal is straight ahead, behind a wall; whoever goes by distance runs into it.
The planner knows the cart as a model only, a function from a state and a push to the
next state, and merges what is alike, so that it looks 28 pushes ahead in a few
thousand calls of the model.

Expect the cart to go up through one gap, to the right and down through another, without
a map, and a picture of the tree of the first decision: colours are levels, large dots
are states that many paths share, the red branch is the plan.

Takes about half a minute on two cores, most of it compilation; `--quick` plans with a
quarter of the nodes.
"""

# %% What to run
import argparse
import json
import os
import pathlib
import time

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA, of programs from disk.

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import boomdp_jax
from boomdp_jax.planning import certain, tree_levels
from boomdp_jax.viz import draw_tree

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--quick", action="store_true", help="16 nodes a level, not 64")
parser.add_argument("--seed", type=int, default=0)
parser.add_argument("--out", type=pathlib.Path, default="out/plan_round_a_wall")
arguments = parser.parse_args()
arguments.out.mkdir(parents=True, exist_ok=True)
boomdp_jax.keep_programs()  # The next run does not compile again.

GOAL, START = np.array([5.28, 1.38]), [1.75, 1.34, 0.4]
HALF_LENGTH, HALF_WIDTH = 0.50, 0.28
WALLS = np.array(  # x0, y0, x1, y1 [m]
    [
        [-1.0, -1.0, 0.06, 5.8],
        [6.34, -1.0, 7.4, 5.8],
        [-1.0, -1.0, 7.4, 0.06],
        [-1.0, 4.74, 7.4, 5.8],
        [3.1, 0.0, 3.3, 2.88],
        [3.1, 4.32, 3.3, 4.79],
        [0.0, 2.3, 0.64, 2.5],
        [2.56, 2.3, 3.84, 2.5],
        [5.76, 2.3, 6.4, 2.5],
    ]
)

# %% The cart: a box whose wheels roll along it and hardly slide across
scene_file = arguments.out / "cart.json"
box = {"type": "box", "half_extents": [HALF_LENGTH, HALF_WIDTH]}
wheel = {"type": "wheel", "a": "cart", "pose": [-0.4, 0, 0], "viscous": [30.0, 600.0]}
body = {"name": "cart", "pose": START, "shape": box, "density": 10.0}
scene_file.write_text(
    json.dumps(
        {
            "schema": "planar-scene-1",
            "gravity": [0.0, 0.0],
            "dt": 0.1,
            "bodies": [body],
            "constraints": [wheel],
        }
    )
)
spec = boomdp_jax.load_scene(scene_file)


# %% What the planner is told: a model, a reward, eight pushes
def hits_wall(pose):
    x, y, angle = pose
    along = HALF_LENGTH * jnp.array([1, 1, 1, 0, -1, -1, -1, 0])
    across = HALF_WIDTH * jnp.array([-1, 0, 1, 1, 1, 0, -1, -1])
    px = x + jnp.cos(angle) * along - jnp.sin(angle) * across
    py = y + jnp.sin(angle) * along + jnp.cos(angle) * across
    x0, y0, x1, y1 = WALLS.T[..., None]
    return jnp.any((px > x0) & (px < x1) & (py > y0) & (py < y1))


def distance(state):
    return jnp.linalg.norm(state.pose[0, :2] - GOAL)


def transition(key, params, state, push):
    wrench = jnp.zeros((1, 3)).at[0, :2].set(push)

    def one(_, state):
        moved, _ = boomdp_jax.step(spec.scene, params, state, wrench)
        stops = hits_wall(moved.pose[0])
        pose = jnp.where(stops, state.pose, moved.pose)
        return boomdp_jax.State(pose, jnp.where(stops, 0.0, moved.twist))

    state = jax.lax.fori_loop(0, 4, one, state)
    return state, distance(state) < 0.35


def reward(params, state, push, after):
    return -distance(after)


directions = np.arange(8) * np.pi / 4


@jax.jit
def decide(key, state, previous=None):
    return boomdp_jax.sparse_sampling(
        key,
        certain(spec.params()),
        state,
        transition_fn=transition,
        reward_fn=reward,
        actions=30.0 * np.stack([np.cos(directions), np.sin(directions)], 1),
        depth=14,
        action_repeat=2,
        cell_size=np.array([0.25, 0.25, 0.8]),
        stratum_size=np.array([1.0, 1.0, np.inf]),
        coordinates_fn=lambda s: s.pose[0],
        capacity=16 if arguments.quick else 64,
        verify=True,
        previous=previous,
        keep_tree=True,
    )


# %% Drive
state, done, path, plans = spec.initial_state(), False, [START[:2]], []
seconds = []
for number in range(20):
    begin = time.perf_counter()
    plan = decide(jax.random.key(arguments.seed + number), state, *plans[-1:])
    seconds.append(time.perf_counter() - begin)
    plans.append(jax.block_until_ready(plan))
    for _ in range(2):
        if not done:
            state, done = transition(None, spec.params(), state, plan.action)
            path.append(np.asarray(state.pose[0, :2]).tolist())
    if done:
        break

info = plans[0].info
print(f"reached the goal: {bool(done)}, after {len(path) - 1} pushes")
print(f"model calls a decision: {int(info.num_model_calls)}")
print(f"time a decision, median: {1e3 * np.median(seconds):.1f} ms")
print(f"nodes, by level: {np.asarray(info.num_nodes[0]).tolist()}")
print(f"merged, by level: {np.asarray(info.num_merged[0]).tolist()}")

# %% The tree of the first decision, and the way that was taken
figure = Figure(figsize=(11, 4.2), layout="constrained")
panels = figure.subplots(1, 2, sharex=True, sharey=True)
points = draw_tree(panels[0], tree_levels(plans[0]), lambda s: s.pose[0, :2])
figure.colorbar(points, ax=panels[0], label="level")
panels[0].set_title("the tree of the first decision")
panels[1].plot(*np.array(path).T, ".-", color="crimson")
panels[1].set_title("the way that was taken")
for axes in panels:
    for x0, y0, x1, y1 in WALLS:
        axes.fill([x0, x1, x1, x0], [y0, y0, y1, y1], color="0.25", zorder=4)
    axes.plot(*GOAL, "*", color="gold", markeredgecolor="k", markersize=16, zorder=5)
    axes.set(xlim=(0, 6.4), ylim=(0, 4.8), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
figure.savefig(arguments.out / "tree.png", dpi=110)
print(f"wrote {arguments.out / 'tree.png'}")
