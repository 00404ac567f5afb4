"""Agents of a room full of pieces: each model once for each piece."""

from collections.abc import Callable

import jax

from boomdp_jax.agents.agent import Agent, random_agent
from boomdp_jax.agents.piecewise_agent import make_piecewise_agent
from boomdp_jax.envs.environment import EnvParams
from boomdp_jax.envs.living_room import LivingRoom
from boomdp_jax.inference.online import OnlineBelief
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.per_body import PerBody, ScenePhysics, stacked
from boomdp_jax.models.physics_model import PhysicsModel
from boomdp_jax.models.regression import AbstractRegressor, BodyRegression
from boomdp_jax.models.true_model import Advance, TrueModel
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.step import step

# A piece is pushed a few dozen times; what it is, it has told by then.
_CAPACITY, _NUM_PARTICLES = 64, 256


def room_agent(
    name: str,
    task: LivingRoom,
    params: EnvParams,
    *,
    regressor: tuple[Callable[[], AbstractRegressor], str] | None = None,
    num_hypotheses: int = 1,
    exploration: float = 0.0,
) -> Agent:
    """An agent by its name, for a room.

    Args:
        name: `true`, `physics`, `random`, or any name of a regression.
        task: the room.
        params: its world.
        regressor: of a regression, and the frame that it sees bodies in.
        num_hypotheses: drawn from each piece's model.
        exploration: probability that a decision is any action.
    """
    if name in ("true", "random"):
        known = _known(task, params)
        if name == "random":
            return random_agent(known, task.hints.action_repeat)
        return make_piecewise_agent(name, task, known, params.goal)
    if regressor is None:
        model = _physics(task, num_hypotheses)
    else:
        models = [
            BodyRegression(spec.scene, regressor[0](), frame=regressor[1])
            for spec in task.pieces
        ]
        model = PerBody(tuple(models), stacked(models), num_hypotheses=num_hypotheses)
    return make_piecewise_agent(name, task, model, params.goal, exploration=exploration)


def _known(task: LivingRoom, params: EnvParams) -> PerBody:
    numbers = task.lone_params(params.physics)
    models: list[AbstractModel] = [
        TrueModel(_row(numbers, index), _advance(spec))
        for index, spec in enumerate(task.pieces)
    ]
    return PerBody(tuple(models), ScenePhysics(task.lone_scenes()), num_hypotheses=1)


def _physics(task: LivingRoom, num_hypotheses: int) -> PerBody:
    models = [
        PhysicsModel(
            OnlineBelief(spec, capacity=_CAPACITY, num_particles=_NUM_PARTICLES),
            _advance(spec),
        )
        for spec in task.pieces
    ]
    return PerBody(
        tuple(models),
        ScenePhysics(task.lone_scenes()),
        num_hypotheses=num_hypotheses,
        moved_freely=task.moved_freely,
    )


def _advance(spec: SceneSpec) -> Advance:
    return lambda physics, state, wrench: step(spec.scene, physics, state, wrench)[0]


def _row(tree, index: int):
    return jax.tree.map(lambda leaf: leaf[index], tree)
