"""Tasks and agents by the names that the command line knows them by."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import jax
from jaxtyping import Array, Float

from boomdp_jax.agents.agent import Agent, ExploreFn, make_agent, random_agent
from boomdp_jax.agents.curiosity import curious
from boomdp_jax.agents.restlessness import restless
from boomdp_jax.envs.acrobot import Acrobot
from boomdp_jax.envs.cart import Cart
from boomdp_jax.envs.environment import AbstractEnvironment, EnvParams
from boomdp_jax.envs.living_room import LivingRoom
from boomdp_jax.envs.pendulum import Pendulum
from boomdp_jax.experiments.papers_agent import papers_agent, way_leaf
from boomdp_jax.experiments.recipes import RECIPES, Recipe, Subject
from boomdp_jax.experiments.room_agents import room_agent
from boomdp_jax.experiments.sensors import with_sensors
from boomdp_jax.experiments.teaching import NUM_SAMPLES, taught, unbiased_samples
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.physics_model import PhysicsModel
from boomdp_jax.models.residual_model import ResidualPhysics
from boomdp_jax.models.true_model import TrueModel

MakeTask = Callable[..., AbstractEnvironment]

TASKS: Mapping[str, MakeTask] = MappingProxyType(
    {
        "pendulum": Pendulum,
        "cart": Cart,
        "acrobot": Acrobot,
        "living-room": LivingRoom,
    }
)
"""Each takes `num_steps`."""

_ALONG_WAYS: Mapping[str, str] = MappingProxyType(
    {"true-way": "true", "physics-way": "physics"}
)
"""Agents that are what another one is, and are told how long ways round walls are."""

TASK_OF: Mapping[str, str] = MappingProxyType(
    {
        "physics-kinds": "living-room",
        "papers": "cart",
        **dict.fromkeys(_ALONG_WAYS, "cart"),
    }
)
"""Agents that can do one task only: `physics-kinds` knows kinds of furniture, `papers`
plans a path to an end for one body, `true-way` and `physics-way` know the ways there
as it does."""
_NOT_IN_ROOM = ("physics-residual",)
"""Agents that cannot do the living room, where models are piece by piece."""
AGENTS = ("true", *RECIPES, *TASK_OF, "random")
"""Names of agents."""

_CAPACITY, _NUM_PARTICLES = 128, 512
_TEACHING = 2013
"""Folded into a key for what is taught, so that it is no episode's."""


def make_task(
    name: str, num_steps: int | None = None, world: str | None = None
) -> AbstractEnvironment:
    """A task by its name.

    Args:
        name: one of `TASKS`.
        num_steps: of an episode; default: the task's own.
        world: what is true instead of what agents are told, of `CART_WORLDS`; only the
            cart has any. Default: nothing.

    Returns:
        The task.

    Raises:
        ValueError: no such task or world, or fewer steps than one.
    """
    if name not in TASKS:
        raise ValueError(f"task: expected one of {', '.join(TASKS)}; got {name!r}")
    if num_steps is not None and num_steps < 1:
        raise ValueError(f"num_steps: expected at least 1, got {num_steps}")
    if world is not None and name != "cart":
        raise ValueError(f"world: expected none for {name}, got {world!r}")
    options = {"num_steps": num_steps, "world": world}
    return TASKS[name](
        **{key: value for key, value in options.items() if value is not None}
    )


def check_agent(name: str, task: AbstractEnvironment) -> None:
    """Refuse a name that is no agent's, or none of this task's.

    Raises:
        ValueError: it is none of `AGENTS`, or of another task.
    """
    if name not in AGENTS:
        raise ValueError(f"agent: expected one of {', '.join(AGENTS)}; got {name!r}")
    only = TASK_OF.get(name, task.name)
    if task.name != only:
        raise ValueError(
            f"agent: expected one that can do {task.name}; {name} does {only} alone"
        )
    if isinstance(task, LivingRoom) and name in _NOT_IN_ROOM:
        raise ValueError(
            f"agent: expected one that can do {task.name}, piece by piece; got {name!r}"
        )


def agent_of(
    name: str,
    task: AbstractEnvironment,
    params: EnvParams,
    *,
    reading_noise: Float[Array, "4"] | None = None,
) -> Agent:
    """An agent by its name, for a task.

    Args:
        name: one of `AGENTS`.
        task: what it is to do.
        params: the world; only `true` is told its numbers, all are told the goal.
        reading_noise: standard deviation of readings, as of `run_episode`: those who
            learn the physics are told of it, those who are taught beforehand have it in
            what they are taught.

    Returns:
        The agent, which knows nothing yet; those that are taught beforehand have been,
        which takes up to minutes.

    Raises:
        ValueError: no such agent, or none for this task.
    """
    check_agent(name, task)
    teaching_key = jax.random.fold_in(jax.random.key(0), _TEACHING)
    if isinstance(task, LivingRoom):
        return room_agent(name, task, params, teaching_key, reading_noise)
    leaf_fn = None
    if isinstance(task, Cart) and name in _ALONG_WAYS:
        name, leaf_fn = _ALONG_WAYS[name], way_leaf(task, params)
    if name in ("true", "random"):
        known = TrueModel(params.physics, task.happens)
        if name == "random":
            return random_agent(known, task.hints.action_repeat)
        return make_agent(
            name, task, known, params.goal, num_hypotheses=1, leaf_fn=leaf_fn
        )
    if isinstance(task, Cart) and name == "papers":
        return papers_agent(task, params)
    recipe = RECIPES[name]
    model = recipe.build(subject_of(task, reading_noise))
    if recipe.is_taught:
        sample_key, key = jax.random.split(teaching_key)
        samples = unbiased_samples(
            sample_key, task, params, reading_noise=reading_noise
        )
        model = taught(key, model, samples)
    return make_agent(
        name,
        task,
        model,
        params.goal,
        num_hypotheses=recipe.num_hypotheses,
        exploration=recipe.exploration,
        leaf_fn=leaf_fn,
        explore=_explore(recipe, task, model),
    )


def _explore(
    recipe: Recipe, task: AbstractEnvironment, model: AbstractModel
) -> ExploreFn | None:
    """What is done for what it tells."""
    if recipe.is_curious and isinstance(model, PhysicsModel):
        return curious(task, model)
    if not recipe.is_restless or not len(task.surroundings[1]):
        return None
    if isinstance(model, ResidualPhysics):
        return restless(task, lambda learnt: learnt.physics)
    return restless(task)


def subject_of(
    task: AbstractEnvironment, reading_noise: Float[Array, "4"] | None = None
) -> Subject:
    """All of a task's bodies at once, for a recipe.

    Args:
        task: what is to be done.
        reading_noise: of the sensors, which agents are told (`sensors`).
    """
    return Subject(
        spec=with_sensors(task.spec, reading_noise),
        advance=task.advance,
        moved_freely=task.moved_freely,
        halted=task.halted,
        is_bob=task.name == "pendulum",
        surroundings=task.surroundings,
        capacity=_CAPACITY,
        num_particles=_NUM_PARTICLES,
        num_samples=NUM_SAMPLES,
    )
