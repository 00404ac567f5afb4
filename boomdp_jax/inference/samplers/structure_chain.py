"""A chain over structures and coordinates: `init`, `step`, and many chains in one scan.

One iteration is a fixed cycle of moves: jumps, local changes, walks, leaps. See `moves`
for what each does. Prefer this to enumeration where many structures share data, and to
importance sampling where its effective sample size is small.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from boomdp_jax.core.arrays import BoolScalar, Key
from boomdp_jax.core.random_numbers import draw_noise, pick
from boomdp_jax.inference.likelihoods.target import StructureTarget
from boomdp_jax.inference.samplers.dual_averaging import (
    DualAveraging,
    start_dual_averaging,
    update_dual_averaging,
)
from boomdp_jax.inference.samplers.laplace_mixture import LaplaceMixture
from boomdp_jax.inference.samplers.moves import (
    MOVES,
    MoveInfo,
    Point,
    decide,
    jump,
    leap,
    propose_change,
    propose_jump,
    propose_walk,
)


class ChainSettings(eqx.Module):
    """How often each move is made in one iteration, and how it is tuned.

    A jump's likelihood does not depend on the chain, so `run_chains` evaluates all of
    them ahead in large batches, where each is far cheaper than one inside the scan.
    """

    num_jumps: int = eqx.field(static=True, default=2)
    num_changes: int = eqx.field(static=True, default=1)
    num_walks: int = eqx.field(static=True, default=1)
    num_leapfrog: int = eqx.field(static=True, default=0)
    """Leapfrog steps of one leap; 0 makes none. A step costs one gradient, that is some
    ten likelihoods of a filter. With a mixture 1.5 sd off centre on a Gaussian target,
    walks made 0.1 independent draws each and leaps of three steps one: per likelihood
    the walk is cheaper, hence the default."""
    prior_share: float = eqx.field(static=True, default=0.3)
    """How often a change draws its new block from the prior, in (0, 1]."""
    walk_accept: float = eqx.field(static=True, default=0.4)
    """Acceptance that the walk's step size is adapted to."""
    leap_accept: float = eqx.field(static=True, default=0.8)
    num_starts: int = eqx.field(static=True, default=16)
    """Mixture draws of which a chain's start is chosen, by importance."""
    chunk_size: int = eqx.field(static=True, default=1024)
    """Likelihoods evaluated at once ahead of the scan; bounds memory."""

    def __check_init__(self):
        """Refuse counts and shares that no chain can run with."""
        if min(self.num_jumps, self.num_changes, self.num_walks) < 0:
            raise ValueError("num_jumps, num_changes, num_walks: expected at least 0")
        if self.num_leapfrog < 0 or self.num_starts < 1 or self.chunk_size < 1:
            raise ValueError(
                "expected num_leapfrog >= 0, num_starts >= 1 and chunk_size >= 1, got "
                f"{self.num_leapfrog}, {self.num_starts} and {self.chunk_size}"
            )
        if not 0.0 < self.prior_share <= 1.0:
            raise ValueError(f"prior_share: expected (0, 1], got {self.prior_share}")


class ChainState(eqx.Module):
    """Where a chain stands, and how its step sizes are adapted."""

    point: Point
    walk_step: DualAveraging
    leap_step: DualAveraging


class ChainInfo(NamedTuple):
    """Counts of one iteration or, summed, of many: `[move, 2]`, moves as in `MOVES`.

    The last axis tells proposals that keep the structure (0) from ones that do not (1).
    """

    proposed: Int[Array, "move 2"]
    accepted: Int[Array, "move 2"]


class ChainDraws(NamedTuple):
    """Draws of all chains after warm-up."""

    structure: Int[Array, "chain draw"]
    z: Float[Array, "chain draw dim"]
    log_density: Float[Array, "chain draw"]


class RunInfo(NamedTuple):
    """How a run went: counts after warm-up, and where every chain ended."""

    proposed: Int[Array, "chain move 2"]
    accepted: Int[Array, "chain move 2"]
    walk_step: Float[Array, " chain"]
    leap_step: Float[Array, " chain"]
    state: ChainState


def init(
    key: Key,
    target: StructureTarget,
    mixture: LaplaceMixture,
    settings: ChainSettings | None = None,
) -> ChainState:
    """Start a chain at one of several mixture draws, chosen by importance weight."""
    settings = ChainSettings() if settings is None else settings
    keys = jax.random.split(key, settings.num_starts + 1)
    starts = jax.vmap(lambda key: propose_jump(key, target, mixture))(keys[:-1])
    return _start(keys[-1], starts)


