"""Worlds to train in that differ as the draws of a posterior do.

Physics parameters are data, so that brax's domain randomisation of a `BraxTask` is a
choice of draws: whatever differs among them, structure included, reaches the policy.
(`brax_randomisation` does this for brax's own systems and MJX.)
"""

from collections.abc import Callable

import equinox as eqx
import jax
from jaxtyping import Array, PyTree

from boomdp_jax.envs import AbstractEnvironment, EnvParams
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.same_bodies import check_same_bodies


def task_randomisation(
    draws: Params | Posterior,
    *,
    num_draws: int | None = None,
    task: AbstractEnvironment | None = None,
) -> Callable[[EnvParams, Array], tuple[EnvParams, PyTree]]:
    """Brax's `randomization_fn` that gives each world of a `BraxTask` a draw.

    Args:
        draws: hypotheses with one leading axis, for the task's scene, or a posterior
            of it, whose draws are taken by weight.
        num_draws: how many of a posterior there are to choose from, at most; default:
            all.
        task: what is trained; a posterior must then be of bodies with its names and
            outlines.

    Returns:
        A function of a world and of one random key for each environment. It returns
        the world with a leading axis on its physics, goal and starts being shared, and
        its `in_axes`: give it to `train_ppo`, or to any trainer of brax. It refuses a
        world of another number of bodies with a ValueError.

    Raises:
        TypeError: neither hypotheses nor a posterior.
        ValueError: hypotheses without leading axis, or with more than one; a posterior
            of other bodies than the task's.
    """
    if not isinstance(draws, Params | Posterior):
        raise TypeError(
            f"draws: expected Params or a Posterior, got {type(draws).__name__}"
        )
    if isinstance(draws, Posterior):
        if task is not None:
            check_same_bodies(draws.spec, task.spec, "draws")
        draws = draws.thin(draws.num_draws if num_draws is None else num_draws).params
    if draws.density.ndim != 2:
        raise ValueError(
            "draws: expected hypotheses with one leading axis, got axes "
            f"{draws.density.shape[:-1]}"
        )
    physics, num = draws, draws.density.shape[0]

    def randomise(world: EnvParams, rng: Array) -> tuple[EnvParams, PyTree]:
        num_bodies = world.physics.density.shape[-1]
        if physics.density.shape[-1] != num_bodies:
            raise ValueError(
                f"draws: expected densities of {num_bodies} bodies, got "
                f"{physics.density.shape[-1]}"
            )
        chosen = jax.vmap(lambda key: jax.random.randint(key, (), 0, num))(rng)
        own = jax.tree.map(lambda leaf: leaf[chosen], physics)
        shared = jax.tree.map(lambda leaf: None, world)
        axes = jax.tree.map(lambda leaf: 0, own)
        return _with_physics(world, own), _with_physics(shared, axes)

    return randomise


def _with_physics(world: PyTree, physics: PyTree) -> PyTree:
    return eqx.tree_at(lambda one: one.physics, world, physics)
