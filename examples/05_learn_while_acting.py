"""Who learns while acting: one task for an agent that knows it and ones that learn.

Every agent plans in the same way and differs in its model alone: the true numbers, an
online posterior over physics and structure, or a regression. Runs go to folders that
the same command takes up again, so that more seeds can be added to what is there.

Expect, on the cart round a wall, the physics agent to be a few steps behind the one
that is told everything, and regressions to wander; in the living room, physics to put
twelve pieces in their places at nearly the pace of the one that knows them. It prints
the table that `python -m boomdp_jax plot` prints, writes its figure, and a film of the
last agent.

On two cores `cart` takes about five minutes, most of it compilation, `living-room` a
quarter of an hour; `--quick` runs a short cart episode of agents that compile soon.
"""

# %% What to run
import argparse
import pathlib

from boomdp_jax.cli.main import main
from boomdp_jax.experiments import AGENTS, TASKS

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--task", choices=list(TASKS), default="cart")
parser.add_argument("--agents", nargs="+", choices=AGENTS, metavar="NAME")
parser.add_argument("--seeds", type=int, default=3)
parser.add_argument("--steps", type=int, default=100)
parser.add_argument("--quick", action="store_true", help="one seed, no physics agent")
parser.add_argument("--out", type=pathlib.Path, help="default: out/...")
arguments = parser.parse_args()

# Episodes of another length are another run.
name = "learn_while_acting_quick" if arguments.quick else "learn_while_acting"
out = arguments.out or pathlib.Path("out") / name
agents = arguments.agents or ["true", "lwr", "physics"]
num_seeds, num_steps = arguments.seeds, arguments.steps
if arguments.quick:
    agents, num_seeds, num_steps = ["lwr", "true"], 1, 30

# %% Run every agent, each in a folder of its own
folders = []
for agent in agents:
    folder = out / f"{arguments.task}-{agent}"
    options = ["--seeds", str(num_seeds), "--steps", str(num_steps)]
    status = main(
        ["run", arguments.task, "--agent", agent, *options, "--out", str(folder)]
    )
    if status:
        raise SystemExit(status)
    folders.append(str(folder))

# %% Curves and table
status = main(["plot", *folders, "--out", str(out / "curves.png")])
if status:
    raise SystemExit(status)

# %% A film of the last agent's first episode
film = out / f"{arguments.task}-{agents[-1]}.gif"
status = main(["view", folders[-1], "--out", str(film)])
if status:
    raise SystemExit(status)
print(film)
