"""How do agents fare on the cart where the world is not what they are told?

In each world one thing differs from what an agent's scene can say (`cart_worlds`): dry
friction, a centre of mass elsewhere, a caster, an outline told wrong. `true` knows the
world; `physics` finds what its scene allows; `physics-residual` learns besides what
that misses; `lwr` knows no physics. Of each: reward lost to `true`, steps until the
mean reward stays within 5.4 % of its first value, and the error of one-step predictions
with what was learnt in the episode, on a drive that nobody has seen, the same for all.
Then `infer` is given what the `physics` agent saw of free motion, and some rows of
another drive at random: is it ok, and which law does it say that its model lacks?
"""

import sys
import time
from typing import NamedTuple

import _repository  # noqa: F401
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _report import Reporter, parser_of

from boomdp_jax.agents import EpisodeRecord, run_episode
from boomdp_jax.core.history import History, make_history
from boomdp_jax.envs import CART_WORLDS, Cart
from boomdp_jax.experiments import agent_of
from boomdp_jax.experiments.scores import CART_MARKS, mark_step
from boomdp_jax.inference import infer_batch
from boomdp_jax.inference.doubts.residual import FEWEST_ROWS
from boomdp_jax.models import AbstractModel
from boomdp_jax.physics import State, state_from_array
from boomdp_jax.planning import Belief

AGENTS = ("true", "physics", "physics-residual", "lwr")
_NUM_DRIVES, _DRIVE_STEPS, _HELD = 12, 40, 4
_CAPACITY = 64


class Told(NamedTuple):
    """What one world came to."""

    task: Cart
    seen: list[History]
    """By the `physics` agent, of free motion, one for each seed."""
    drive: History
    """At random."""


def main() -> None:
    parser = parser_of(
        __doc__, quick="one seed, 8 steps, one world, two agents, nothing inferred"
    )
    parser.add_argument("--worlds", nargs="+", choices=CART_WORLDS, metavar="WORLD")
    parser.add_argument("--agents", nargs="+", choices=AGENTS, default=AGENTS)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument(
        "--inferred", type=int, default=4, help="episodes of a world given to infer"
    )
    arguments = parser.parse_args()
    worlds = arguments.worlds or tuple(CART_WORLDS)
    if arguments.quick:
        arguments.seeds, arguments.steps, arguments.inferred = 1, 8, 0
        worlds, arguments.agents = ("dry",), ("true", "lwr")
    reporter = Reporter(arguments.out)
    told = {world: report_world(reporter, world, arguments) for world in worlds}
    if arguments.inferred and "physics" in arguments.agents:
        report_diagnostics(reporter, told, arguments.inferred)
    reporter.print_table()


def report_world(reporter: Reporter, world: str, arguments) -> Told:
    """All agents in one world."""
    task = Cart(num_steps=arguments.steps, world=world)
    params = task.default_params()
    *rows, _ = random_drives(task, 1000)
    drive = history_of(task, *random_drives(task, 2000))
    paid: float | None = None
    seen: list[History] = []
    for name in arguments.agents:
        agent = agent_of(name, task, params)
        records, errors = [], []
        for seed in range(arguments.seeds):
            record, learnt = run_episode(jax.random.key(seed), task, params, agent)
            records.append(record)
            print(
                f"{world}, {name}, seed {seed}: {record.num_done} steps, "
                f"return {record.reward.sum():.1f}, {time.process_time():.0f} s so far",
                file=sys.stderr,
            )
            belief = agent.model.sample(
                jax.random.key(seed), learnt, agent.num_hypotheses
            )
            errors.append(float(position_error(agent.model, belief, *rows)))
            if name == "physics":
                seen.append(free_motion(task, record))
        reward = np.stack([record.reward for record in records])
        total = reward.sum(axis=1)
        paid = -float(total.mean()) if name == "true" else paid
        case, n = f"{world}: {name}", len(total)
        report_rewards(reporter, case, reward, paid)
        reporter.report(
            case=case,
            metric="steps until the mean reward stays within 5.4 % of its first",
            value=mark_step(reward.mean(axis=0), CART_MARKS[0]),
            n=n,
        )
        reporter.report(
            case=case,
            metric="one-step error of unseen positions after the episode, median",
            value=1e3 * float(np.median(errors)),
            unit="mm",
            n=n,
            spread=[1e3 * float(q) for q in np.quantile(errors, (0.1, 0.9))],
        )
    return Told(task, seen, drive)


def report_rewards(
    reporter: Reporter, case: str, reward: np.ndarray, paid: float | None
) -> None:
    """Reward, how many came to the goal, and regret to `true` of the same world."""
    total = reward.sum(axis=1)
    n = len(total)
    error = float(total.std(ddof=1) / np.sqrt(n)) if n > 1 else None
    reporter.report(case=case, metric="return", value=total.mean(), n=n, spread=error)
    reporter.report(
        case=case,
        metric="share of episodes that came to the goal",
        value=float(np.mean(reward[:, -1] == 0)),
        n=n,
    )
    if paid is not None:
        reporter.report(
            case=case,
            metric="regret to true, share of what that paid",
            value=(-float(total.mean()) - paid) / paid,
            n=n,
        )


