"""What a task is: a scene, its true numbers, actions, a reward and an end.

The face is that of gymnax: `reset(key, params)` and `step(key, state, action, params)`
are pure functions of pytrees, and what is true of the world is data, so that a
thousand worlds are one `vmap`. A planner is told the same task as functions of a
hypothesis about the world's numbers: `advance`, `reward`, `is_done`.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key
from boomdp_jax.envs.action_set import ActionSet
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State
from boomdp_jax.physics.step import step


class EnvParams(eqx.Module):
    """What is true of one world; data, for `vmap`."""

    physics: Params
    """Φ."""
    goal: Float[Array, "*batch body 3"]
    """Pose that each body is to come to [m, m, rad]; tasks may ignore parts of it."""
    start: Float[Array, "*batch body 3"]
    """Middle of the poses in which bodies start [m, m, rad]."""
    start_spread: Float[Array, "*batch body 3"]
    """Half width of the uniform law of starts, in the task's own coordinates."""


class EnvState(eqx.Module):
    """Where the bodies are, and for how long the episode has run."""

    physics: State
    time: IntScalar
    """Steps done."""
    is_terminal: BoolScalar
    """Whether the goal was reached; then nothing moves or costs any more."""


class PlanningHints(eqx.Module):
    """Settings with which a tree of sampled futures solves a task.

    Chosen on the true model, and the same for every agent.
    """

    cell_size: tuple[float, ...] = eqx.field(static=True)
    """On which states are merged, one for each of the task's coordinates."""
    stratum_size: tuple[float, ...] = eqx.field(static=True)
    depth: int = eqx.field(static=True)
    """In held actions."""
    action_repeat: int = eqx.field(static=True)
    """Steps for which an action is held in the tree."""
    capacity: int = eqx.field(static=True)
    """Nodes of a level."""


