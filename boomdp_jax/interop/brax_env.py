"""Every task as an environment of brax, whose `sys` is what is true of the world.

Brax's wrappers and trainers take it as one of their own: an action is a vector of
numbers between −1 and 1 (`continuous_actions`), `done` is 1 at a goal that was reached,
and when an episode's time is up is for brax's `EpisodeWrapper` to say. Its domain
randomisation replaces `env.sys` by a batch; here that is the task's `EnvParams`, so
that masses, friction, anchors, which constraints exist, goals and starts may all differ
from world to world.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import FloatScalar, Key
from boomdp_jax.envs import (
    AbstractEnvironment,
    Acrobot,
    Cart,
    EnvParams,
    EnvState,
    LivingRoom,
    Pendulum,
)
from boomdp_jax.interop.continuous_actions import ContinuousActions, continuous_actions

TASKS: dict[str, Callable[..., AbstractEnvironment]] = {
    "acrobot": Acrobot,
    "cart": Cart,
    "living_room": LivingRoom,
    "pendulum": Pendulum,
}


class BraxTask:
    """A task as a `brax.envs.Env`, counted among them from the first one made.

    `reset` and `step` are pure, for one world; a state's `pipeline_state` is the task's
    `EnvState`, its `metrics` say whether the task is `solved`, its `info` has the
    `wrench` that acted over the last step.
    """

    def __init__(
        self,
        task: AbstractEnvironment,
        params: EnvParams | None = None,
        *,
        actions: ContinuousActions | None = None,
    ):
        """Put a task before brax.

        Args:
            task: what is to be done.
            params: the world; default: the task's own.
            actions: what a policy's numbers stand for; default: what lies between the
                task's wrenches.

        Raises:
            ValueError: no task; also from `continuous_actions`.
        """
        _check_task(task)
        from brax.envs import base

        base.Env.register(BraxTask)
        self.task = task
        self.sys = task.default_params() if params is None else params
        """What is true of the world; brax's domain randomisation replaces it."""
        self.actions = continuous_actions(task.actions) if actions is None else actions

    def reset(self, rng: Key | Array) -> Any:
        """Begin an episode.

        Args:
            rng: random key, of the typed or of the raw kind.

        Returns:
            A `brax.envs.State`.
        """
        from brax.envs import base

        if not jnp.issubdtype(rng.dtype, jax.dtypes.prng_key):
            rng = jax.random.wrap_key_data(rng)
        obs, state = self.task.reset(rng, self.sys)
        solved = state.is_terminal.astype(obs.dtype)
        make: Any = base.State
        return make(
            pipeline_state=state,
            obs=obs,
            reward=jnp.zeros((), obs.dtype),
            done=solved,
            metrics={"solved": solved},
            info={"wrench": jnp.zeros_like(state.physics.pose)},
        )

    def step(self, state: Any, action: Float[Array, " number"]) -> Any:
        """Act for one time step of the task.

        Args:
            state: a `brax.envs.State`.
            action: numbers between −1 and 1.

        Returns:
            The next state; entries that wrappers made in `metrics` and `info` are kept.

        Raises:
            ValueError: an action of more or fewer numbers than `action_size`.
        """
        before: EnvState = state.pipeline_state
        wrench = self.actions.wrench(action).astype(before.physics.pose.dtype)
        obs, after, reward, _, ends = self.task.push(before, wrench, self.sys)
        solved = ends["terminal"].astype(obs.dtype)
        return state.replace(
            pipeline_state=after,
            obs=obs,
            reward=reward,
            done=solved,
            metrics={**state.metrics, "solved": solved},
            info={**state.info, "wrench": wrench},
        )

    @property
    def observation_size(self) -> int:
        """Numbers that a policy is told."""
        obs, _ = jax.eval_shape(self.task.reset, jax.random.key(0), self.sys)
        return obs.shape[-1]

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return self.actions.size

    @property
    def backend(self) -> str:
        """Whose physics it is: `boomdp_jax`."""
        return "boomdp_jax"

    @property
    def dt(self) -> FloatScalar:
        """Time that a step takes [s]."""
        return self.task.scene.dt

    @property
    def unwrapped(self) -> "BraxTask":
        """Itself."""
        return self


def _check_task(task: object) -> None:
    if not isinstance(task, AbstractEnvironment):
        raise ValueError(
            f"task: expected an environment, such as Pendulum(), got {task!r}"
        )


def register_brax_envs() -> None:
    """Have `brax.envs.get_environment` and `create` know all tasks.

    They are `boomdp_acrobot`, `boomdp_cart`, `boomdp_living_room` and
    `boomdp_pendulum`; options are those of the task (`num_steps`) and of `BraxTask`.
    """
    from brax import envs

    for name, make_task in TASKS.items():
        envs.register_environment(f"boomdp_{name}", _maker(make_task))


def _maker(make_task: Callable[..., AbstractEnvironment]) -> Any:
    def make(
        params: EnvParams | None = None,
        *,
        actions: ContinuousActions | None = None,
        **options: Any,
    ) -> BraxTask:
        return BraxTask(make_task(**options), params, actions=actions)

    return make
