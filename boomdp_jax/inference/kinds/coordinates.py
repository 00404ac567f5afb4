r"""How one coordinate is distributed over the objects of a kind, in closed form.

For a plain coordinate $\mu \sim N(0, 1 - \tau^2)$ and $z_i \sim N(\mu, \tau^2)$, for an
angle of period $P$, with $\omega = 2 \pi / P$, $\mu$ is uniform and
$\omega z_i \sim \mathrm{vonMises}(\omega \mu, \kappa)$. Both are conjugate given the
spread, which is one of a short list; a single object has the ordinary prior whatever
the spread. What objects tell enters through sums of $(z, z^2)$, or of
$(\cos \omega z, \sin \omega z)$ (Mardia and Jupp (2000), Directional Statistics,
section 12.5).
"""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

_LARGE = 30.0
"""Argument of the Bessel function from which its asymptotic series is used: the first
term left out is under 1e-9."""


@dataclasses.dataclass(frozen=True, eq=False)
class CoordinateModel:
    """Distributions of all coordinates within a kind; `D` coordinates, `G` spreads."""

    period: np.ndarray
    """Of angles, else 0, `[D]`."""
    spread: np.ndarray
    """Sd within a kind, `[D, G]`; of an angle in the same unit as the angle; infinite
    where it is not shared."""
    log_weight: np.ndarray
    """Log-probability of each spread, `[D, G]`."""

    @property
    def dim(self) -> int:
        """How many coordinates there are."""
        return self.spread.shape[0]

    def part(self, start: int, stop: int) -> "CoordinateModel":
        """Some coordinates, in a row."""
        if (start, stop) not in self._parts:
            self._parts[start, stop] = CoordinateModel(
                self.period[start:stop],
                self.spread[start:stop],
                self.log_weight[start:stop],
            )
        return self._parts[start, stop]

    @functools.cached_property
    def _parts(self) -> dict[tuple[int, int], "CoordinateModel"]:
        return {}

    @functools.cached_property
    def angles(self) -> np.ndarray:
        """Which coordinates are angles."""
        return np.flatnonzero(self.period > 0)

    @functools.cached_property
    def frequency(self) -> np.ndarray:
        """Of the angles [1/unit], `[angle]`."""
        return 2.0 * np.pi / self.period[self.angles]

    def moments(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is summed over the objects of a kind, `[..., D]` each."""
        first, second = value.copy(), value**2
        turn = self.frequency * value[..., self.angles]
        first[..., self.angles] = np.cos(turn)
        second[..., self.angles] = np.sin(turn)
        return first, second

    def draw_spread(self, rng: np.random.Generator, shape: tuple) -> np.ndarray:
        """Which spread each coordinate has, from the prior, `[*shape, D]`."""
        cumulative = np.cumsum(np.exp(self.log_weight), axis=-1)
        level = rng.random((*shape, self.dim, 1))
        place = np.sum(level > cumulative[..., :-1], axis=-1)
        return place.astype(np.int8)

    def log_marginal(
        self, num: np.ndarray, first: np.ndarray, second: np.ndarray
    ) -> np.ndarray:
        r"""Log-density of a kind's coordinates, its mean integrated out.

        $$-\tfrac{n}{2} \log 2 \pi \tau^2 - \tfrac12 \log(1 + n s^2 / \tau^2)
          - \frac{1}{2 \tau^2} \Bigl(Q - \frac{s^2 S^2}{\tau^2 + n s^2}\Bigr), \quad
          s^2 = 1 - \tau^2.$$
        For an angle $n \log(\omega / 2 \pi) + \log I_0(\kappa R) - n \log I_0(\kappa)$.

        Args:
            num: objects that have the coordinate, `[..., D]`.
            first: sums of `moments`.
            second: sums of `moments`.

        Returns:
            One number for each spread, `[..., D, G]`.
        """
        n, S, Q = num[..., None], first[..., None], second[..., None]
        v = np.where(np.isfinite(self.spread), self.spread, 1.0) ** 2
        s = 1.0 - v
        out = -0.5 * (
            n * np.log(2.0 * np.pi * v)
            + np.log1p(n * s / v)
            + (Q - s * S**2 / (v + n * s)) / v
        )
        a = self.angles
        if len(a):
            kappa = self.angle_concentration
            length = np.hypot(first[..., a], second[..., a])[..., None]
            out[..., a, :] = (
                num[..., a, None] * (-np.log(self.period[a])[:, None])
                + log_bessel(kappa * length)
                - num[..., a, None] * log_bessel(kappa)
            )
        return out

    def log_over_spreads(
        self, num: np.ndarray, first: np.ndarray, second: np.ndarray
    ) -> np.ndarray:
        """The same with the spread integrated out too, `[..., D]`."""
        each = self.log_marginal(num, first, second) + self.log_weight
        highest = each.max(axis=-1)
        return highest + np.log(np.exp(each - highest[..., None]).sum(axis=-1))

    @functools.cached_property
    def angle_concentration(self) -> np.ndarray:
        """Of each angle's von Mises distribution, `[angle, G]`."""
        return (self.frequency[:, None] * self.spread[self.angles]) ** -2.0

    def chosen_spread(self, index: np.ndarray) -> np.ndarray:
        """Spread of each coordinate, `[..., D]`, from its index."""
        return self.spread[np.arange(self.dim), index]

    def predictive(
        self, num: np.ndarray, first: np.ndarray, second: np.ndarray, index: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of another object of the kind, given its spreads.

        Exactly normal for plain coordinates; for an angle a normal near it, of the
        variance of a uniform distribution where nothing is known.

        Args:
            num: as in `log_marginal`.
            first: as in `log_marginal`.
            second: as in `log_marginal`.
            index: which spread each coordinate has, `[..., D]`.

        Returns:
            Both, `[..., D]`.
        """
        spread = self.chosen_spread(index)
        v = np.where(np.isfinite(spread), spread, 1.0) ** 2
        s = 1.0 - v
        mean = s * first / (v + num * s)
        variance = v + s * v / (v + num * s)
        a = self.angles
        if len(a):
            length = np.hypot(first[..., a], second[..., a])
            mean[..., a] = np.arctan2(second[..., a], first[..., a]) / self.frequency
            wide = self.period[a] ** 2 / 12.0
            # The direction is known to 1 / (kappa R) in squared radians of its turn.
            width = spread[..., a] ** 2 * (1.0 + 1.0 / np.maximum(length, 1e-9))
            variance[..., a] = np.minimum(width, wide)
        return mean, variance

    def log_predictive(
        self,
        value: np.ndarray,
        num: np.ndarray,
        first: np.ndarray,
        second: np.ndarray,
        index: np.ndarray,
    ) -> np.ndarray:
        """Exact log-density of another object's coordinates, `[..., D]`."""
        mean, variance = self.predictive(num, first, second, index)
        out = -0.5 * ((value - mean) ** 2 / variance + np.log(2.0 * np.pi * variance))
        a = self.angles
        if len(a):
            kappa = (self.frequency * self.chosen_spread(index)[..., a]) ** -2.0
            turn = self.frequency * value[..., a]
            before = np.hypot(first[..., a], second[..., a])
            after = np.hypot(
                first[..., a] + np.cos(turn), second[..., a] + np.sin(turn)
            )
            out[..., a] = (
                log_bessel(kappa * after)
                - log_bessel(kappa)
                - log_bessel(kappa * before)
                - np.log(self.period[a])
            )
        return out

    def log_given_sums(
        self,
        sums: Sequence[np.ndarray],
        spread: np.ndarray,
        row: np.ndarray,
        kind: np.ndarray,
        z: np.ndarray,
    ) -> np.ndarray:
        """`log_predictive` of points whose kinds are chosen from some, `[point, dim]`.

        Args:
            sums: `num`, `first` and `second` of `Tallies`, `[row, kind, dim]` each.
            spread: index of each coordinate's, `[row, kind, dim]`.
            row: of each point.
            kind: of each point.
            z: coordinates of points.
        """
        of_kind = (x[row, kind] for x in sums)
        return self.log_predictive(z, *of_kind, spread[row, kind])

    def draw_predictive(
        self,
        rng: np.random.Generator,
        num: np.ndarray,
        first: np.ndarray,
        second: np.ndarray,
        index: np.ndarray,
    ) -> np.ndarray:
        """Coordinates of another object of the kind, `[..., D]`."""
        mean, variance = self.predictive(num, first, second, index)
        out = mean + np.sqrt(variance) * rng.standard_normal(mean.shape)
        a = self.angles
        if len(a):
            centre = self.draw_centre(rng, num, first, second, index)[..., a]
            kappa = (self.frequency * self.chosen_spread(index)[..., a]) ** -2.0
            turn = rng.vonmises(self.frequency * centre, kappa)
            out[..., a] = wrap(turn / self.frequency, self.period[a])
        return out

    def draw_centre(
        self,
        rng: np.random.Generator,
        num: np.ndarray,
        first: np.ndarray,
        second: np.ndarray,
        index: np.ndarray,
    ) -> np.ndarray:
        """The kind's own mean given its objects, `[..., D]`."""
        spread = self.chosen_spread(index)
        v = np.where(np.isfinite(spread), spread, 1.0) ** 2
        s = 1.0 - v
        scale = np.sqrt(s * v / (v + num * s))
        out = s * first / (v + num * s) + scale * rng.standard_normal(num.shape)
        a = self.angles
        if len(a):
            length = np.hypot(first[..., a], second[..., a])
            kappa = (self.frequency * spread[..., a]) ** -2.0 * length
            direction = np.arctan2(second[..., a], first[..., a])
            out[..., a] = rng.vonmises(direction, kappa) / self.frequency
        return out

    def log_given_centre(
        self, value: np.ndarray, centre: np.ndarray, index: np.ndarray
    ) -> np.ndarray:
        """Log-density of an object's coordinates given its kind's mean, `[..., D]`."""
        spread = self.chosen_spread(index)
        finite = np.where(np.isfinite(spread), spread, 1.0)
        out = -0.5 * ((value - centre) / finite) ** 2
        out -= np.log(np.sqrt(2.0 * np.pi) * finite)
        a = self.angles
        if len(a):
            kappa = (self.frequency * spread[..., a]) ** -2.0
            turn = self.frequency * (value[..., a] - centre[..., a])
            out[..., a] = (
                kappa * np.cos(turn) - log_bessel(kappa) - np.log(self.period[a])
            )
        return out


def wrap(value: np.ndarray, period: np.ndarray) -> np.ndarray:
    """Bring angles into [-period/2, period/2); numbers without a period stay."""
    turn = np.where(period > 0, period, 1.0)
    return np.where(period > 0, value - turn * np.floor(value / turn + 0.5), value)


def log_bessel(x: np.ndarray) -> np.ndarray:
    """Logarithm of the modified Bessel function of order zero.

    Large arguments by its asymptotic series, Abramowitz and Stegun (1964), 9.7.1.
    """
    x = np.asarray(x, float)
    large = np.maximum(x, _LARGE)
    y = 1.0 / (8.0 * large)
    series = 1 + y * (1 + y * (9 / 2 + y * (225 / 6 + y * (11025 / 24))))
    far = large - 0.5 * np.log(2.0 * np.pi * large) + np.log(series)
    return np.where(x > _LARGE, far, np.log(np.i0(np.minimum(x, _LARGE))))
