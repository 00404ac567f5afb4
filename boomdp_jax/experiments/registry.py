"""Tasks and agents by the names that the command line knows them by."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from boomdp_jax.agents.agent import Agent, make_agent, random_agent
from boomdp_jax.envs.acrobot import Acrobot
from boomdp_jax.envs.cart import Cart
from boomdp_jax.envs.environment import AbstractEnvironment, EnvParams
from boomdp_jax.envs.living_room import LivingRoom
from boomdp_jax.envs.pendulum import Pendulum
from boomdp_jax.experiments.room_agents import room_agent
from boomdp_jax.inference.online import OnlineBelief
from boomdp_jax.models.gaussian_process import GaussianProcess
from boomdp_jax.models.linear import LinearRegression
from boomdp_jax.models.locally_weighted import LocallyWeighted
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.neural_ensemble import NeuralEnsemble
from boomdp_jax.models.physics_model import PhysicsModel
from boomdp_jax.models.regression import AbstractRegressor, BodyRegression
from boomdp_jax.models.residual_model import ResidualPhysics
from boomdp_jax.models.true_model import TrueModel

MakeTask = Callable[..., AbstractEnvironment]
MakeModel = Callable[[AbstractEnvironment, EnvParams], AbstractModel]

TASKS: Mapping[str, MakeTask] = MappingProxyType(
    {
        "pendulum": Pendulum,
        "cart": Cart,
        "acrobot": Acrobot,
        "living-room": LivingRoom,
    }
)
"""Each takes `num_steps`."""

_CAPACITY, _NUM_PARTICLES = 128, 512
_NUM_HYPOTHESES = 4
_EXPLORATION = 0.1
"""Of agents that learn one law: without it, some push against one wall for ever."""


def _true(task: AbstractEnvironment, params: EnvParams) -> AbstractModel:
    return TrueModel(params.physics, task.happens)


def _physics(task: AbstractEnvironment, params: EnvParams) -> AbstractModel:
    online = OnlineBelief(task.spec, capacity=_CAPACITY, num_particles=_NUM_PARTICLES)
    return PhysicsModel(online, task.advance, task.moved_freely)


def _residual(task: AbstractEnvironment, params: EnvParams) -> AbstractModel:
    return ResidualPhysics(
        _physics(task, params),
        task.scene,
        moved_freely=task.moved_freely,
        halted=task.halted,
    )


def _regression(make: Callable[[], AbstractRegressor], frame: str) -> MakeModel:
    def build(task: AbstractEnvironment, params: EnvParams) -> AbstractModel:
        # The papers' pendulum is seen without its angle: x, y and their rates.
        is_bob = task.name == "pendulum"
        return BodyRegression(
            task.spec.scene,
            make(),
            frame="world" if is_bob else frame,
            angles=not is_bob,
        )

    return build


_REGRESSIONS: dict[str, tuple[Callable[[], AbstractRegressor], str]] = {
    "lr": (LinearRegression, "world"),
    "lwr": (LocallyWeighted, "body"),
    "gp": (GaussianProcess, "body"),
    "ensemble": (NeuralEnsemble, "body"),
}
"""What is fitted, and the frame that bodies are seen in."""

_MODELS: dict[str, tuple[MakeModel, int]] = {
    "true": (_true, 1),
    "physics": (_physics, _NUM_HYPOTHESES),
    "physics-residual": (_residual, _NUM_HYPOTHESES),
    "lr": (_regression(*_REGRESSIONS["lr"]), 1),
    "lwr": (_regression(*_REGRESSIONS["lwr"]), 1),
    "gp": (_regression(*_REGRESSIONS["gp"]), 1),
    "ensemble": (_regression(*_REGRESSIONS["ensemble"]), _NUM_HYPOTHESES),
}
"""Model, and hypotheses that a decision rests on."""

AGENTS = (*_MODELS, "random")
"""Names of agents."""


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


def check_agent(name: str) -> None:
    """Refuse a name that is no agent's.

    Raises:
        ValueError: it is none of `AGENTS`.
    """
    if name not in AGENTS:
        raise ValueError(f"agent: expected one of {', '.join(AGENTS)}; got {name!r}")


def agent_of(name: str, task: AbstractEnvironment, params: EnvParams) -> Agent:
    """An agent by its name, for a task.

    Args:
        name: one of `AGENTS`.
        task: what it is to do.
        params: the world; only `true` is told its numbers, all are told the goal.

    Returns:
        The agent, which knows nothing yet.

    Raises:
        ValueError: no such agent, or none of this task.
    """
    check_agent(name)
    if isinstance(task, LivingRoom):
        if name == "physics-residual":
            raise ValueError(f"agent: expected one for the living room, got {name!r}")
        num = 1 if name == "random" else _MODELS[name][1]
        is_one_law = name in _REGRESSIONS and num == 1
        return room_agent(
            name,
            task,
            params,
            regressor=_REGRESSIONS.get(name),
            num_hypotheses=num,
            exploration=_EXPLORATION if is_one_law else 0.0,
        )
    if name == "random":
        return random_agent(_true(task, params), task.hints.action_repeat)
    build, num_hypotheses = _MODELS[name]
    model = build(task, params)
    is_one_law = name != "true" and num_hypotheses == 1
    return make_agent(
        name,
        task,
        model,
        params.goal,
        num_hypotheses=num_hypotheses,
        exploration=_EXPLORATION if is_one_law else 0.0,
    )