def random_drives(task: Cart, seed: int) -> tuple[State, jax.Array, State, np.ndarray]:
    """Free motion of the world under actions drawn at random, each held a while.

    Returns:
        States, wrenches, next states, `[row]`, and the run that a row belongs to.
    """
    params = task.default_params()

    def drive(key):
        start_key, action_key = jax.random.split(key)
        num = _DRIVE_STEPS // _HELD
        actions = jax.random.randint(action_key, (num,), 0, task.num_actions)
        wrenches = task.actions.wrench[jnp.repeat(actions, _HELD)]

        def move(state, wrench):
            after = task.happens(params.physics, state, wrench)
            return after, (state, wrench, after, task.moved_freely(state, after)[0])

        return jax.lax.scan(move, task.start(start_key, params), wrenches)[1]

    keys = jax.random.split(jax.random.key(seed), _NUM_DRIVES)
    *rows, is_free = jax.tree.map(np.asarray, jax.jit(jax.vmap(drive))(keys))
    # A run ends where its drive does, and where the cart was stopped.
    stops = np.cumsum(~is_free, axis=1) + _DRIVE_STEPS * np.arange(_NUM_DRIVES)[:, None]
    before, wrench, after = jax.tree.map(lambda leaf: jnp.asarray(leaf[is_free]), rows)
    return before, wrench, after, stops[is_free]


def history_of(
    task: Cart, before: State, wrench: jax.Array, after: State, run: np.ndarray
) -> History:
    """The first rows, as many as there is room for."""
    rows = (before.array, wrench, after.array)
    return make_history(
        *(np.asarray(leaf)[:_CAPACITY] for leaf in rows),
        float(task.scene.dt),
        episode=run[:_CAPACITY],
        capacity=_CAPACITY,
    )


@eqx.filter_jit
def position_error(
    model: AbstractModel, belief: Belief, before: State, wrench: jax.Array, after: State
) -> jax.Array:
    """Root mean square over rows, mean over hypotheses [m]."""

    def of(hypothesis):
        told = jax.vmap(
            lambda s, w: model.transition(jax.random.key(0), hypothesis, s, w)
        )(before, wrench)
        away = told.pose[:, 0, :2] - after.pose[:, 0, :2]
        return jnp.sqrt(jnp.mean(jnp.sum(away**2, axis=-1)))

    return jnp.sum(belief.weight * jax.vmap(of)(belief.hypotheses))


def free_motion(task: Cart, record: EpisodeRecord) -> History:
    """What a model of the cart alone may learn from; runs end at every touch."""
    state = record.state[: record.num_done]
    wrench = np.asarray(task.actions.wrench)[record.action[1 : len(state)]]
    before, after = (
        state_from_array(jnp.asarray(part)) for part in (state[:-1], state[1:])
    )
    is_free = np.asarray(jax.jit(jax.vmap(task.moved_freely))(before, after))[:, 0]
    rows = jax.tree.map(
        lambda leaf: leaf[is_free], (before, jnp.asarray(wrench), after)
    )
    return history_of(task, *rows, np.cumsum(~is_free)[is_free])


def report_diagnostics(reporter: Reporter, told: dict[str, Told], num: int) -> None:
    """What `infer` says of what the `physics` agents saw."""
    cases = [
        (world, what, task, history)
        for world, (task, seen, drive) in told.items()
        for what, history in [("drive", drive), *(("episode", h) for h in seen[:num])]
        if int(history.num_transitions) >= FEWEST_ROWS
    ]
    posteriors = infer_batch(
        jax.random.key(0),
        [task.spec for _, _, task, _ in cases],
        [history for *_, history in cases],
    )
    for world in told:
        for what in ("drive", "episode"):
            mine = [
                (posterior.diagnostics, int(history.num_transitions))
                for posterior, (*case, _, history) in zip(
                    posteriors, cases, strict=True
                )
                if case == [world, what]
            ]
            if mine:
                rows = [count for _, count in mine]
                case = f"{world}: infer, {what} of {min(rows)} to {max(rows)} rows"
                report_laws(reporter, case, [diagnostics for diagnostics, _ in mine])


def report_laws(reporter: Reporter, case: str, found: list[dict]) -> None:
    """How often something is said to be wrong, and what."""
    n = len(found)
    reporter.report(
        case=case,
        metric="share not ok",
        value=float(np.mean([not diagnostics["ok"] for diagnostics in found])),
        n=n,
    )
    named: dict[str, int] = {}
    for diagnostics in found:
        (entry,) = diagnostics["residual"]
        for law in entry["laws"][:1]:
            if law["log_bayes_factor"] > entry["threshold"]:
                named[law["law"]] = named.get(law["law"], 0) + 1
    laws = ", ".join(f"{law} {count} times" for law, count in named.items())
    reporter.report(
        case=f"{case}: {laws or 'no law'}",
        metric="share of which a law is named that the model lacks",
        value=sum(named.values()) / n,
        n=n,
    )


if __name__ == "__main__":
    main()