def _start(key: Key, starts: Point) -> ChainState:
    log_weight = starts.log_density - starts.log_proposal
    choice = pick(
        jnp.where(jnp.isnan(log_weight), -jnp.inf, log_weight), jax.random.uniform(key)
    )
    return ChainState(
        point=jax.tree.map(lambda leaf: leaf[choice], starts),
        walk_step=start_dual_averaging(0.5),
        leap_step=start_dual_averaging(0.5),
    )


def step(
    key: Key,
    state: ChainState,
    target: StructureTarget,
    mixture: LaplaceMixture,
    settings: ChainSettings | None = None,
    *,
    is_adapting: BoolScalar | bool = False,
    candidates: Point | None = None,
) -> tuple[ChainState, ChainInfo]:
    """Make one iteration.

    Args:
        key: random key.
        state: of the chain.
        target: the density that is left invariant.
        mixture: the proposal; must not depend on the chain's past.
        settings: how often to make each move.
        is_adapting: whether to adapt step sizes; only in warm-up.
        candidates: jumps drawn ahead, with the keys that `proposal_keys` makes of this
            very key; default: drawn here.

    Returns:
        The new state, and what was proposed and accepted.
    """
    settings = ChainSettings() if settings is None else settings
    if candidates is None:
        candidates = jax.vmap(lambda key: propose_jump(key, target, mixture))(
            proposal_keys(key, settings)
        )
    _, local_keys, jump_key, leap_key = _split_key(key, settings)
    info = ChainInfo(*(jnp.zeros((len(MOVES), 2), jnp.int32) for _ in range(2)))
    point = state.point
    if settings.num_jumps > 0:
        uniforms = jax.random.uniform(jump_key, (settings.num_jumps,))

        def try_jump(point: Point, inputs: tuple) -> tuple[Point, MoveInfo]:
            return jump(inputs[0], point, inputs[1])

        point, outcome = jax.lax.scan(try_jump, point, (uniforms, candidates))
        info = _count(info, jnp.zeros(settings.num_jumps, jnp.int32), outcome)
    state = ChainState(point, state.walk_step, state.leap_step)
    num_local = settings.num_changes + settings.num_walks
    if num_local > 0:
        is_walk = jnp.arange(num_local) >= settings.num_changes

        def local(state: ChainState, inputs: tuple) -> tuple[ChainState, MoveInfo]:
            return _local_move(*inputs, state, target, mixture, settings, is_adapting)

        state, outcome = jax.lax.scan(local, state, (local_keys, is_walk))
        info = _count(info, jnp.where(is_walk, 2, 1), outcome)
    if settings.num_leapfrog > 0:
        size = state.leap_step.step_size(is_adapting)
        point, outcome = leap(
            leap_key, state.point, target, mixture, size, settings.num_leapfrog
        )
        info = _count(info, jnp.asarray(3), outcome)
        leap_step = _adapt(
            state.leap_step, outcome, settings.leap_accept, 4.0, is_adapting
        )
        state = ChainState(point, state.walk_step, leap_step)
    return state, info


def _local_move(
    key: Key,
    is_walk: BoolScalar,
    state: ChainState,
    target: StructureTarget,
    mixture: LaplaceMixture,
    settings: ChainSettings,
    is_adapting: BoolScalar | bool,
) -> tuple[ChainState, MoveInfo]:
    """A walk or a change: both proposed, one of them evaluated."""
    noise = draw_noise(key, target.dim, mixture.degrees_of_freedom)
    size = state.walk_step.step_size(is_adapting)
    change = propose_change(noise, state.point, target, mixture, settings.prior_share)
    walk = propose_walk(noise, state.point, target, mixture, size)
    proposal = jax.tree.map(lambda a, b: jnp.where(is_walk, a, b), walk, change)
    point, outcome = decide(noise.choice[3], state.point, target, mixture, proposal)
    walk_step = _adapt(
        state.walk_step, outcome, settings.walk_accept, 1.0, is_adapting & is_walk
    )
    return ChainState(point, walk_step, state.leap_step), outcome


def proposal_keys(key: Key, settings: ChainSettings) -> Array:
    """Keys of the jumps that an iteration with this key proposes."""
    return _split_key(key, settings)[0]


def _split_key(key: Key, settings: ChainSettings) -> tuple[Array, Array, Key, Key]:
    """Keys of jump proposals, local moves, jump verdicts and leap."""
    num_jumps = settings.num_jumps
    num_local = settings.num_changes + settings.num_walks
    keys = jax.random.split(key, num_jumps + num_local + 2)
    return keys[:num_jumps], keys[num_jumps:-2], keys[-2], keys[-1]


