"""Policies for tasks by brax's trainer of proximal policy optimisation.

Schulman et al. (2017), Proximal Policy Optimization Algorithms, as `brax` has it, with
networks and batches that suit tasks of a few numbers on a processor: the pendulum is
swung up and kept there after a minute on two cores.

Brax 0.14 calls `jax.device_put_replicated`, which jax 0.10 refuses (google/brax#671).
While this trains, and only then, the trainer's module sees a jax that has it again.
"""

import contextlib
import functools
from collections.abc import Callable, Generator, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.interop.brax_env import BraxTask
from boomdp_jax.interop.brax_posterior import task_randomisation
from boomdp_jax.physics.params import Params

_AXIS = "i"
"""What brax calls the axis of devices; arrays placed along an axis of that name already
lie as its next step leaves them, so that the step is compiled once."""
_OPTIONS: dict[str, Any] = {
    "num_envs": 128,
    "unroll_length": 16,
    "batch_size": 128,
    "num_minibatches": 8,
    "num_updates_per_batch": 4,
    "num_eval_envs": 64,
    "num_evals": 2,
    "learning_rate": 1e-3,
    "entropy_cost": 1e-3,
    "discounting": 0.97,
    "reward_scaling": 0.1,
    "normalize_observations": True,
    "max_grad_norm": 1.0,
    "deterministic_eval": True,
}
_HIDDEN = (64, 64)


class TrainedPolicy(NamedTuple):
    """What brax's `train` returns."""

    make_policy: Callable[..., Any]
    """Of `params`, and `deterministic`: a function of observation and key."""
    params: PyTree
    """Statistics of observations, weights of the policy and of the value."""
    metrics: dict[str, Any]
    """Of the last evaluation; `eval/episode_reward` is the mean return."""

    def act(self, obs: Float[Array, "*batch seen"]) -> Float[Array, "*batch number"]:
        """The likeliest action, numbers between −1 and 1."""
        policy = self.make_policy(self.params, deterministic=True)
        return policy(obs, jax.random.key(0))[0]


def train_ppo(
    env: BraxTask,
    *,
    num_timesteps: int = 2_000_000,
    draws: Params | Posterior | None = None,
    **options: Any,
) -> TrainedPolicy:
    """Train a policy on a task.

    Args:
        env: the task.
        num_timesteps: steps of all worlds together; 0: an untrained policy.
        draws: hypotheses with one leading axis, or a posterior: each of the worlds
            trained in is one of them; default: all are the environment's own.
        options: further ones of `brax.training.agents.ppo.train.train`, such as
            `seed`, `num_envs`, `progress_fn`; unless given, `episode_length` is the
            task's number of steps and `action_repeat` that of its planning hints.

    Returns:
        The policy; unpacks like what brax's `train` returns.

    Raises:
        TypeError: a task that is not a `BraxTask`; also from `task_randomisation`.
        ValueError: less than no time steps; also from `task_randomisation`.
    """
    from brax.training.agents.ppo import networks

    # Wrappers of brax are let through.
    if not isinstance(getattr(env, "unwrapped", env), BraxTask):
        raise TypeError(f"env: expected a BraxTask, got {type(env).__name__}")
    if num_timesteps < 0:
        raise ValueError(f"num_timesteps: expected at least 0, got {num_timesteps}")
    factory = functools.partial(
        networks.make_ppo_networks,
        policy_hidden_layer_sizes=_HIDDEN,
        value_hidden_layer_sizes=_HIDDEN,
    )
    chosen = {
        "network_factory": factory,
        "episode_length": env.task.num_steps,
        "action_repeat": env.task.hints.action_repeat,
        **_OPTIONS,
        **options,
    }
    if draws is not None:
        chosen["randomization_fn"] = task_randomisation(draws, task=env.task)
    with _mended_trainer() as trainer:
        return TrainedPolicy(*trainer.train(env, num_timesteps, **chosen))


@contextlib.contextmanager
def _mended_trainer() -> Generator[Any]:
    """Brax's trainer, with a jax of its own while it is in use."""
    from brax.training.agents.ppo import train

    trainer: Any = train
    own = trainer.jax
    trainer.jax = _JaxWithReplication(own)
    try:
        yield trainer
    finally:
        trainer.jax = own


class _JaxWithReplication:
    """The module `jax`, and the function that it dropped."""

    def __init__(self, module: ModuleType):
        self._module = module

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    @staticmethod
    def device_put_replicated(tree: PyTree, devices: Sequence[jax.Device]) -> PyTree:
        """A copy for each device, along a leading axis."""
        mesh = jax.sharding.Mesh(np.array(devices), (_AXIS,))
        along = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(_AXIS))

        def replicate(leaf: Any) -> Array:
            copies = jnp.broadcast_to(leaf, (len(devices), *jnp.shape(leaf)))
            return jax.device_put(copies, along)

        return jax.tree.map(replicate, tree)
