"""The papers' own learner: Metropolis from the prior, now and then, and its best draw.

A control, as the papers describe it and no better: single steps, one noise scale for
all channels, constraints nulled by value, 30 chains, and the draw of the highest
density for a plan. All chains begin anew after steps 1, 2, 4, 8 and so on of what was
seen; in between nothing is learnt. What they leave open is said where it is chosen
(`inference.plain_metropolis`). Steps in which the body may have touched something are
left out, as by our own physics.
"""

import functools
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.core.history import make_history
from boomdp_jax.inference.samplers.plain_metropolis import plain_metropolis
from boomdp_jax.inference.samplers.plain_problem import plain_problem
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.per_body import MovedFreely
from boomdp_jax.models.table import check_at_least
from boomdp_jax.models.true_model import Advance
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.state import State
from boomdp_jax.planning.belief import Belief, certain

# Tables of these sizes, so that few programs are compiled; of more rows the newest.
_CAPACITIES = (8, 64, 512)


class MetropolisLearnt(NamedTuple):
    """Rows, and the best draw of the last chains; on the host."""

    params: Params
    rows: tuple[tuple[np.ndarray, ...], ...]
    """State, wrench and next state of each."""
    num_seen: int
    """Steps, those that are left out included."""
    key: Key


class MetropolisModel(AbstractModel):
    """One body, refitted when what was seen has doubled."""

    refit: Callable[[Key, tuple], Params] = eqx.field(static=True)
    """From rows to the best draw."""
    advance: Advance = eqx.field(static=True)
    moved_freely: MovedFreely = eqx.field(static=True)
    is_compiled: ClassVar[bool] = False

    def __init__(
        self,
        spec: SceneSpec,
        advance: Advance,
        moved_freely: MovedFreely,
        *,
        num_chains: int = 30,
        num_iterations: int = 20_000,
        num_burn_in: int = 1_000,
        thin: int = 10,
    ):
        """Set up.

        Args:
            spec: a scene of one body; steps of its own length.
            advance: a step of the world under a hypothesis.
            moved_freely: which bodies touched nothing in a step.
            num_chains: as many as the papers had, like all that follows.
            num_iterations: of each chain.
            num_burn_in: of these, thrown away.
            thin: one draw is kept of so many iterations.

        Raises:
            ValueError: a scene of several bodies, a count below one, or nothing left
                to keep.
        """
        if spec.num_bodies != 1:
            raise ValueError(
                f"{spec.source}: expected a scene of one body, got {spec.num_bodies}"
            )
        for name, count in (("num_chains", num_chains), ("thin", thin)):
            check_at_least(name, count, 1)
        check_at_least("num_iterations", num_iterations, num_burn_in + thin)
        options = {
            "num_chains": num_chains,
            "num_iterations": num_iterations,
            "num_burn_in": num_burn_in,
            "thin": thin,
        }
        self.refit = functools.partial(_refit, spec, options)
        self.advance = advance
        self.moved_freely = jax.jit(moved_freely)

    def init(self, key: Key) -> MetropolisLearnt:
        """No rows, and the best of draws from the prior."""
        key, fit_key = jax.random.split(key)
        return MetropolisLearnt(self.refit(fit_key, ()), (), 0, key)

    def update(
        self,
        learnt: MetropolisLearnt,
        state: State,
        wrench: Float[Array, "body 3"],
        next_state: State,
        *,
        starts_episode: BoolScalar | bool = False,
    ) -> MetropolisLearnt:
        """Take one transition in, and run all chains anew if it is time."""
        del starts_episode  # Rows stand for themselves.
        num_seen, rows = learnt.num_seen + 1, learnt.rows
        if bool(jnp.all(self.moved_freely(state, next_state))):
            row = tuple(
                np.asarray(part) for part in (state.array, wrench, next_state.array)
            )
            rows = (*rows, row)[-_CAPACITIES[-1] :]
        is_power = num_seen & (num_seen - 1) == 0
        if not (is_power and rows):
            return learnt._replace(rows=rows, num_seen=num_seen)
        key, fit_key = jax.random.split(learnt.key)
        return MetropolisLearnt(self.refit(fit_key, rows), rows, num_seen, key)

    def sample(self, key: Key, learnt: MetropolisLearnt, num_hypotheses: int) -> Belief:
        """The best draw."""
        del key, num_hypotheses
        return certain(learnt.params)

    def transition(
        self,
        key: Key,
        hypothesis: Params,
        state: State,
        wrench: Float[Array, "body 3"],
    ) -> State:
        """A step of the world under it."""
        del key
        return self.advance(hypothesis, state, wrench)


def _refit(spec: SceneSpec, options: dict[str, int], key: Key, rows: tuple) -> Params:
    """All chains from the beginning."""
    empty = np.zeros((0, spec.num_bodies, 6))
    none = (empty, empty[..., :3], empty)
    parts = tuple(map(np.stack, zip(*rows, strict=True))) if rows else none
    capacity = next(size for size in _CAPACITIES if size >= len(rows))
    episode = np.arange(len(rows))
    history = make_history(*parts, float(spec.dt), episode=episode, capacity=capacity)
    dt = jnp.full_like(history.dt, float(spec.dt))
    _, problem = plain_problem(spec, eqx.tree_at(lambda h: h.dt, history, dt))
    return problem.params(plain_metropolis(key, problem, **options).best)