@eqx.filter_jit
def run_chains(
    key: Key,
    target: StructureTarget,
    mixture: LaplaceMixture,
    *,
    num_chains: int,
    num_warmup: int,
    num_samples: int,
    settings: ChainSettings | None = None,
) -> tuple[ChainDraws, RunInfo]:
    """Run chains side by side in one compiled scan; vmap it over objects.

    All jumps of the whole run are drawn and evaluated first, in batches. They are the
    same draws as those of single calls of `step`; their likelihoods may differ in the
    last bits, because a compiler orders the sums of a batch differently.

    Args:
        key: random key.
        target: the density to sample. Arrays that its likelihood uses should be leaves
            of an `equinox.Module`, not closed over, so that new data do not recompile.
        mixture: the proposal.
        num_chains: chains, each started on its own.
        num_warmup: iterations that adapt step sizes and are thrown away.
        num_samples: iterations to keep.
        settings: how often to make each move.

    Returns:
        Draws `[chain, draw]`, and counts, step sizes and final states.
    """
    settings = ChainSettings() if settings is None else settings
    init_key, run_key = jax.random.split(key)
    num_steps = num_warmup + num_samples
    keys = jax.random.split(run_key, (num_steps, num_chains))
    init_keys = jax.vmap(lambda key: jax.random.split(key, settings.num_starts + 1))(
        jax.random.split(init_key, num_chains)
    )
    jump_keys = jax.vmap(jax.vmap(lambda key: proposal_keys(key, settings)))(keys)
    starts, candidates = _propose_ahead(
        (init_keys[:, :-1], jump_keys), target, mixture, settings.chunk_size
    )
    states = jax.vmap(_start)(init_keys[:, -1], starts)

    def iterate(carry: tuple, inputs: tuple) -> tuple[tuple, Point]:
        states, totals = carry
        is_adapting, keys, candidates = inputs
        states, infos = jax.vmap(
            lambda key, state, candidates: step(
                key,
                state,
                target,
                mixture,
                settings,
                is_adapting=is_adapting,
                candidates=candidates,
            )
        )(keys, states, candidates)
        totals = jax.tree.map(
            lambda total, count: total + jnp.where(is_adapting, 0, count),
            totals,
            infos,
        )
        return (states, totals), states.point

    zeros = jnp.zeros((num_chains, len(MOVES), 2), jnp.int32)
    is_adapting = jnp.arange(num_steps) < num_warmup
    (states, totals), points = jax.lax.scan(
        iterate, (states, ChainInfo(zeros, zeros)), (is_adapting, keys, candidates)
    )
    kept = jax.tree.map(lambda leaf: jnp.swapaxes(leaf[num_warmup:], 0, 1), points)
    draws = ChainDraws(kept.structure, kept.z, kept.log_density)
    return draws, RunInfo(
        proposed=totals.proposed,
        accepted=totals.accepted,
        walk_step=states.walk_step.step_size(False),
        leap_step=states.leap_step.step_size(False),
        state=states,
    )


def _propose_ahead(
    keys: tuple[Array, Array],
    target: StructureTarget,
    mixture: LaplaceMixture,
    chunk_size: int,
) -> tuple[Point, Point]:
    """Draw and evaluate for arrays of keys, in chunks of one size.

    The last chunk is filled up, so that the likelihood is compiled once.
    """
    flat = jnp.concatenate([array.reshape(-1) for array in keys])
    chunk_size = min(chunk_size, flat.size)
    num_chunks = -(-flat.size // chunk_size)
    index = jnp.minimum(jnp.arange(num_chunks * chunk_size), flat.size - 1)
    chunks = flat[index].reshape(num_chunks, chunk_size)
    propose = jax.vmap(lambda key: propose_jump(key, target, mixture))
    points = jax.tree.map(
        lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), jax.lax.map(propose, chunks)
    )
    ends = (keys[0].size, flat.size)
    return tuple(
        jax.tree.map(
            lambda leaf, array=array, end=end: leaf[end - array.size : end].reshape(
                *array.shape, *leaf.shape[1:]
            ),
            points,
        )
        for array, end in zip(keys, ends, strict=True)
    )


def _count(info: ChainInfo, index: Array, outcome: MoveInfo) -> ChainInfo:
    """Add the outcomes of several moves, whose index in `MOVES` is given."""
    column = outcome.changes_structure.astype(jnp.int32)
    return ChainInfo(
        info.proposed.at[index, column].add(outcome.is_made.astype(jnp.int32)),
        info.accepted.at[index, column].add(outcome.accepted.astype(jnp.int32)),
    )


def _adapt(
    state: DualAveraging,
    outcome: MoveInfo,
    target_accept: float,
    max_step: float,
    is_adapting: BoolScalar | bool,
) -> DualAveraging:
    new = update_dual_averaging(
        state, outcome.accept_probability, target_accept, max_step
    )
    keep = is_adapting & outcome.is_made
    return jax.tree.map(lambda a, b: jnp.where(keep, a, b), new, state)
