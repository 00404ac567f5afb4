"""Is a policy trained on a posterior better than one trained on the likeliest world?

A bob on an arm, of unknown mass and friction of its joint, is pushed ten times and read
with noise; the arm is known. The force at hand is 0.7 to 1.4 of the bob's weight: a bob
that is light enough is carried up, a heavier one hangs where it was carried to unless
it is swung, and ten pushes leave open which it is. Brax's PPO trains a policy on worlds
drawn from the posterior, one on the most probable world and one on the truth, all alike
otherwise, and each is tried on the truth. Nobody learns any more then, and nobody sees
which world it is in.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import _repository  # noqa: F401
import jax
import jax.numpy as jnp
import numpy as np
from _report import Reporter, parser_of
from jaxtyping import PyTree

import boomdp_jax
from boomdp_jax.core.history import History, make_history
from boomdp_jax.envs import EnvParams, Pendulum
from boomdp_jax.envs.pendulum import DENSITY, FORCE_SHARE, pendulum_scene
from boomdp_jax.inference import infer_batch
from boomdp_jax.interop import BraxTask, TrainedPolicy, train_ppo
from boomdp_jax.physics import Params, SceneSpec, scene_spec_from_dict

SHARES, FRICTION = (0.7, 1.4), (0.01, 0.04)
"""Ranges of force over weight and of the joint's friction [N m s]."""
NOISE = (0.02, 0.02, 0.3, 0.5)
"""Of readings: place [m], angle [rad], velocity [m/s], spin [rad/s]."""
NUM_PUSHES, NUM_STARTS = 10, 256
UPRIGHT = 0.3
"""Near enough [rad]."""
ARMS = ("posterior", "map", "truth")


class World(NamedTuple):
    """One truth, and what was read of it."""

    share: float
    params: EnvParams
    history: History


def main() -> None:
    parser = parser_of(
        __doc__, quick="one truth, a few steps of training, no truth arm"
    )
    parser.add_argument("--truths", type=int, default=8)
    parser.add_argument("--steps", type=int, default=2_000_000, help="of training")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arms = ARMS
    if arguments.quick:
        arguments.truths, arguments.steps, arms = 1, 50_000, ARMS[:2]
    reporter = Reporter(arguments.out)
    task = Pendulum()
    worlds = [make_world(task, [arguments.seed, i]) for i in range(arguments.truths)]
    beliefs = learn(worlds, arguments.seed)
    report_beliefs(reporter, worlds, beliefs)
    returns: dict[str, list[float]] = {arm: [] for arm in arms}
    trial = None
    for number, world in enumerate(worlds):
        for arm in arms:
            start, draws = training_worlds(arm, world, *(b[number] for b in beliefs))
            policy = train_ppo(
                BraxTask(task, start),
                num_timesteps=arguments.steps,
                draws=draws,
                seed=arguments.seed + number,
                num_evals=1,
                run_evals=False,
            )
            # Networks are alike: one compiled trial takes the weights of all.
            trial = trial_of(task, policy) if trial is None else trial
            found, is_up = trial(world.params, policy.params)
            returns[arm].append(float(np.mean(found)))
            reporter.report(
                case=f"truth {number}, force {world.share:.2f} of the weight",
                metric=f"return, trained on the {arm}",
                value=returns[arm][-1],
                unit="rad",
                n=NUM_STARTS,
                spread=float(np.std(found) / np.sqrt(NUM_STARTS)),
            )
            reporter.report(
                case=f"truth {number}, force {world.share:.2f} of the weight",
                metric=f"upright at the end, trained on the {arm}",
                value=float(np.mean(is_up)),
                n=NUM_STARTS,
            )
    report_arms(reporter, returns)
    reporter.print_table()


