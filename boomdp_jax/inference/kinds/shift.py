"""All objects of a kind moved together, along what the data leave open.

What objects of a kind share but none of them shows (the knee of their friction, say) is
known to each from the others, tightly: moved one by one they hardly get anywhere. Here
every kind in every chain proposes one common shift, drawn from about what its objects'
bumps leave open together, and accepts or refuses it by their true likelihoods. It is
symmetric, as it does not depend on where the objects are. The spreads must be drawn
afresh after it: they are integrated out here.
"""

import numpy as np

from boomdp_jax.inference.kinds.coordinates import wrap
from boomdp_jax.inference.kinds.state import (
    KindData,
    KindState,
    add_object,
    log_coordinates,
    no_tallies,
)

# How far shifts go, in sd of what is left open.
_SHARES = (0.1, 0.2, 0.4, 0.8)


def shift_kinds(
    rng: np.random.Generator, data: KindData, state: KindState
) -> KindState:
    """Propose one shift for every kind of every chain."""
    shape, dim = state.tallies.count.shape, data.dim
    seen = np.flatnonzero(data.is_seen).tolist()
    is_shared = np.ptp(1.0 / data.coordinates.spread[:dim], axis=1) > 0
    if not seen or not is_shared.any():
        return state
    chains = np.arange(shape[0])
    precision = np.broadcast_to(np.eye(dim), (*shape, dim, dim)).copy()
    for i in seen:
        bumps = data.bumps[i]
        assert bumps is not None
        # The first bump of the structure that the object has.
        first = np.argmax(bumps.structure == state.structure[:, i : i + 1], axis=1)
        told = np.einsum("mdr,mer->mde", bumps.factor, bumps.factor)[first]
        precision[chains, state.kind[:, i]] += told
    # What is not shared stays, and what is moves given that.
    precision[..., ~is_shared, :] = 0.0
    precision[..., :, ~is_shared] = 0.0
    precision[..., ~is_shared, ~is_shared] = 0.0
    precision += np.diag((~is_shared).astype(float))
    root = np.linalg.cholesky(precision)
    normal = rng.standard_normal((*shape, dim, 1))
    shift = np.linalg.solve(np.swapaxes(root, -1, -2), normal)[..., 0]
    shift *= rng.choice(_SHARES, size=shape)[..., None] * is_shared
    moved = state._replace(
        z=state.z.copy(),
        log_likelihood=state.log_likelihood.copy(),
        tallies=no_tallies(data, *shape),
    )
    period = data.coordinates.period[:dim]
    for i in seen:
        in_use = data.in_use[state.structure[:, i]]
        new = wrap(state.z[:, i] + shift[chains, state.kind[:, i]], period)
        moved.z[:, i] = np.where(in_use, new, 0.0)
    index = np.repeat(seen, shape[0])
    points = np.swapaxes(moved.z[:, seen], 0, 1).reshape(-1, dim)
    found = data.log_likelihood(index, state.structure[:, seen].T.reshape(-1), points)
    moved.log_likelihood[:, seen] = found.reshape(len(seen), -1).T
    for whole, known in zip(moved.tallies, state.before, strict=True):
        whole[:, : state.before.num_slots] = known
    for i in range(data.num_objects):
        add_object(data, moved, i, 1.0)
    log_odds = log_coordinates(data, moved.tallies)
    log_odds = log_odds - log_coordinates(data, state.tallies)
    for i in seen:
        gain = moved.log_likelihood[:, i] - state.log_likelihood[:, i]
        log_odds[chains, state.kind[:, i]] += gain
    level = np.log(1.0 - rng.random(shape))
    is_taken = level < np.nan_to_num(log_odds, nan=-np.inf)
    for i in seen:
        taken = is_taken[chains, state.kind[:, i]]
        state.z[taken, i] = moved.z[taken, i]
        state.log_likelihood[taken, i] = moved.log_likelihood[taken, i]
    for whole, new in zip(state.tallies, moved.tallies, strict=True):
        whole[is_taken] = new[is_taken]
    return state
