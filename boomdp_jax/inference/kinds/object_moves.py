r"""One object's kind, structure and coordinates, proposed together in every chain.

Its coordinates are integrated out by bumps in place of its likelihood, so that an
object which says little of a coordinate can change kinds whatever the tight kind that
it leaves says of it. What is proposed is accepted by the true likelihood: with kinds c
of weight w, the target is $w_c\,P(k|c)\,p(z|c)\,L(k, z)$ and the proposal, which
does not depend on where the chain is, that with $\sum_m L_m$ in place of L (Neal
(2000), Markov chain sampling methods for Dirichlet process mixture models, section 4;
Metropolis-Hastings in place of Gibbs where L is no bump).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.kinds.coordinates import wrap
from boomdp_jax.inference.kinds.likelihood_bumps import (
    Bumps,
    draw_product,
    log_bump,
    log_mass,
    log_normal,
    start_of_bumps,
)


class Kinds(NamedTuple):
    """What every kind says of one object; `[chain, kind, ...]`."""

    log_weight: np.ndarray
    """Of the kind, labels and outlines included; need not be normalised."""
    log_structure: np.ndarray
    """`[chain, kind, K]`."""
    mean: np.ndarray
    """Of a normal distribution near the kind's coordinates, `[chain, kind, dim]`."""
    variance: np.ndarray
    log_exact: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
    """Exact log-density of each coordinate, `[point, dim]`, from chains, kinds and
    coordinates of points."""


class Choice(NamedTuple):
    """Kinds, structures and coordinates that are proposed; leading axis `point`."""

    chain: np.ndarray
    """To which chain."""
    kind: np.ndarray
    structure: np.ndarray
    z: np.ndarray
    log_ratio: np.ndarray
    """Log of target over proposal, the likelihood left out."""
    is_inside: np.ndarray
    """False where an angle fell outside of its cell; then the chain stays."""


