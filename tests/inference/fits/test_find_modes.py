"""Noise and fits of every structure settle together, or structures are told apart."""

import jax
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference.blocks.block import make_block, stack_blocks
from boomdp_jax.inference.fits.find_modes import find_modes
from boomdp_jax.inference.fits.fit import FitSettings, best_of_each, make_fits
from boomdp_jax.inference.fits.fit_noise import NoiseDensity, fit_noise
from tests.inference.joint_recordings import DT, recorded, scene


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_noise_is_that_of_where_fits_have_come_to(seed):
    """Of poses alone, whose first fits are poor: no structure loses much by its noise.

    A door's drag may be its pin's or a wheel's: as likely, if the noise is the same.
    """
    rows = recorded("door", seed)
    state, after = (np.array(x) for x in (rows.state, rows.next_state))
    state[..., 3:] = after[..., 3:] = np.nan
    history = make_history(
        state, np.asarray(rows.action), after, DT, episode=np.asarray(rows.episode)
    )
    spec = scene(unknown={"revolute": 1, "wheel": 1})
    targets = stack_blocks([make_block(spec, (0,), history)])
    found = find_modes(jax.random.key(seed), targets, FitSettings())
    structures = np.asarray(targets.structures)[0]
    pinned = np.flatnonzero(structures[:, 0])
    assert len(pinned) == 2
    modes, (_, each) = found.modes, np.nonzero(np.asarray(found.modes.structure) >= 0)
    index, structure = 0 * each, np.asarray(modes.structure)[0, each]
    fits = make_fits(found.targets, index, structure, np.asarray(modes.z)[0, each])
    top = best_of_each(fits, len(structures), 1)
    top = top.take(np.isin(top.structure, pinned))
    noise = found.noise.take(top.structure)
    peaks = fit_noise(found.targets, top, noise)
    told = NoiseDensity(found.targets, top)(np.arange(2), noise.vector[:, None])[:, 0]
    lost = peaks.log_density - told
    # To take two impulses a sd above their peaks costs a nat; less than half of one
    # more is not worth another round.
    assert np.all(lost < 2.0)
    assert abs(lost[0] - lost[1]) < 1.0
