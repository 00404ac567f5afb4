"""A flat full of furniture, to be put in its place one push at a time.

After Scholz et al. (2014), A Physics-Based Model Prior for Object-Oriented MDPs: pieces
and where they stand are measured from their picture, a pixel being a centimetre; the
piano is the earlier paper's. Chairs slide, the couch, the bed and the piano are heavy,
dining table and desk stand on fixed wheels at one end, and the kitchen table is held by
a pin off its middle, so that it turns into its place or not at all. The floor resists
with a force in proportion to speed, as in the papers' simulator.

The world is the engine with contact between all pieces and walls. Each step pushes one
piece, at its centre of mass; what it costs is the mean distance of the pieces from
where they belong, nothing for those within `GOAL_RADIUS`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar, IntScalar, Key
from boomdp_jax.core.checked_input import whole_number
from boomdp_jax.envs.action_set import ActionSet, forces_round_circle, join_actions
from boomdp_jax.envs.blocking import Boxes, box_separation, stopped_by_boxes
from boomdp_jax.envs.environment import (
    AbstractEnvironment,
    EnvParams,
    PlanningHints,
    distance,
    uniform_near,
    wrapped,
)
from boomdp_jax.envs.furniture import PIECES, WALLS, Piece, piece_scene, room_scene
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.state import State

GOAL_RADIUS = 0.1
PUSH = 220.0
"""Force on a square metre of furniture [N/m²]: who pushes judges by size."""
_NUM_STEPS, _LEAF_STEPS = 1000, 10.0
_NUM_DIRECTIONS = 8
_NUM_SWEEPS = 4
_NUM_WRENCHES = _NUM_DIRECTIONS + 2
"""On each piece: forces, and torques both ways."""
_NEAR = 0.02
"""A piece this near another one or a wall may have touched it [m]."""


class LivingRoom(AbstractEnvironment):
    """Put furniture in its place; `start_spread`: of each piece's pose."""

    def __init__(self, *, num_steps: int = _NUM_STEPS):
        """Pose the task for so many steps an episode."""
        self.name = "living-room"
        self.spec = room_scene()
        num_bodies = self.spec.num_bodies
        self.pieces = tuple(piece_scene(piece) for piece in PIECES)
        """What an agent is told of each piece, which is a body of its own."""
        self.half_extents = jnp.asarray(
            [p.half_extents for p in PIECES] + [w[2:] for w in WALLS], float
        )
        sets = [
            forces_round_circle(
                num_bodies,
                body,
                _force(piece),
                _NUM_DIRECTIONS,
                torque=_torque(piece),
                with_nothing=False,
            )
            for body, piece in enumerate(PIECES)
        ]
        nothing = ActionSet(jnp.zeros((1, num_bodies, 3)))
        self.actions = join_actions([*sets, nothing])
        self.num_steps = whole_number("num_steps", num_steps, 1)
        self.hints = PlanningHints(
            cell_size=(0.08, 0.08, 0.4),
            stratum_size=(0.32, 0.32, np.inf),
            depth=10,
            action_repeat=2,
            capacity=8,
        )

    @property
    def scene(self) -> Scene:
        """Arrays of `spec`, a step cut into as many parts as a lone piece's.

        Friction in proportion to speed depends on them by a tenth, and a piece has to
        be in the room what it is alone. Contacts are gone over more than once instead,
        for pieces that are pushed at others that are at a wall.
        """
        return dataclasses.replace(
            super().scene,
            num_substeps=self.pieces[0].scene.num_substeps,
            num_sweeps=_NUM_SWEEPS,
        )

    @property
    def num_pieces(self) -> int:
        """Bodies that can be moved; the first ones of the scene."""
        return len(self.pieces)

    @property
    def piece_actions(self) -> Float[Array, "piece action 3"]:
        """Wrenches on each piece, and none as the last [N, N, N m]; see `action_of`."""
        index = jnp.arange(self.num_pieces)
        by_piece = self.actions.wrench[:-1].reshape(
            self.num_pieces, _NUM_WRENCHES, -1, 3
        )
        return jnp.pad(by_piece[index, :, index], ((0, 0), (0, 1), (0, 0)))

    def action_of(self, body: IntScalar, index: IntScalar) -> IntScalar:
        """Index into `actions` of one of a piece's own."""
        is_push = index < _NUM_WRENCHES
        return jnp.where(is_push, body * _NUM_WRENCHES + index, self.num_actions - 1)

    def default_params(self) -> EnvParams:
        """Pieces as in the paper's picture, a hand's breadth off."""
        walls = [[*wall[:2], 0.0] for wall in WALLS]
        start = np.array([[*piece.start, 0.0] for piece in PIECES] + walls)
        goal = np.array([[*piece.goal, 0.0] for piece in PIECES] + walls)
        spread = np.zeros_like(start)
        is_loose = [piece.pin is None for piece in PIECES]
        spread[: len(PIECES)][is_loose] = [0.05, 0.05, 0.05]
        return EnvParams(
            physics=self.spec.params(),
            goal=jnp.asarray(goal, float),
            start=jnp.asarray(start, float),
            start_spread=jnp.asarray(spread, float),
        )

    def start(self, key: Key, params: EnvParams) -> State:
        """Draw poses, at rest."""
        pose = uniform_near(key, params.start, params.start_spread)
        return State(pose, jnp.zeros_like(pose))

    def reward(
        self,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        goal: Float[Array, "body 3"],
    ) -> FloatScalar:
        """Minus the mean distance of pieces from their places [m]."""
        return -jnp.mean(self.costs(next_state, goal))

    def costs(
        self, state: State, goal: Float[Array, "body 3"]
    ) -> Float[Array, " piece"]:
        """Distance of each piece from its place [m]; nothing for those in it."""
        num = self.num_pieces
        return piece_cost(state.pose[:num], goal[:num])

    def is_solved(self, state: State, goal: Float[Array, "body 3"]) -> BoolScalar:
        """Every piece is in its place."""
        return jnp.all(self.costs(state, goal) == 0.0)

    def leaf_value(self, state: State, goal: Float[Array, "body 3"]) -> FloatScalar:
        """As if all stood still for ten steps."""
        return -_LEAF_STEPS * jnp.mean(self.costs(state, goal))

    def coordinates(self, state: State) -> Float[Array, " coordinate"]:
        """Poses of all pieces; of a lone one, its own."""
        pose = state.pose[: self.num_pieces]
        return pose.at[:, 2].set(wrapped(pose[:, 2])).reshape(-1)

    def observe(self, state: State) -> Float[Array, " number"]:
        """Poses and twists of all pieces."""
        num = self.num_pieces
        return jnp.concatenate(
            [state.pose[:num].reshape(-1), state.twist[:num].reshape(-1)]
        )

    def moved_freely(self, state: State, next_state: State) -> Bool[Array, " body"]:
        """Whether a body was clear of all others before and after the step."""
        bodies = jnp.arange(self.spec.num_bodies)

        def is_clear(body, pose):
            boxes = self.obstacles(body, pose)
            return box_separation(boxes, self.half_extents[body], pose[body]) > _NEAR

        clear = jax.vmap(is_clear, in_axes=(0, None))
        return clear(bodies, state.pose) & clear(bodies, next_state.pose)

    def obstacles(self, body: IntScalar, pose: Float[Array, "body 3"]) -> Boxes:
        """Everything that may be in a body's way, where it stands now."""
        others = jnp.arange(self.spec.num_bodies) == body
        # The body itself is put where it is in nobody's way.
        far = jnp.asarray([1e3, 1e3, 0.0], pose.dtype)
        return Boxes(
            jnp.where(others[:, None], far[None], pose),
            self.half_extents.astype(pose.dtype),
        )

    def lone_scenes(self) -> Scene:
        """Scenes of the pieces, each by itself, leading axis `piece`."""
        with jax.ensure_compile_time_eval():
            scenes = [spec.scene for spec in self.pieces]
            return jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)

    def lone_params(self, physics: Params) -> Params:
        """The room's numbers piece by piece, leading axis `piece`."""
        return jax.vmap(lambda body: _lone(physics, body))(jnp.arange(self.num_pieces))

    def stopped(
        self,
        body: IntScalar,
        pose: Float[Array, "body 3"],
        state: State,
        next_state: State,
    ) -> State:
        """Where a lone piece's step ends among others that stay where they are.

        Args:
            body: the piece.
            pose: of all bodies, before.
            state: of the piece, before the step.
            next_state: of the piece, after it, as if it were alone.
        """
        boxes = self.obstacles(body, pose)
        half = self.half_extents[body].astype(pose.dtype)
        return stopped_by_boxes(boxes, half, state, next_state)


