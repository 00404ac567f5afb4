r"""Kinds of all objects at once, given the kinds' shares and means: truncated sticks.

The mixture is cut off at a fixed number of kinds, whose shares are broken off a stick:
$\pi_t = v_t \prod_{s < t} (1 - v_s)$, $v_t \sim \mathrm{Beta}(1, \alpha)$. With n
objects and T kinds the truncated prior differs from the whole by about
$4 n e^{-(T - 1) / \alpha}$ (Ishwaran and James (2001), Gibbs sampling methods for
stick-breaking priors, theorem 2). Given shares, means and spreads all objects are
independent: one batch of likelihoods serves a sweep. A new kind must first happen to
have a mean that suits an object, which in many dimensions it does not: prefer
`collapsed_gibbs`, and this where objects are many and say little.
"""

import numpy as np

from boomdp_jax.inference.kinds.collapsed_gibbs import (
    decide,
    draw_spreads,
    num_tries,
)
from boomdp_jax.inference.kinds.concentration import draw_stick_concentration
from boomdp_jax.inference.kinds.object_moves import Kinds, ObjectMove, draw_index
from boomdp_jax.inference.kinds.state import (
    KindData,
    KindState,
    add_object,
    label_base,
    no_tallies,
)


def sweep_sticks(
    rng: np.random.Generator,
    data: KindData,
    state: KindState,
    *,
    num_kinds: int,
    fixed_concentration: bool = False,
) -> tuple[KindState, np.ndarray]:
    """Draw sticks, means and spreads, and then all objects given them.

    Args:
        rng: source of randomness.
        data: what is known of the objects.
        state: of all chains; no kinds may be known before.
        num_kinds: where the mixture is cut off.
        fixed_concentration: whether to leave the concentration as it is.

    Returns:
        The new state, and the share of chains that accepted, `[N]`.
    """
    state = _with_slots(rng, data, state, num_kinds)
    model, dim = data.coordinates, data.dim
    tallies = state.tallies
    draw_spreads(rng, data, state)
    centre = model.draw_centre(
        rng, tallies.num, tallies.first, tallies.second, state.spread
    )
    shares, sticks = _draw_shares(rng, tallies.count, state.concentration)
    structures = _draw_dirichlet(
        rng, tallies.structure, data.prior.structure_weight * np.exp(data.log_prior)
    )
    labels = _draw_dirichlet(rng, tallies.label, label_base(data))
    part = model.part(0, dim)
    spread = state.spread[..., :dim]
    variance = part.chosen_spread(spread) ** 2
    angles = part.angles
    wide = np.broadcast_to(part.period[angles] ** 2 / 12, variance[..., angles].shape)
    variance[..., angles] = np.minimum(variance[..., angles], wide)
    chains = np.arange(len(state.kind))

    def log_exact(chain: np.ndarray, kind: np.ndarray, z: np.ndarray) -> np.ndarray:
        own = centre[chain, kind, :dim]
        return part.log_given_centre(z, own, spread[chain, kind])

    accepted = np.ones(data.num_objects)
    with np.errstate(divide="ignore"):
        log_structures, log_labels = np.log(structures), np.log(labels)
        log_shares = np.log(shares)
    for i in range(data.num_objects):
        log_weight = log_shares + _log_evidence(data, state, i, centre, log_labels)
        bumps = data.bumps[i]
        if bumps is None:
            state.kind[:, i] = draw_index(rng, log_weight)
            continue
        kinds = Kinds(
            log_weight, log_structures, centre[..., :dim], variance, log_exact
        )
        move = ObjectMove(bumps, data.in_use, part.period, kinds)
        own = (state.kind[:, i], state.structure[:, i], state.z[:, i])
        before = move.log_ratio(chains, *own)
        choice = move.draw(rng, num_tries(len(chains)))
        accepted[i] = decide(rng, data, state, i, choice, before)
    if not fixed_concentration:
        state.concentration[:] = draw_stick_concentration(
            rng, sticks, data.prior.concentration_shape, data.prior.concentration_rate
        )
    return _with_slots(rng, data, state, num_kinds), accepted


def _with_slots(rng, data: KindData, state: KindState, num_kinds: int) -> KindState:
    """Tally afresh, with a fixed number of kinds, which keep their places."""
    num_chains = len(state.kind)
    spread = state.spread
    if spread.shape[1] != num_kinds:
        spread = data.coordinates.draw_spread(rng, (num_chains, num_kinds))
    state = state._replace(
        spread=spread, tallies=no_tallies(data, num_chains, num_kinds)
    )
    for i in range(data.num_objects):
        add_object(data, state, i, 1.0)
    return state


def _draw_shares(rng, count: np.ndarray, concentration: np.ndarray):
    """Shares of the kinds, and the sticks behind them."""
    later = np.cumsum(count[:, ::-1], axis=1)[:, ::-1] - count
    sticks = rng.beta(1.0 + count, concentration[:, None] + later)
    sticks[:, -1] = 1.0
    left = np.cumprod(1.0 - sticks, axis=1)
    left = np.concatenate([np.ones_like(left[:, :1]), left[:, :-1]], axis=1)
    return sticks * left, sticks[:, :-1]


def _draw_dirichlet(rng, count: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Probabilities given counts; by logarithms, as small shapes underflow."""
    shape = count + base
    grown = rng.gamma(shape + 1.0)
    with np.errstate(divide="ignore"):
        log_gamma = np.log(grown) + np.log(rng.random(shape.shape)) / shape
    weight = np.exp(log_gamma - log_gamma.max(axis=-1, keepdims=True))
    return weight / weight.sum(axis=-1, keepdims=True)


def _log_evidence(data: KindData, state, i: int, centre, log_labels) -> np.ndarray:
    """What label and outline of an object say of its kind, `[chain, kind]`."""
    out = np.zeros(centre.shape[:2])
    if data.label[i] >= 0:
        out = out + log_labels[..., data.label[i]]
    if data.feature.shape[1]:
        model = data.coordinates
        value = np.zeros(centre.shape)
        value[..., data.dim :] = data.feature[i]
        each = model.log_given_centre(value, centre, state.spread)
        out = out + each[..., data.dim :].sum(axis=-1)
    return out
