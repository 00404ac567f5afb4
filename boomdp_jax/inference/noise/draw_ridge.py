"""Where coordinates that readings tell well lie, given those that they tell little of.

What is hardly known has a posterior nearly as wide as the prior, and over such a width
nothing is linear: the ridge along which the others lie bends. A regression of second
degree over draws follows it; of doors that rub on their hinge and on the floor it left
draws within 1.2 standard deviations of what is known of them there, where a linear one
left them within 2.5 (six and more without any).
"""

from typing import NamedTuple

import numpy as np

from boomdp_jax.inference.hypotheses.periods import wrapped

# Draws for each number of the regression, below which it has fewer numbers.
_FOR_EACH = 4


class DrawRidge(NamedTuple):
    """Where tight coordinates of a group lie, given the wide ones; host."""

    wide: np.ndarray
    """Which coordinates are wide, `[number]`; where the features have their zero, and
    how wide they are."""
    middle: np.ndarray
    width: np.ndarray
    period: np.ndarray
    """Of all coordinates."""
    degree: int
    base: np.ndarray
    """Of the tight ones, which are near it, `[place]`."""
    factor: np.ndarray
    """`[feature, place]`."""

    @classmethod
    def fit(
        cls,
        z: np.ndarray,
        place: np.ndarray,
        wide: np.ndarray,
        champion: np.ndarray,
        period: np.ndarray,
    ) -> "DrawRidge":
        """By least squares over the draws of a group.

        Args:
            z: their coordinates, `[draw, dim]`.
            place: the tight ones among them; `dim` where a place has none.
            wide: the wide ones.
            champion: near which all tight ones are, `[dim]`.
            period: of each coordinate; zero: it has none.
        """
        base = np.pad(champion, (0, 1))[place]
        offset = np.pad(z, ((0, 0), (0, 1)))[:, place] - base[None]
        offset = wrapped(offset, np.pad(period, (0, 1))[place])
        middle = champion[wide]
        spread = wrapped(z[:, wide] - middle, period[wide]).std(axis=0)
        width = np.maximum(spread, 1e-3)
        ridge = cls(wide, middle, width, period, 2, base, np.zeros((0, len(place))))
        for degree in (2, 1, 0):
            ridge = ridge._replace(degree=degree)
            features = ridge._features(z)
            if len(z) >= _FOR_EACH * features.shape[1]:
                break
        factor = np.linalg.lstsq(features, offset, rcond=1e-8)[0]
        if len(z) < _FOR_EACH:
            factor = 0.0 * factor
        return ridge._replace(factor=factor)

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """Where they are of draws `[draw, dim]`; `[draw, place]`."""
        return self.base + self._features(z) @ self.factor

    def _features(self, z: np.ndarray) -> np.ndarray:
        offset = wrapped(z[:, self.wide] - self.middle, self.period[self.wide])
        turn = 2.0 * np.pi / np.where(self.period > 0, self.period, 1.0)[self.wide]
        is_angle = self.period[self.wide] > 0
        # An angle's features are the same after a period.
        first = np.where(is_angle, np.sin(turn * offset), offset / self.width)
        features = [np.ones((len(z), 1))]
        if self.degree >= 1:
            features.append(first)
        if self.degree == 2:
            one, two = np.triu_indices(len(self.wide))
            both = first[:, one] * first[:, two]
            is_square = (one == two) & is_angle[one]
            features.append(np.where(is_square, np.cos(turn * offset)[:, one], both))
        return np.concatenate(features, axis=1)