class ObjectMove:
    """Proposals for one object, given what all kinds say of it."""

    def __init__(
        self, bumps: Bumps, in_use: np.ndarray, period: np.ndarray, kinds: Kinds
    ):
        """Weigh all kinds and bumps.

        Args:
            bumps: of the object.
            in_use: coordinates that a structure uses, `[K, dim]`.
            period: of angles, else 0, `[dim]`.
            kinds: what they say.
        """
        self._bumps, self._in_use, self._period = bumps, in_use, period
        self._log_exact = kinds.log_exact
        # Of slots that nothing can go to there is nothing to work out.
        pairs = np.nonzero(kinds.log_weight > -np.inf)
        self._pair = np.zeros(kinds.log_weight.shape, int)
        self._pair[pairs] = np.arange(len(pairs[0]))
        self._variance = kinds.variance[pairs]
        self._start = start_of_bumps(bumps, period, kinds.mean[pairs], self._variance)
        mass, self._lower = log_mass(bumps, self._start, self._variance)
        mass += kinds.log_structure[pairs][:, bumps.structure]
        self._log_weight = np.full((*kinds.log_weight.shape, bumps.num), -np.inf)
        self._log_weight[pairs] = mass + kinds.log_weight[pairs][:, None]

    @property
    def log_total(self) -> np.ndarray:
        """Log of what all kinds and bumps weigh together, `[chain]`."""
        flat = self._log_weight.reshape(len(self._log_weight), -1)
        highest = flat.max(axis=1)
        return highest + np.log(np.exp(flat - highest[:, None]).sum(axis=1))

    def draw(self, rng: np.random.Generator, num_tries: int = 1) -> Choice:
        """Propose kind, structure and coordinates afresh.

        Args:
            rng: source of randomness.
            num_tries: proposals of each chain, which are neighbours in the answer.
        """
        chain, kind, bump = self._draw_bumps(rng, num_tries)
        choice = self._choice(chain, kind, bump, self._product(chain, kind, bump, rng))
        found = (choice.chain, choice.kind, choice.structure, choice.z)
        return choice._replace(log_ratio=self.log_ratio(*found))

    def draw_or_keep(
        self,
        rng: np.random.Generator,
        is_kept: np.ndarray,
        kind: np.ndarray,
        structure: np.ndarray,
        z: np.ndarray,
    ) -> Choice:
        """Propose afresh in some chains; in the others, take what is given.

        Args:
            rng: source of randomness.
            is_kept: which chains take what is given, `[chain]`.
            kind: for those; of the others, anything.
            structure: likewise.
            z: likewise, `[chain, dim]`.
        """
        chain, new, bump = self._draw_bumps(rng, 1)
        choice = self._choice(chain, new, bump, self._product(chain, new, bump, rng))
        kind = np.where(is_kept, kind, choice.kind)
        structure = np.where(is_kept, structure, choice.structure)
        z = np.where(is_kept[:, None], z, choice.z)
        ratio = self.log_ratio(chain, kind, structure, z)
        return Choice(chain, kind, structure, z, ratio, choice.is_inside | is_kept)

    def log_ratio(
        self,
        chain: np.ndarray,
        kind: np.ndarray,
        structure: np.ndarray,
        z: np.ndarray,
    ) -> np.ndarray:
        """Log of target over proposal at any points, the likelihood left out."""
        pair = self._pair[chain, kind]
        in_use = self._in_use[structure]
        start, variance = self._start[pair], self._variance[pair]
        offset = wrap(z[:, None, :] - self._bumps.centre, self._period)
        density = log_normal(
            offset, start, variance[:, None, :], in_use[:, None, :]
        ) + log_bump(self._bumps, z, self._period)
        density = np.where(
            self._bumps.structure == structure[:, None], density, -np.inf
        )
        highest = density.max(axis=1)
        proposal = highest + np.log(np.exp(density - highest[:, None]).sum(axis=1))
        exact = self._log_exact(chain, kind, z)
        return np.sum(np.where(in_use, exact, 0.0), axis=1) - proposal

    def nudge(
        self,
        rng: np.random.Generator,
        kind: np.ndarray,
        structure: np.ndarray,
        z: np.ndarray,
        share: float,
    ) -> tuple[Choice, np.ndarray]:
        """Propose coordinates near the old ones, kind and structure kept.

        The autoregressive proposal that leaves one bump times the kind unchanged
        (Cotter et al. (2013), MCMC methods for functions, section 4.2).

        Args:
            rng: source of randomness.
            kind: of each chain.
            structure: of each chain.
            z: coordinates, `[chain, dim]`.
            share: how far to move, in (0, 1]; 1 draws afresh.

        Returns:
            The proposal, and the log-ratio at the old point that belongs to it.
        """
        chains = np.arange(len(kind))
        of_kind = self._log_weight[chains, kind]
        is_same = self._bumps.structure == structure[:, None]
        bump = draw_index(rng, np.where(is_same, of_kind, -np.inf))
        offset = wrap(z - self._bumps.centre[bump], self._period)
        mean = self._product(chains, kind, bump, None)
        fresh = self._product(chains, kind, bump, rng)
        new = mean + np.sqrt(1.0 - share**2) * (offset - mean) + share * (fresh - mean)
        choice = self._choice(chains, kind, bump, new)
        before = self._one_bump_ratio(kind, bump, offset, z)
        after = self._one_bump_ratio(kind, bump, new, choice.z)
        return choice._replace(log_ratio=after), before

    def _draw_bumps(self, rng, num_tries: int) -> tuple[np.ndarray, ...]:
        """A chain, a kind and a bump for each proposal."""
        num_chains = len(self._log_weight)
        flat = self._log_weight.reshape(num_chains, -1)
        chosen = draw_index(rng, flat, num_tries).reshape(-1)
        return np.repeat(np.arange(num_chains), num_tries), *np.divmod(
            chosen, self._bumps.num
        )

    def _product(self, chain, kind, bump, rng) -> np.ndarray:
        """A draw of bumps times kinds, or their means; relative to the centres."""
        pair = self._pair[chain, kind]
        residual = self._bumps.residual[bump]
        start = self._start[pair, bump]
        zero, none = np.zeros_like(start), np.zeros_like(residual)
        return draw_product(
            self._bumps.factor[bump],
            residual,
            self._lower[pair, bump],
            start,
            self._variance[pair],
            zero if rng is None else rng.standard_normal(start.shape),
            none if rng is None else rng.standard_normal(residual.shape),
        )

    def _choice(self, chain, kind, bump, offset) -> Choice:
        structure = self._bumps.structure[bump]
        in_use = self._in_use[structure]
        is_angle = (self._period > 0) & in_use
        is_inside = np.all(~is_angle | (2.0 * np.abs(offset) < self._period), axis=1)
        z = wrap(self._bumps.centre[bump] + offset, self._period)
        z = np.where(in_use, z, 0.0)
        return Choice(chain, kind, structure, z, np.zeros(len(kind)), is_inside)

    def _one_bump_ratio(self, kind, bump, offset, z) -> np.ndarray:
        """Exact density over that of one bump times the kind's normal density."""
        chains = np.arange(len(kind))
        pair = self._pair[chains, kind]
        in_use = self._in_use[self._bumps.structure[bump]]
        start, variance = self._start[pair, bump], self._variance[pair]
        normal = log_normal(offset, start, variance, in_use)
        gap = np.einsum("pd,pdr->pr", offset, self._bumps.factor[bump])
        gap -= self._bumps.residual[bump]
        exact = np.where(in_use, self._log_exact(chains, kind, z), 0.0).sum(axis=1)
        return exact - normal + 0.5 * np.sum(gap**2, axis=1)


def draw_index(
    rng: np.random.Generator, log_weight: np.ndarray, num: int | None = None
) -> np.ndarray:
    """Indices of the last axis with probability in proportion to exp(log-weight).

    Args:
        rng: source of randomness.
        log_weight: at least one of each row is finite.
        num: how many of each row, `[..., num]`; None: one, `[...]`.
    """
    weight = np.exp(log_weight - log_weight.max(axis=-1, keepdims=True))
    cumulative = np.cumsum(weight, axis=-1)
    shape = (*cumulative.shape[:-1], 1 if num is None else num)
    level = (1.0 - rng.random(shape)) * cumulative[..., -1:]
    found = np.sum(cumulative[..., None, :] < level[..., None], axis=-1)
    return found[..., 0] if num is None else found
