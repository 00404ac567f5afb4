r"""Open chains of rigid links, the first on a pin, by their Lagrangian.

The coordinates are the links' headings $θ_i$ from the x-axis, so no pin can drift. With
$a_{ki}$ the lever of link $i$ in the centre of mass of link $k$ (its whole length for
$i < k$, the distance to its own centre of mass for $i = k$, else nothing),

$$M_{ij} = I_i δ_{ij} + A_{ij} \cos(θ_i - θ_j), \quad
  A_{ij} = \sum_k m_k a_{ki} a_{kj},$$
$$\sum_j M_{ij} \ddot θ_j = -\sum_j A_{ij} \sin(θ_i - θ_j) \dot θ_j^2
  - g \cos θ_i \sum_k m_k a_{ki}.$$
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp


@dataclass(frozen=True)
class Chain:
    """Links in a row; each ends where the next one is pinned."""

    length: np.ndarray
    """From a link's pin to the next one's [m]."""
    centre: np.ndarray
    """From a link's pin to its centre of mass, along the link [m]."""
    mass: np.ndarray
    inertia: np.ndarray
    """About the centre of mass [kg m²]."""
    gravity: float = 9.81
    """Downwards along y [m/s²]."""

    @property
    def num_links(self) -> int:
        return len(self.mass)

    @property
    def lever(self) -> np.ndarray:
        """Matrix a, `[link k, link i]` [m]."""
        before = np.tril(np.tile(self.length, (self.num_links, 1)), -1)
        return before + np.diag(self.centre)


def bars(
    num_links: int, *, half_length: float, half_width: float, density: float
) -> Chain:
    """A chain of equal boxes of uniform density, pinned at the ends of their axes."""
    ones = np.ones(num_links)
    mass = 4.0 * half_length * half_width * density * ones
    return Chain(
        length=2.0 * half_length * ones,
        centre=half_length * ones,
        mass=mass,
        inertia=mass * (half_length**2 + half_width**2) / 3.0,
    )


def acceleration(chain: Chain, angle: np.ndarray, spin: np.ndarray) -> np.ndarray:
    """Second derivatives of the headings [rad/s²]."""
    lever = chain.lever
    A = lever.T @ (chain.mass[:, None] * lever)
    difference = angle[:, None] - angle[None, :]
    M = np.diag(chain.inertia) + A * np.cos(difference)
    weight = chain.gravity * np.cos(angle) * (chain.mass @ lever)
    return np.linalg.solve(M, -(A * np.sin(difference)) @ spin**2 - weight)


def integrate(
    chain: Chain, angle, spin, times: np.ndarray, *, rtol: float = 1e-10
) -> tuple[np.ndarray, np.ndarray]:
    """Headings and spins at given times, `[time, link]` each."""
    num = chain.num_links

    def rate(_, y):
        return np.concatenate([y[num:], acceleration(chain, y[:num], y[num:])])

    solution = solve_ivp(
        rate,
        (0.0, float(times[-1])),
        np.concatenate([angle, spin]).astype(float),
        t_eval=times,
        method="DOP853",
        rtol=rtol,
        atol=1e-2 * rtol,
    )
    assert solution.success, solution.message
    return solution.y[:num].T, solution.y[num:].T


def states(chain: Chain, angle, spin) -> np.ndarray:
    """Poses and twists of the centres of mass, `[..., link, 6]`, pin at the origin."""
    angle, spin = np.asarray(angle, float), np.asarray(spin, float)
    lever = chain.lever
    cos, sin = np.cos(angle), np.sin(angle)
    columns = [
        cos @ lever.T,
        sin @ lever.T,
        angle,
        -(sin * spin) @ lever.T,
        (cos * spin) @ lever.T,
        spin,
    ]
    return np.stack(columns, axis=-1)


def energy(chain: Chain, state: np.ndarray) -> np.ndarray:
    """Kinetic plus potential energy of poses and twists, `[..., link, 6]` [J]."""
    speed_squared = state[..., 3] ** 2 + state[..., 4] ** 2
    kinetic = (
        0.5 * chain.mass * speed_squared + 0.5 * chain.inertia * state[..., 5] ** 2
    )
    return np.sum(kinetic + chain.mass * chain.gravity * state[..., 1], axis=-1)
