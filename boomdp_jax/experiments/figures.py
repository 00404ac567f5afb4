"""The papers' figures as runs: which agents on which task, for how long, how noisily.

Figures of Scholz, Levihn and Isbell (2013), What Does Physics Bias, are `1b`, `2a` and
`2b` (`1a` is of learners alone, see `sample_curves`); the others are of Scholz et al.
(2014), A Physics-Based Model Prior for Object-Oriented MDPs. Figures share runs: a
folder holds each agent's episodes of one setting once.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from boomdp_jax.experiments.run import Run, begin_run

_PIXEL = 0.25 * 3.53 / 353.0
"""The successor's σ = 0.25 is of pixels, of which the cart's goal is 353 away [m]."""
NOISE_LEVELS = (1, 4, 16, 64)
"""Times `_PIXEL`, of positions [m] and, alike, of angles [rad] and rates."""


class Figure(NamedTuple):
    """One setting, and the agents that are shown in it."""

    task: str
    agents: tuple[str, ...]
    num_steps: int
    noise: tuple[float, float, float, float] | None = None
    """Standard deviation of readings that are learnt from [m, rad, m/s, rad/s]."""

    def runs(
        self,
        folder: Path,
        *,
        num_seeds: int,
        num_steps: int | None = None,
        agents: tuple[str, ...] | None = None,
    ) -> list[Run]:
        """Begin or take up the runs of all agents.

        Args:
            folder: of all figures; each run is in a folder of its own there.
            num_seeds: episodes of each agent.
            num_steps: of each episode; default: the figure's.
            agents: others than the figure's own.

        Returns:
            The runs, in order of agents.

        Raises:
            ValueError: as `begin_run`.
        """
        steps = num_steps or self.num_steps
        noise = "" if self.noise is None else f"-noise-{self.noise[0]:g}"
        return [
            begin_run(
                self.task,
                agent,
                folder / "runs" / f"{self.task}{noise}-{steps}-{agent}",
                num_seeds=num_seeds,
                num_steps=steps,
                noise=self.noise,
            )
            for agent in agents or self.agents
        ]


def _noisy(level: int) -> tuple[float, float, float, float]:
    scale = level * _PIXEL
    return (scale, scale, scale, scale)


_CART = ("true", "physics", "oo-lwr", "lwr")

FIGURES: Mapping[str, Figure] = MappingProxyType(
    {
        "1b": Figure(
            "pendulum",
            ("true", "physics", "physics-pretrained", "lwr-pretrained", "lwr"),
            2000,
        ),
        "2a": Figure("cart", ("true", "physics", "lwr-world", "lr"), 500),
        "2b": Figure("living-room", ("true", "physics", "lwr-world", "lr"), 500),
        "cart": Figure("cart", _CART, 500),
        **{
            f"cart-noisy-{level}": Figure("cart", _CART, 1000, _noisy(level))
            for level in NOISE_LEVELS
        },
        "apartment": Figure(
            "living-room", ("true", "physics", "physics-kinds", "oo-lwr"), 1000
        ),
        "acrobot": Figure("acrobot", ("true", "physics", "lwr"), 300),
    }
)
"""By name."""