def make_world(task: Pendulum, seed: list[int]) -> World:
    """Draw a truth, push it at random, and read it with noise."""
    rng = np.random.default_rng([31, *seed])
    share = float(np.exp(rng.uniform(*np.log(SHARES))))
    friction = float(np.exp(rng.uniform(*np.log(FRICTION))))
    params = task.default_params()
    pin = params.physics.revolute
    physics = dataclasses.replace(
        params.physics,
        density=jnp.full(1, DENSITY * FORCE_SHARE / share),
        revolute=dataclasses.replace(pin, viscous=jnp.full_like(pin.viscous, friction)),
    )
    params = dataclasses.replace(params, physics=physics)
    pushes = jnp.asarray(rng.integers(task.num_actions - 1, size=NUM_PUSHES))

    def push(state, action):
        _, after, *_ = task.step(None, state, action, params)
        return after, after.physics

    @jax.jit
    def run(key):
        _, first = task.reset(key, params)
        return first.physics, jax.lax.scan(push, first, pushes)[1]

    first, later = run(jax.random.key(int(rng.integers(2**31))))
    path = np.concatenate(
        [
            np.concatenate([np.asarray(one.pose), np.asarray(one.twist)], axis=-1)
            for one in (jax.tree.map(lambda leaf: leaf[None], first), later)
        ]
    )
    place, angle, velocity, spin = NOISE
    noise = np.array([place, place, angle, velocity, velocity, spin])
    readings = path + noise * rng.normal(size=path.shape)
    wrench = np.asarray(task.actions.wrench)[np.asarray(pushes)]
    dt = float(task.scene.dt)
    history = make_history(readings[:-1], wrench, readings[1:], dt)
    return World(share, params, history)


def what_is_open() -> SceneSpec:
    """The pendulum, of which mass and friction are to be found."""
    scene = pendulum_scene(is_known=True).to_dict()
    scene["bodies"][0]["density"] = None
    scene["constraints"][0]["viscous"] = None
    return scene_spec_from_dict(scene, "pendulum")


def learn(
    worlds: list[World], seed: int
) -> tuple[list[boomdp_jax.Posterior], list[boomdp_jax.Posterior]]:
    """Posteriors, and the most probable hypotheses."""
    key = jax.random.key(seed)
    specs, histories = [what_is_open()] * len(worlds), [w.history for w in worlds]
    return (
        infer_batch(key, specs, histories, method="smc"),
        infer_batch(key, specs, histories, method="map"),
    )


def training_worlds(
    arm: str,
    world: World,
    posterior: boomdp_jax.Posterior,
    likeliest: boomdp_jax.Posterior,
) -> tuple[EnvParams, Params | boomdp_jax.Posterior | None]:
    """The environment's own world, and draws that take its place, if any."""
    if arm == "truth":
        return world.params, None
    best = jax.tree.map(lambda leaf: leaf[0], likeliest.params)
    return (
        dataclasses.replace(world.params, physics=best),
        posterior if arm == "posterior" else None,
    )


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
    beliefs: tuple[list[boomdp_jax.Posterior], list[boomdp_jax.Posterior]],
) -> None:
    """What ten pushes told of the force as a part of the weight."""
    is_inside = []
    for number, (world, posterior, likeliest) in enumerate(
        zip(worlds, *beliefs, strict=True)
    ):
        density = np.asarray(posterior.thin(posterior.num_draws).params.density[:, 0])
        low, high = np.quantile(DENSITY * FORCE_SHARE / density, [0.05, 0.95])
        is_inside.append(low < world.share < high)
        reporter.report(
            case=f"truth {number}, force {world.share:.2f} of the weight",
            metric="force over weight, most probable; 90 % interval",
            value=float(DENSITY * FORCE_SHARE / likeliest.params.density[0, 0]),
            n=posterior.num_draws,
            spread=[float(low), float(high)],
        )
    reporter.report(
        case="all truths",
        metric="90 % intervals of force over weight that hold the truth",
        value=float(np.mean(is_inside)),
        n=len(worlds),
        target=0.9,
    )


def report_arms(reporter: Reporter, returns: dict[str, list[float]]) -> None:
    """Means over truths, and paired differences to the policy of the posterior."""
    num = len(returns["posterior"])

    def error(values: np.ndarray) -> float | None:
        return float(np.std(values, ddof=1) / np.sqrt(num)) if num > 1 else None

    for arm, values in returns.items():
        reporter.report(
            case="all truths",
            metric=f"return, trained on the {arm}",
            value=float(np.mean(values)),
            unit="rad",
            n=num,
            spread=error(np.array(values)),
        )
    gain = np.array(returns["posterior"]) - np.array(returns["map"])
    reporter.report(
        case="all truths",
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
