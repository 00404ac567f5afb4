"""Many chains over kinds side by side: from a start at random to kept draws."""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.kinds.collapsed_gibbs import fill_in, sweep_collapsed
from boomdp_jax.inference.kinds.object_moves import draw_index
from boomdp_jax.inference.kinds.pairs import log_pairs
from boomdp_jax.inference.kinds.state import (
    KindData,
    KindState,
    Tallies,
    add_object,
    compact,
    log_joint,
    no_tallies,
)
from boomdp_jax.inference.kinds.stick_breaking import sweep_sticks

SAMPLERS = ("collapsed", "sticks")
"""Ways to sample; see `collapsed_gibbs` and `stick_breaking`."""


class KindSettings(NamedTuple):
    """How much to draw."""

    num_chains: int = 32
    """Run side by side: one batch of likelihoods serves them all."""
    num_warmup: int = 60
    num_samples: int = 150
    """Sweeps of each chain that are thrown away, and that are kept."""
    sampler: str = "collapsed"
    num_kinds: int = 20
    """Where the stick-breaking mixture is cut off."""
    concentration: float | None = None
    """Fixed concentration; None: inferred."""


class KindDraws(NamedTuple):
    """Draws of all chains; `[chain, draw, ...]`."""

    kind: np.ndarray
    """Number of each object's kind, which means nothing by itself, `[..., N]`."""
    structure: np.ndarray
    z: np.ndarray
    log_likelihood: np.ndarray
    log_joint: np.ndarray
    """`[chain, draw]`."""
    concentration: np.ndarray
    """`[chain, draw]`."""
    acceptance: np.ndarray
    """Of each object's proposals, mean over all chains and kept sweeps, `[N]`."""
    state: KindState
    """After the last sweep: what is learnt of the kinds."""


def run_kind_chains(
    rng: np.random.Generator,
    data: KindData,
    settings: KindSettings,
    before: Tallies | None = None,
    before_spread: np.ndarray | None = None,
    before_concentration: np.ndarray | None = None,
) -> KindDraws:
    """Sample kinds, structures and coordinates of a set of objects.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        settings: how much to draw.
        before: kinds known before, a set for each chain.
        before_spread: their spreads.
        before_concentration: of each chain, with `before`.

    Returns:
        The draws.
    """
    state = start_chains(rng, data, settings, before, before_spread)
    is_fixed = settings.concentration is not None
    if before_concentration is not None and not is_fixed:
        state.concentration[:] = before_concentration
    kept: dict[str, list] = {name: [] for name in KindDraws._fields[:6]}
    accepted = np.zeros(data.num_objects)
    log_pair = log_pairs(data)
    for number in range(settings.num_warmup + settings.num_samples):
        if settings.sampler == "sticks":
            state, share = sweep_sticks(
                rng,
                data,
                state,
                num_kinds=settings.num_kinds,
                fixed_concentration=is_fixed,
            )
        else:
            state, share = sweep_collapsed(
                rng, data, state, number, log_pair, fixed_concentration=is_fixed
            )
        if number < settings.num_warmup:
            continue
        accepted += share / settings.num_samples
        structure, z = fill_in(rng, data, state)
        values = (
            state.kind.copy(),
            structure,
            z,
            state.log_likelihood.copy(),
            log_joint(data, state),
            state.concentration.copy(),
        )
        for name, value in zip(kept, values, strict=True):
            kept[name].append(value)
    stacked = {name: np.stack(values, axis=1) for name, values in kept.items()}
    return KindDraws(**stacked, acceptance=accepted, state=compact(rng, data, state))


def start_chains(
    rng: np.random.Generator,
    data: KindData,
    settings: KindSettings,
    before: Tallies | None = None,
    before_spread: np.ndarray | None = None,
) -> KindState:
    """Each object of a kind of its own, or of a random one of those known before.

    Objects come together one by one far more easily than a kind of many comes apart.
    Structures and coordinates come from the bumps.
    """
    num_chains, num_objects = settings.num_chains, data.num_objects
    if before is None:
        before = no_tallies(data, num_chains, 0)
    num_before = before.num_slots
    shape = (num_chains, num_objects)
    kind = np.broadcast_to(np.arange(num_objects), shape).copy()
    if settings.sampler == "sticks":
        kind = rng.integers(0, settings.num_kinds, shape)
    if num_before:
        with np.errstate(divide="ignore"):
            weight = np.log(before.count)[:, None, :]
        kind = draw_index(rng, np.broadcast_to(weight, (*shape, num_before)))
    num_slots = max(num_before + num_objects, settings.num_kinds)
    spread = data.coordinates.draw_spread(rng, (num_chains, num_slots))
    if before_spread is not None:
        spread[:, :num_before] = before_spread
    structure = np.zeros((num_chains, num_objects), int)
    z = np.zeros((num_chains, num_objects, data.dim))
    log_likelihood = np.zeros((num_chains, num_objects))
    for i in np.flatnonzero(data.is_seen):
        bumps = data.bumps[i]
        assert bumps is not None
        weight = bumps.log_height + data.log_prior[bumps.structure]
        # Heights are at the centres, where the prior's density belongs to the weight.
        weight = weight - 0.5 * np.sum(bumps.centre**2, axis=1)
        chosen = draw_index(rng, np.broadcast_to(weight, (num_chains, bumps.num)))
        structure[:, i], z[:, i] = bumps.structure[chosen], bumps.centre[chosen]
        log_likelihood[:, i] = data.log_likelihood(
            np.full(num_chains, i), structure[:, i], z[:, i]
        )
    start = settings.concentration
    prior = data.prior
    if start is None:
        start = prior.concentration_shape / prior.concentration_rate
    state = KindState(
        kind=kind,
        structure=structure,
        z=z,
        log_likelihood=log_likelihood,
        spread=spread,
        concentration=np.full(num_chains, float(start)),
        tallies=no_tallies(data, num_chains, num_slots),
        before=before,
    )
    for whole, known in zip(state.tallies, before, strict=True):
        whole[:, :num_before] = known
    for i in range(num_objects):
        add_object(data, state, i, 1.0)
    return state
