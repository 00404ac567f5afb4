r"""What a history can tell of every number of a structure, before anything is sampled.

At the best fit the readings are linear in the coordinates z, which are standard normal
a priori. With J the derivative of the whitened innovations of the filter,

$$I = J^T W J, \qquad \mathrm{cov}(z \mid h) \approx (1 + I)^{-1},$$

where W weighs channel groups by what their noise turned out to be. I is the Fisher
information of the filter's likelihood in units of the prior; a number of which it is
nought is not seen, whatever is sampled. (Directions such as a wheel's heading, uniform
over half a turn, have no prior precision: a coordinate is an angle in radians.)

Noise is that of a point fit, in which the motion's is taken one sd of its logarithm
above its peak. Where motion is nearly exact that is often 3 to 10 times what `infer`
finds, and sds that follow from I are 1.1 to 1.7 times those of the posterior.
"""

from typing import NamedTuple

import jax
import numpy as np

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.history import History
from boomdp_jax.inference.arguments import check_history
from boomdp_jax.inference.blocks.block import Block, stack_blocks
from boomdp_jax.inference.blocks.fixed_structure import Structure, structure_blocks
from boomdp_jax.inference.blocks.model_sites import Site, block_sites
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import Fits, FitSettings, Host, normal_equations
from boomdp_jax.physics.scene_spec import SceneSpec

# Information in units of the prior's precision below which a direction is not seen.
_UNSEEN = 0.05
# An entry of a direction that is large enough to be named.
_NAMED = 0.3


class Identifiability(NamedTuple):
    """What is told of the numbers of bodies that do not interact with others."""

    bodies: tuple[str, ...]
    names: tuple[str, ...]
    """Of every number, as the sites of `make_model` are called."""
    information: np.ndarray
    """Fisher information in prior standard deviations, `[number, number]`."""
    contraction: np.ndarray
    """One minus posterior over prior variance, about, `[number]`."""
    unseen: list[dict[str, float]]
    """Directions of which nothing is told: combinations of numbers, by name."""
    reading_noise: np.ndarray
    """Sd of readings at the fit, `[body, 4]` [m, rad, m/s, rad/s]."""
    impulse_noise: np.ndarray
    """Sd of the motion's impulses that is reckoned with, `[body, 2]` [m/s, rad/s]:
    above the most probable one, often far above the posterior's."""

    @property
    def insensitive(self) -> tuple[str, ...]:
        """Numbers on which the readings do not depend."""
        each = np.diagonal(self.information)
        return tuple(
            name for name, i in zip(self.names, each, strict=True) if i < _UNSEEN
        )


def identifiability(
    key: Key,
    spec: SceneSpec,
    history: History,
    structure: Structure | None = None,
    *,
    settings: FitSettings | None = None,
) -> list[Identifiability]:
    """Fisher information of a history about the numbers of one structure.

    Noise is fitted and not averaged over, that of the motion on the high side: the
    information is rather too low than too high.

    Args:
        key: random key, for the starts of the fit.
        spec: the scene: outlines, what is known, what may exist.
        history: recorded transitions.
        structure: constraints that exist besides the known ones, such as `{"table":
            ["revolute"]}`; default: none.
        settings: how hard to look for the best fit.

    Returns:
        One entry for each block of bodies that may interact.

    Raises:
        ValueError: a structure that the scene does not allow, a history of another
            number of bodies, or one without transitions.
    """
    check_history(spec, history)
    if not int(history.num_transitions):
        raise ValueError(
            f"{spec.source}: history: expected at least one transition, got none"
        )
    settings = FitSettings() if settings is None else settings
    return [
        _of_block(jax.random.fold_in(key, number), spec, block, settings)
        for number, block in enumerate(structure_blocks(spec, history, structure))
    ]


def _of_block(
    key: Key, spec: SceneSpec, block: Block, settings: FitSettings
) -> Identifiability:
    names = tuple(spec.names[body] for body in block.bodies)
    sites = block_sites(block, names)
    found = find_modes(key, stack_blocks([block]), settings)
    value = np.asarray(found.modes.log_density, float)[0]
    best = int(np.argmax(np.where(np.isfinite(value), value, -np.inf)))
    fits = Fits(
        np.zeros(1, int),
        np.zeros(1, int),
        np.asarray(found.modes.z, float)[:, best],
        value[[best]],
        np.asarray(found.modes.precision, float)[:, best],
    )
    host = Host.of(found.targets)
    _, matrix = normal_equations(found.targets, host, fits)
    places, labels = _numbers(sites)
    # Of a direction that is uniform over half a turn, by its variance.
    least = 12.0 / np.where(host.period > 0, host.period, np.inf)[places] ** 2
    least = np.where(host.is_normal[places], 1.0, least)
    information = matrix[0][np.ix_(places, places)] - np.diag(least)
    information = 0.5 * (information + information.T)
    covariance = np.linalg.inv(information + np.diag(least))
    length, way = np.linalg.eigh(information)
    unseen = [
        {labels[i]: float(way[i, d]) for i in np.flatnonzero(abs(way[:, d]) > _NAMED)}
        for d in np.flatnonzero(length < _UNSEEN)
    ]
    return Identifiability(
        bodies=names,
        names=labels,
        information=information,
        contraction=1.0 - np.diagonal(covariance) * least,
        unseen=unseen,
        reading_noise=found.noise.reading[0],
        impulse_noise=found.noise.impulse[0],
    )


def _numbers(sites: tuple[Site, ...]) -> tuple[np.ndarray, tuple[str, ...]]:
    """Place of every free coordinate, and its name."""
    places, labels = [], []
    for site in sites:
        for part, place in enumerate(site.coordinates):
            places.append(place)
            one = len(site.coordinates) == 1
            labels.append(site.name if one else f"{site.name}[{part}]")
    return np.array(places, int), tuple(labels)
