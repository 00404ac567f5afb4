"""Is a policy trained on a posterior better than one trained on the likeliest world?

A bob on an arm, of unknown mass and friction of its joint, is pushed five or ten times
and read with noise; the arm is known. The force at hand is 0.7 to 1.4 of the bob's
weight: a bob that is light enough is carried up, a heavier one hangs where it was
carried to unless it is swung, and a few pushes leave open which it is. Brax's PPO
trains a policy on worlds drawn from the posterior, one on the most probable world and
one on the truth, all alike otherwise, and each is tried on the truth. Nobody learns any
more then, and nobody sees which world it is in.
"""

import dataclasses
from collections.abc import Callable

import _repository  # noqa: F401
import jax
import jax.numpy as jnp
import numpy as np
from _report import Reporter, parser_of
from _unknown_bob import World, learn, make_world
from jaxtyping import PyTree

import boomdp_jax
from boomdp_jax.envs import EnvParams, Pendulum
from boomdp_jax.envs.pendulum import DENSITY, FORCE_SHARE
from boomdp_jax.interop import BraxTask, TrainedPolicy, train_ppo
from boomdp_jax.physics import Params

NUM_STARTS, UPRIGHT = 256, 0.3
"""Starts of a trial; how near to upright is near enough [rad]."""
ARMS = ("posterior", "map", "truth")


def main() -> None:
    parser = parser_of(__doc__, quick="one truth, a few steps, no policy of the truth")
    parser.add_argument("--truths", type=int, default=8)
    parser.add_argument("--pushes", type=int, nargs="+", default=[10, 5])
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=ARMS)
    parser.add_argument("--steps", type=int, default=2_000_000, help="of training")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.truths, arguments.steps = 1, 50_000
        arguments.pushes, arguments.arms = [5], ARMS[:2]
    reporter, trials = Reporter(arguments.out), Trials(Pendulum(), arguments)
    for num_pushes in arguments.pushes:
        worlds = [
            make_world(trials.task, arguments.seed, number, num_pushes)
            for number in range(arguments.truths)
        ]
        posteriors, likeliest = learn(worlds, arguments.seed)
        report_beliefs(reporter, worlds, posteriors, likeliest)
        returns: dict[str, list[float]] = {arm: [] for arm in arguments.arms}
        for world, posterior, best in zip(worlds, posteriors, likeliest, strict=True):
            for arm in arguments.arms:
                found, is_up = trials.run(arm, world, posterior, best)
                returns[arm].append(float(np.mean(found)))
                reporter.report(
                    case=world.case,
                    metric=f"return, trained on the {arm}",
                    value=returns[arm][-1],
                    unit="rad",
                    n=NUM_STARTS,
                    spread=float(np.std(found) / np.sqrt(NUM_STARTS)),
                )
                reporter.report(
                    case=world.case,
                    metric=f"upright at the end, trained on the {arm}",
                    value=float(np.mean(is_up)),
                    n=NUM_STARTS,
                )
        report_arms(reporter, f"{num_pushes} pushes, all truths", returns)
    reporter.print_table()