class AbstractEnvironment(abc.ABC):
    """One task, host side: compared and hashed by identity, so `jax.jit(task.step)`.

    What is written for one world, the caller batches.
    """

    name: str
    spec: SceneSpec
    """What can move, as an agent is told it: outlines, and what may exist."""
    actions: ActionSet
    num_steps: int
    """Of an episode."""
    hints: PlanningHints

    @abc.abstractmethod
    def default_params(self) -> EnvParams:
        """The world as the task is usually posed."""

    @abc.abstractmethod
    def start(self, key: Key, params: EnvParams) -> State:
        """Draw a start."""

    def advance(
        self, physics: Params, state: State, wrench: Float[Array, "body 3"]
    ) -> State:
        """One step of the world under a hypothesis, walls included: the engine's."""
        return step(self.scene, physics, state, wrench)[0]

    @abc.abstractmethod
    def reward(
        self,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        goal: Float[Array, "body 3"],
    ) -> FloatScalar:
        """Of one step, at most 0; `goal` as in `EnvParams`."""

    @abc.abstractmethod
    def is_solved(self, state: State, goal: Float[Array, "body 3"]) -> BoolScalar:
        """Whether the episode has come to its goal, where nothing costs any more."""

    @abc.abstractmethod
    def leaf_value(self, state: State, goal: Float[Array, "body 3"]) -> FloatScalar:
        """What is guessed to come after a planner's horizon."""

    @abc.abstractmethod
    def coordinates(self, state: State) -> Float[Array, " coordinate"]:
        """Numbers by which a planner tells states apart."""

    @abc.abstractmethod
    def observe(self, state: State) -> Float[Array, " number"]:
        """What a policy without physics is told."""

    def moved_freely(self, state: State, next_state: State) -> Bool[Array, " body"]:
        """Whether an observer can tell that a body touched nothing in between.

        What is learnt of a body's own numbers should rest on such steps alone. Always,
        where there is nothing to run into.
        """
        return jnp.ones(self.spec.num_bodies, bool)

    def happens(
        self, physics: Params, state: State, wrench: Float[Array, "body 3"]
    ) -> State:
        """One step of the world itself.

        That of `advance`, unless agents are told something that is not true.
        """
        return self.advance(physics, state, wrench)

    def halted(self, state: State, next_state: State) -> State:
        """Where a step ends that might run into something, as agents know it.

        Args:
            state: before.
            next_state: after, as if nothing were in the way.

        Returns:
            The next state; the very same unless a task has things that stop bodies.
        """
        del state
        return next_state

    @property
    def scene(self) -> Scene:
        """Arrays of `spec`, concrete even while something is traced."""
        with jax.ensure_compile_time_eval():
            return self.spec.scene

    @property
    def seen_spec(self) -> SceneSpec:
        """The scene of `surroundings`, for pictures."""
        return self.spec

    @property
    def surroundings(self) -> tuple[Scene, Float[Array, "other 3"]]:
        """All that can be seen, and poses of what states do not tell of, such as walls.

        The scene's first bodies are those of `scene`.
        """
        return self.scene, jnp.zeros((0, 3))

    @property
    def num_actions(self) -> int:
        """How many things can be done at each step."""
        return self.actions.num_actions

    def reset(
        self, key: Key, params: EnvParams
    ) -> tuple[Float[Array, " number"], EnvState]:
        """Begin an episode.

        Args:
            key: random key.
            params: the world.

        Returns:
            The first observation, and the state.
        """
        physics = self.start(key, params)
        state = EnvState(
            physics=physics,
            time=jnp.zeros((), jnp.int32),
            is_terminal=self.is_solved(physics, params.goal),
        )
        return self.observe(physics), state

    def step(
        self,
        key: Key | None,
        state: EnvState,
        action: IntScalar | int,
        params: EnvParams,
    ) -> tuple[
        Float[Array, " number"],
        EnvState,
        FloatScalar,
        BoolScalar,
        dict[str, BoolScalar],
    ]:
        """Do one thing; the episode is not started anew when it ends.

        Args:
            key: for worlds that are random in themselves; these are not.
            state: now.
            action: index into `actions`.
            params: the world.

        Returns:
            Observation, state, reward, whether the episode is over, and which end it
            is: `terminal` (goal reached) or `truncated` (its time is up).
        """
        del key
        return self.push(state, self.actions[action], params)

    def push(
        self, state: EnvState, wrench: Float[Array, "body 3"], params: EnvParams
    ) -> tuple[
        Float[Array, " number"],
        EnvState,
        FloatScalar,
        BoolScalar,
        dict[str, BoolScalar],
    ]:
        """What `step` does, with any wrench.

        Args:
            state: now.
            wrench: held over the step, at centres of mass [N, N, N m].
            params: the world.

        Returns:
            As `step` does.
        """
        wrench = wrench.astype(state.physics.pose.dtype)
        moved = self.happens(params.physics, state.physics, wrench)
        reward = self.reward(state.physics, wrench, moved, params.goal)
        is_over = state.is_terminal
        moved = jax.tree.map(
            lambda new, old: jnp.where(is_over, old, new), moved, state.physics
        )
        after = EnvState(
            physics=moved,
            time=state.time + 1,
            is_terminal=is_over | self.is_solved(moved, params.goal),
        )
        is_truncated = (after.time >= self.num_steps) & ~after.is_terminal
        return (
            self.observe(moved),
            after,
            jnp.where(is_over, 0.0, reward),
            after.is_terminal | is_truncated,
            {"terminal": after.is_terminal, "truncated": is_truncated},
        )


def wrapped(angle: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """The same direction, between −π and π."""
    return angle - 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))


def distance(
    place: Float[Array, "*any 2"], goal: Float[Array, "*any 2"]
) -> Float[Array, "*any"]:
    """How far it is; its gradient is finite at the goal."""
    return jnp.sqrt(jnp.sum((place - goal) ** 2, axis=-1) + 1e-12)


def uniform_near(
    key: Key, middle: Float[Array, "*any"], spread: Float[Array, "*any"]
) -> Float[Array, "*any"]:
    """Uniform within `spread` of the middle, on either side."""
    part = jax.random.uniform(key, jnp.shape(middle), middle.dtype, -1.0, 1.0)
    return middle + spread * part
