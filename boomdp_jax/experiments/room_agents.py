"""Agents of a room full of pieces: each model once for each piece."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from boomdp_jax.agents.agent import Agent, random_agent
from boomdp_jax.agents.curiosity import curious_of_pieces
from boomdp_jax.agents.piecewise_agent import make_piecewise_agent
from boomdp_jax.core.arrays import Key
from boomdp_jax.envs.environment import EnvParams
from boomdp_jax.envs.living_room import LivingRoom
from boomdp_jax.experiments.known_furniture import furniture_kinds
from boomdp_jax.experiments.recipes import RECIPES, TOUCH_RADIUS, Recipe, Subject
from boomdp_jax.experiments.sensors import with_sensors
from boomdp_jax.experiments.teaching import taught, unbiased_samples
from boomdp_jax.models.features import BodyFeatures
from boomdp_jax.models.locally_weighted import LocallyWeighted
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.object_among_others import ObjectAmongOthers
from boomdp_jax.models.per_body import PerBody, ScenePhysics, stacked
from boomdp_jax.models.regression import BodyRegression
from boomdp_jax.models.true_model import Advance, TrueModel
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.step import step

# A piece is pushed a few dozen times; what it is, it has told by then.
_CAPACITY, _NUM_PARTICLES = 64, 256
_NUM_SAMPLES = 256
"""Most rows of a piece that is taught beforehand: the samples are of all pieces."""


def room_agent(
    name: str,
    task: LivingRoom,
    params: EnvParams,
    teaching_key: Key,
    reading_noise: Float[Array, "4"] | None = None,
) -> Agent:
    """An agent by its name, for a room.

    Args:
        name: of any agent that there is for rooms.
        task: the room.
        params: its world.
        teaching_key: of what is taught beforehand.
        reading_noise: as of `registry.agent_of`.
    """
    if name in ("true", "random"):
        known = _known(task, params)
        if name == "random":
            return random_agent(known, task.hints.action_repeat)
        return make_piecewise_agent(name, task, known, params.goal)
    if name == "oo-lwr":
        models = _among_others(task)
        model = PerBody(
            models, stacked(list(models)), num_hypotheses=1, sees_others=True
        )
        exploration = RECIPES[name].exploration
        return make_piecewise_agent(
            name, task, model, params.goal, exploration=exploration
        )
    if name == "physics-kinds":
        models = furniture_kinds(teaching_key, task, params, reading_noise)
        return make_piecewise_agent(
            name, task, _by_engine(task, models, RECIPES["physics"]), params.goal
        )
    recipe = RECIPES[name]
    models = tuple(
        recipe.build(_subject(with_sensors(spec, reading_noise)))
        for spec in task.pieces
    )
    is_regression = isinstance(models[0], BodyRegression)
    laws = stacked(list(models)) if is_regression else None
    if recipe.is_taught:
        models = _taught(teaching_key, task, params, models, reading_noise)
    if laws is None:
        model = _by_engine(task, models, recipe)
    else:
        model = PerBody(models, laws, num_hypotheses=recipe.num_hypotheses)
    return make_piecewise_agent(
        name,
        task,
        model,
        params.goal,
        exploration=recipe.exploration,
        explore=curious_of_pieces(task, model) if recipe.is_curious else None,
    )


def _by_engine(
    task: LivingRoom, models: tuple[AbstractModel, ...], recipe: Recipe
) -> PerBody:
    """Models whose hypotheses are numbers of the engine."""
    return PerBody(
        models,
        ScenePhysics(task.lone_scenes()),
        num_hypotheses=recipe.num_hypotheses,
        moved_freely=task.moved_freely,
    )


def _known(task: LivingRoom, params: EnvParams) -> PerBody:
    numbers = task.lone_params(params.physics)
    models: list[AbstractModel] = [
        TrueModel(_row(numbers, index), _advance(spec))
        for index, spec in enumerate(task.pieces)
    ]
    return PerBody(tuple(models), ScenePhysics(task.lone_scenes()), num_hypotheses=1)


def _among_others(task: LivingRoom) -> tuple[ObjectAmongOthers, ...]:
    """A regression of each piece that feels what is next to it."""
    return tuple(
        ObjectAmongOthers(
            scene=task.scene,
            body=jnp.asarray(body),
            features=BodyFeatures(spec.scene, frame="body"),
            regressor=LocallyWeighted(),
            radius=jnp.asarray(TOUCH_RADIUS),
        )
        for body, spec in enumerate(task.pieces)
    )


def _taught(
    key: Key,
    task: LivingRoom,
    params: EnvParams,
    models: tuple[AbstractModel, ...],
    reading_noise: Float[Array, "4"] | None,
) -> tuple[AbstractModel, ...]:
    """All pieces' models, by the same samples of the whole room."""
    key, sample_key = jax.random.split(key)
    samples = unbiased_samples(sample_key, task, params, reading_noise=reading_noise)
    keys = jax.random.split(key, len(models))
    own = [samples.of_body(body) for body in range(len(models))]
    return tuple(
        taught(each, model, rows.first(_NUM_SAMPLES))
        for each, model, rows in zip(keys, models, own, strict=True)
    )


def _subject(spec: SceneSpec) -> Subject:
    """One piece, as if it were alone."""
    return Subject(
        spec=spec,
        advance=_advance(spec),
        moved_freely=None,
        halted=None,
        is_bob=False,
        surroundings=(spec.scene, jnp.zeros((0, 3))),
        capacity=_CAPACITY,
        num_particles=_NUM_PARTICLES,
        num_samples=_NUM_SAMPLES,
    )


def _advance(spec: SceneSpec) -> Advance:
    return lambda physics, state, wrench: step(spec.scene, physics, state, wrench)[0]


def _row(tree, index: int):
    return jax.tree.map(lambda leaf: leaf[index], tree)
