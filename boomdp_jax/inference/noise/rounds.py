"""Proposals of noise that follow each other, each fitted to what weights have shown.

Draws of all count as draws of what the proposals are together (Cornuet et al. 2012,
Adaptive multiple importance sampling): where an earlier one had next to none of what
there is, a later one has, and no draw counts for all the others.
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.noise.proposal import NoiseProposal


class NoiseRounds(NamedTuple):
    """What noises of a list of groups were drawn from."""

    first: NoiseProposal
    latest: NoiseProposal
    whole: NoiseProposal
    """All of them that a group had, each with an equal share."""
    num: int
    """Most of them."""

    @classmethod
    def of(cls, first: NoiseProposal) -> "NoiseRounds":
        """One round."""
        return cls(first, first, first, 1)

    def further(
        self,
        rng: np.random.Generator,
        vector: np.ndarray,
        log_weight: np.ndarray,
        group: np.ndarray,
    ) -> "NoiseRounds":
        """With a proposal more for groups that have any draws here.

        These must have had all that there were, as the others of a batch need not.

        Args:
            rng: source of randomness.
            vector: logarithms of the noises of all rounds, `[draw, number]`.
            log_weight: of each, under `whole`.
            group: of each.
        """
        latest = self.first.refitted(rng, vector, log_weight, group)
        num = self.num + 1
        # Draws of the others are of what they were.
        has_more = np.isin(np.arange(len(self.first.log_share)), group)
        whole = self.whole.mixed_with(latest, has_more / num)
        return NoiseRounds(self.first, latest, whole, num)
