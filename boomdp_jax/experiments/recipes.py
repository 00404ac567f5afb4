"""What each agent is made of: its model, how many hypotheses, whether it explores."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.inference.online.belief import OnlineBelief
from boomdp_jax.models.gaussian_process import GaussianProcess
from boomdp_jax.models.linear import LinearRegression
from boomdp_jax.models.locally_weighted import LocallyWeighted
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.neural_ensemble import NeuralEnsemble
from boomdp_jax.models.object_oriented import ObjectOriented
from boomdp_jax.models.per_body import MovedFreely
from boomdp_jax.models.physics_model import PhysicsModel
from boomdp_jax.models.point_fit import AbstractSearch, CmaEs, GaussNewton, PointFit
from boomdp_jax.models.regression import AbstractRegressor, BodyRegression
from boomdp_jax.models.residual_model import Halted, ResidualPhysics
from boomdp_jax.models.true_model import Advance
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec

TOUCH_RADIUS = 0.2
"""How near its outline a body feels others [m]: the papers' 20 pixels."""
_NUM_HYPOTHESES = 4
_EXPLORATION = 0.1
"""Of agents that learn one law: without it, some push against one wall for ever."""


class Subject(NamedTuple):
    """What an agent learns one scene from, and how much it keeps of it."""

    spec: SceneSpec
    advance: Advance
    """A step under a hypothesis, walls included."""
    moved_freely: MovedFreely | None
    halted: Halted | None
    """Where a step ends that might run into something; None: nothing is known of it."""
    is_bob: bool
    """Seen without its angle, as the papers' pendulum: x, y and their rates."""
    surroundings: tuple[Scene, Float[Array, "other 3"]]
    """As `AbstractEnvironment.surroundings`."""
    capacity: int
    """Rows that an online belief keeps."""
    num_particles: int
    num_samples: int
    """Most rows of one that is taught beforehand."""
    num_regressed: int = 1000
    """Newest rows that a linear or a locally weighted regression keeps while it acts;
    as many as in the successor paper."""


class Recipe(NamedTuple):
    """An agent's model, and how it decides by it."""

    build: Callable[[Subject], AbstractModel]
    num_hypotheses: int = 1
    """That a decision rests on."""
    exploration: float = 0.0
    """Probability that a decision is any action."""
    is_taught: bool = False
    """Beforehand, and learns nothing while it acts (`teaching`)."""
    is_curious: bool = False
    """Begins with the pushes that tell most (`agents.curiosity`)."""
    is_restless: bool = False
    """Does anything rather than lean against a wall (`agents.restlessness`)."""


def _physics(subject: Subject) -> AbstractModel:
    return _physics_model(subject, is_point=False)


def _most_probable(subject: Subject) -> AbstractModel:
    return _physics_model(subject, is_point=True)


def _taught_physics(subject: Subject) -> AbstractModel:
    # What is taught beforehand may take its time.
    return _physics_model(subject._replace(capacity=2 * subject.capacity))


def _physics_model(subject: Subject, *, is_point: bool = False) -> PhysicsModel:
    online = OnlineBelief(
        subject.spec, capacity=subject.capacity, num_particles=subject.num_particles
    )
    return PhysicsModel(
        online, subject.advance, subject.moved_freely, is_point=is_point
    )


def _residual(subject: Subject) -> AbstractModel:
    return ResidualPhysics(
        _physics_model(subject),
        subject.spec.scene,
        moved_freely=subject.moved_freely,
        halted=subject.halted,
    )


def _regression(
    make: Callable[[Subject], AbstractRegressor], frame: str
) -> Callable[[Subject], AbstractModel]:
    def build(subject: Subject) -> AbstractModel:
        return BodyRegression(
            subject.spec.scene,
            make(subject),
            frame=_frame(subject, frame),
            angles=not subject.is_bob,
        )

    return build


def _frame(subject: Subject, usual: str) -> str:
    """The world's where directions in it count: of a bob, and of what may fall."""
    falls = np.any(np.asarray(subject.spec.scene.gravity) != 0.0)
    return "world" if subject.is_bob or falls else usual


def _linear(subject: Subject) -> LinearRegression:
    return LinearRegression(capacity=subject.num_regressed)


def _local(subject: Subject) -> LocallyWeighted:
    return LocallyWeighted(capacity=subject.num_regressed)


def _object_oriented(subject: Subject) -> AbstractModel:
    scene, surroundings = subject.surroundings
    return ObjectOriented(
        scene,
        radius=TOUCH_RADIUS,
        surroundings=surroundings,
        frame=_frame(subject, "body"),
        angles=not subject.is_bob,
    )


def _point_fit(
    make: Callable[[], AbstractSearch],
) -> Callable[[Subject], AbstractModel]:
    def build(subject: Subject) -> AbstractModel:
        return PointFit(
            subject.spec.scene,
            make(),
            advance=subject.advance,
            moved_freely=subject.moved_freely,
            has_pin=subject.spec.unknown.get("revolute", 0) > 0,
        )

    return build


def _one_law(build: Callable[[Subject], AbstractModel]) -> Recipe:
    return Recipe(build, exploration=_EXPLORATION)


RECIPES: Mapping[str, Recipe] = MappingProxyType(
    {
        "physics": Recipe(_physics, _NUM_HYPOTHESES, is_restless=True),
        "physics-map": Recipe(_most_probable, is_restless=True),
        "physics-informative": Recipe(_physics, _NUM_HYPOTHESES, is_curious=True),
        "physics-pretrained": Recipe(_taught_physics, _NUM_HYPOTHESES, is_taught=True),
        "physics-residual": Recipe(_residual, _NUM_HYPOTHESES, is_restless=True),
        "point-fit": _one_law(_point_fit(GaussNewton)),
        "cma-es": _one_law(_point_fit(CmaEs)),
        "lr": _one_law(_regression(_linear, "world")),
        "lr-body": _one_law(_regression(_linear, "body")),
        "lwr": _one_law(_regression(_local, "body")),
        "lwr-world": _one_law(_regression(_local, "world")),
        "lwr-pretrained": Recipe(
            _regression(
                lambda subject: LocallyWeighted(capacity=subject.num_samples), "body"
            ),
            is_taught=True,
        ),
        "oo-lwr": _one_law(_object_oriented),
        "gp": _one_law(_regression(lambda _: GaussianProcess(), "body")),
        "ensemble": Recipe(
            _regression(lambda _: NeuralEnsemble(), "body"), _NUM_HYPOTHESES
        ),
    }
)
"""By name; a few agents besides are made otherwise (`registry`)."""
