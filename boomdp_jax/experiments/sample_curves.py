"""What learners foretell of motion that they have not seen, by how much they have seen.

Figure 1a of Scholz, Levihn and Isbell (2013), What Does Physics Bias: unbiased samples
of the pendulum are told to each learner, and it is asked where others lead.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import on_device
from boomdp_jax.envs.environment import AbstractEnvironment, EnvParams
from boomdp_jax.experiments.recipes import RECIPES
from boomdp_jax.experiments.registry import subject_of
from boomdp_jax.experiments.teaching import Samples, taught, unbiased_samples
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.physics.state import state_from_array
from boomdp_jax.planning.belief import Belief

NUM_HELD_OUT = 500
SIZES = (5, 10, 20, 50, 100, 200, 500, 1000, 2000)
"""Numbers of samples."""


class SampleErrors(NamedTuple):
    """How far off a learner is after so many samples; root mean squares."""

    position: Float[np.ndarray, " size"]
    """[m]"""
    velocity: Float[np.ndarray, " size"]
    """[m/s]"""


def sample_errors(
    agent: str,
    task: AbstractEnvironment,
    params: EnvParams,
    seeds: Sequence[int],
    *,
    sizes: Sequence[int] = SIZES,
    reading_noise: Float[Array, "4"] | None = None,
) -> Iterator[SampleErrors]:
    """Tell a learner more and more, and ask it each time.

    Held-out motion is exact, from the same states as what is told, and the same for all
    learners; what is told is read with noise. The error is of the mean over the
    learner's hypotheses. A physics posterior takes in as many samples as its table
    holds (`teaching.taught`).

    Args:
        agent: name of a recipe, such as `physics` or `lwr`.
        task: what moves.
        params: the world.
        seeds: of the samples that are told.
        sizes: numbers of samples, ascending.
        reading_noise: standard deviation of readings, as of `run_episode`.

    Returns:
        An iterator over seeds.

    Raises:
        ValueError: an agent that learns nothing, or sizes that do not ascend from 1.
    """
    if agent not in RECIPES:
        raise ValueError(
            f"agent: expected one that learns, of {', '.join(RECIPES)}; got {agent!r}"
        )
    sizes = tuple(int(size) for size in sizes)
    if not sizes or sizes[0] < 1 or list(sizes) != sorted(set(sizes)):
        raise ValueError(f"sizes: expected to ascend from at least 1, got {sizes}")
    return _each_seed(agent, task, params, seeds, sizes, reading_noise)


def _each_seed(
    agent: str,
    task: AbstractEnvironment,
    params: EnvParams,
    seeds: Sequence[int],
    sizes: tuple[int, ...],
    reading_noise: Float[Array, "4"] | None,
) -> Iterator[SampleErrors]:
    subject = subject_of(task, reading_noise)._replace(
        num_samples=sizes[-1], num_regressed=sizes[-1]
    )
    model = RECIPES[agent].build(subject)
    held_key, told_key = jax.random.split(jax.random.key(0))
    held_out = unbiased_samples(held_key, task, params, num_samples=NUM_HELD_OUT)
    for seed in seeds:
        sample_key, learn_key = jax.random.split(jax.random.fold_in(told_key, seed))
        samples = unbiased_samples(
            sample_key,
            task,
            params,
            reading_noise=reading_noise,
            num_samples=sizes[-1],
        )
        errors = np.zeros((2, len(sizes)))
        for column, size in enumerate(sizes):
            # As many rows each time, unread ones among them: one program for all.
            known = samples.first(size).first(sizes[-1])
            learnt = taught(learn_key, model, known)
            errors[:, column] = _errors(model, learnt.belief, held_out)
        yield SampleErrors(*errors)


def _errors(
    model: AbstractModel, belief: Belief, held_out: Samples
) -> tuple[float, float]:
    """Of position and of velocity, over all that was held out."""
    told = (on_device(part) for part in held_out[:3])
    place, rate = _squares(model, belief, *told)
    return float(np.sqrt(place)), float(np.sqrt(rate))


@eqx.filter_jit
def _squares(
    model: AbstractModel,
    belief: Belief,
    state: Float[Array, "sample body 6"],
    wrench: Float[Array, "sample body 3"],
    next_state: Float[Array, "sample body 6"],
) -> tuple[Array, Array]:
    key = jax.random.key(0)
    foretell = functools.partial(model.transition, key)

    def one(before, wrench):
        all_of = jax.vmap(lambda h: foretell(h, state_from_array(before), wrench).array)
        foretold = all_of(belief.hypotheses)
        return jnp.sum(belief.weight[:, None, None] * foretold, axis=0)

    missed = jax.vmap(one)(state, wrench) - next_state
    squares = jnp.mean(missed**2, axis=(0, 1))
    return squares[0] + squares[1], squares[3] + squares[4]