def piece_cost(
    pose: Float[Array, "piece 3"], goal: Float[Array, "piece 3"]
) -> Float[Array, " piece"]:
    """Distance from a place [m], nothing within `GOAL_RADIUS`."""
    away = distance(pose[:, :2], goal[:, :2])
    return jnp.where(away < GOAL_RADIUS, 0.0, away)


def _force(piece: Piece) -> float:
    return PUSH * 4.0 * piece.half_extents[0] * piece.half_extents[1]


def _torque(piece: Piece) -> float:
    return _force(piece) * float(np.hypot(*piece.half_extents)) * 0.5


def _lone(physics: Params, body: IntScalar) -> Params:
    """What a scene's numbers say of one body that is tied to nothing but the world."""

    def row(leaf):
        return leaf[body][None]

    pins = physics.revolute
    is_own = pins.active & (pins.body_a == body)
    first = jnp.zeros_like(pins.body_a)
    return Params(
        density=row(physics.density),
        revolute=type(pins)(
            active=is_own,
            body_a=first,
            body_b=pins.body_b,
            anchor_a=pins.anchor_a,
            anchor_b=pins.anchor_b,
            viscous=pins.viscous,
            dry=pins.dry,
        ),
        distance=physics.distance,
        wheel=jax.tree.map(row, physics.wheel),
        ground=jax.tree.map(row, physics.ground),
    )