class Trials:
    """Trains policies and tries each on the truth, from the same starts every time."""

    def __init__(self, task: Pendulum, arguments):
        self.task = task
        self._arguments = arguments
        self._try_out = None
        self._of_truth: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def run(
        self,
        arm: str,
        world: World,
        posterior: boomdp_jax.Posterior,
        likeliest: boomdp_jax.Posterior,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return of each start [rad], and whether the bob ends upright."""
        if arm == "truth":
            # The same however much is read.
            if world.number not in self._of_truth:
                found = self._train_and_try(world, world.params.physics, None)
                self._of_truth[world.number] = found
            return self._of_truth[world.number]
        best = jax.tree.map(lambda leaf: leaf[0], likeliest.params)
        return self._train_and_try(world, best, posterior if arm == ARMS[0] else None)

    def _train_and_try(
        self, world: World, physics: Params, draws: boomdp_jax.Posterior | None
    ) -> tuple[np.ndarray, np.ndarray]:
        start = dataclasses.replace(world.params, physics=physics)
        policy = train_ppo(
            BraxTask(self.task, start),
            num_timesteps=self._arguments.steps,
            draws=draws,
            seed=self._arguments.seed + world.number,
            num_evals=1,
            run_evals=False,
        )
        if self._try_out is None:
            # Networks are alike: one compiled trial takes the weights of all.
            self._try_out = trial_of(self.task, policy)
        found, is_up = self._try_out(world.params, policy.params)
        return np.asarray(found), np.asarray(is_up)


def trial_of(
    task: Pendulum, policy: TrainedPolicy
) -> Callable[[EnvParams, PyTree], tuple[jax.Array, jax.Array]]:
    """Try policies of equal networks on a world, from the same starts each time.

    Returns:
        A function of the world and of a policy's `params`: return of each start [rad],
        and whether the bob ends within `UPRIGHT` of upright.
    """
    repeat = task.hints.action_repeat
    keys = jax.random.split(jax.random.key(99), NUM_STARTS)

    @jax.jit
    def run(params: EnvParams, weights: PyTree):
        env = BraxTask(task, params)
        act = policy.make_policy(weights, deterministic=True)

        def decide(state, _):
            action, _ = act(state.obs, jax.random.key(0))

            def hold(state, _):
                state = jax.vmap(env.step)(state, action)
                return state, state.reward

            return jax.lax.scan(hold, state, None, length=repeat)

        state = jax.vmap(env.reset)(keys)
        _, rewards = jax.lax.scan(decide, state, None, length=task.num_steps // repeat)
        return jnp.sum(rewards, axis=(0, 1)), rewards[-1, -1] > -UPRIGHT

    return run


def report_beliefs(
    reporter: Reporter,
    worlds: list[World],
    posteriors: list[boomdp_jax.Posterior],
    likeliest: list[boomdp_jax.Posterior],
) -> None:
    """What pushes told of the force as a part of the weight."""
    is_inside = []
    for world, posterior, best in zip(worlds, posteriors, likeliest, strict=True):
        density = np.asarray(posterior.thin(posterior.num_draws).params.density[:, 0])
        low, high = np.quantile(DENSITY * FORCE_SHARE / density, [0.05, 0.95])
        is_inside.append(low < world.share < high)
        reporter.report(
            case=world.case,
            metric="force over weight, most probable; 90 % interval",
            value=float(DENSITY * FORCE_SHARE / best.params.density[0, 0]),
            n=posterior.num_draws,
            spread=[float(low), float(high)],
        )
    reporter.report(
        case=f"{worlds[0].case.split(',')[0]}, all truths",
        metric="90 % intervals of force over weight that hold the truth",
        value=float(np.mean(is_inside)),
        n=len(worlds),
        target=0.9,
    )


def report_arms(reporter: Reporter, case: str, returns: dict[str, list[float]]) -> None:
    """Means over truths, and what the posterior gains over the most probable world."""
    num = len(next(iter(returns.values())))

    def error(values: np.ndarray) -> float | None:
        return float(np.std(values, ddof=1) / np.sqrt(num)) if num > 1 else None

    for arm, values in returns.items():
        reporter.report(
            case=case,
            metric=f"return, trained on the {arm}",
            value=float(np.mean(values)),
            unit="rad",
            n=num,
            spread=error(np.array(values)),
        )
    if not {"posterior", "map"} <= returns.keys():
        return
    gain = np.array(returns["posterior"]) - np.array(returns["map"])
    reporter.report(
        case=case,
        metric="return gained by training on the posterior",
        value=float(np.mean(gain)),
        unit="rad",
        n=num,
        spread=error(gain),
        peer="trained on the most probable world",
        peer_value=float(np.mean(returns["map"])),
    )


if __name__ == "__main__":
    main()
