"""Motion of a whole scene as likelihoods have it: cut where bodies first touch.

A step of the engine lets bodies that meet stay together until the end of a substep, and
a struck disc then flies off in a slightly wrong direction. Likelihoods step to the
instant of the touch (`contact_prediction`), so the noise of the motion that they infer
does not make up for this: what predicts with their draws has to step as they do.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, FloatScalar
from boomdp_jax.inference.hypotheses.contact_prediction import (
    NUM_SUBSTEPS,
    ContactScene,
    contact_step,
    first_impact,
)
from boomdp_jax.inference.hypotheses.first_touch import sort_pairs
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State, state_from_array
from boomdp_jax.physics.step import step
from boomdp_jax.physics.world_rollout import empty_cache


class WholeScene(eqx.Module):
    """All bodies of a scene, walls included, each in its place of the state."""

    scene: Scene
    """As the engine steps it."""
    contact: ContactScene | None
    """For steps in which something collides; None: nothing can."""

    @property
    def filtered(self) -> Scene | ContactScene:
        """What a filter along readings takes."""
        return self.scene if self.contact is None else self.contact


def whole_scene(spec: SceneSpec) -> WholeScene:
    """Gather what steps of all bodies need.

    Args:
        spec: the scene, with contact or without.

    Returns:
        Its scenes; to be built outside compiled functions.
    """
    scene = spec.scene
    if scene.collides is None:
        return WholeScene(scene, None)
    collides, is_static = np.asarray(scene.collides), np.asarray(scene.is_static)
    collides = np.triu(collides & ~(is_static[:, None] & is_static[None]))
    pairs = [(int(a), int(b)) for a, b in np.argwhere(collides)]
    is_disc = np.array([body.radius > 0 for body in spec.bodies])
    substeps = NUM_SUBSTEPS if spec.substeps is None else spec.substeps
    contact = ContactScene(
        scene=dataclasses.replace(scene, num_substeps=substeps),
        wall_pose=jnp.zeros((0, 3), scene.area.dtype),
        sorts=sort_pairs(pairs, is_disc),
        apart=dataclasses.replace(scene, collides=None),
    )
    return WholeScene(scene, contact)


def many_rollouts(
    world: WholeScene,
    params: Params,
    start: State,
    wrenches: Float[Array, "draw time body 3"],
    dt: Float[Array, "draw time"],
    kicks: Float[Array, "draw time body 3"] | None = None,
) -> State:
    """Advance many hypotheses of a scene with contact.

    All at once, so that the search for impacts is followed up only in steps in which
    something collides for any of them; there the rest goes on as the engine has it, as
    everything does in all other steps.

    Args:
        world: of `whole_scene`, with contact.
        params: hypotheses, leading axis `draw`.
        start: a state of each.
        wrenches: held over each step [N, N, N m].
        dt: lengths of the steps [s].
        kicks: change of the twists before each step [m/s, m/s, rad/s]; None: none.

    Returns:
        The states after each step, leading axes `draw, time`.
    """
    scene = world.scene
    num_draws = dt.shape[0]
    empty = empty_cache(scene)
    cache = jax.tree.map(lambda x: jnp.broadcast_to(x, (num_draws, *x.shape)), empty)

    def usual(params, state, wrench, length, cache):
        after, info = step(scene, params, state, wrench, dt=length, cache=cache)
        return after, info.cache

    def advance(carry, row):
        state, cache = carry
        wrench, length, kick = row
        if kick is not None:
            state = State(state.pose, state.twist + kick)
        given = params, state, wrench, length
        after, cache = jax.vmap(usual)(*given, cache)
        collides = jax.vmap(lambda *each: _collides(world, *each))(*given)

        def struck() -> State:
            each = jax.vmap(lambda *each: _struck(world, *each))(*given)
            return jax.tree.map(
                lambda x, y: jnp.where(collides[:, None, None], x, y), each, after
            )

        after = jax.lax.cond(jnp.any(collides), struck, lambda: after)
        return (after, cache), after

    rows = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), (wrenches, dt, kicks))
    states = jax.lax.scan(advance, (start, cache), rows)[1]
    return jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), states)


@jax.jit
def next_state(
    world: WholeScene, params: Params, state: State, wrench: Float[Array, "body 3"]
) -> State:
    """Advance one hypothesis by the scene's time step.

    Args:
        world: of `whole_scene`, with contact or without.
        params: one hypothesis.
        state: poses and twists.
        wrench: held over the step [N, N, N m].

    Returns:
        The next state.
    """
    scene, length = world.scene, world.scene.dt
    usual, _ = step(scene, params, state, wrench)
    if world.contact is None:
        return usual
    given = params, state, wrench, length
    return jax.lax.cond(
        _collides(world, *given), lambda: _struck(world, *given), lambda: usual
    )


def _collides(
    world: WholeScene, params: Params, state: State, wrench: Array, length: FloatScalar
) -> BoolScalar:
    """Whether any two bodies that are apart meet within a step."""
    assert world.contact is not None
    return jnp.any(first_impact(world.contact, params, state.array, wrench, length))


def _struck(
    world: WholeScene, params: Params, state: State, wrench: Array, length: FloatScalar
) -> State:
    assert world.contact is not None
    after = contact_step(world.contact, params, state.array, wrench, length)
    return state_from_array(after)
