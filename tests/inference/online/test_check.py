"""What an online belief says of itself."""

import jax
import numpy as np
import pytest

from boomdp_jax.inference import OnlineBelief
from tests.inference.online_worlds import box_world, simulate


def followed(online, rows):
    belief = online.init(jax.random.key(0))
    for index in range(len(rows.action)):
        belief, _ = online.observe(belief, *rows.transition(index))
    return belief


@pytest.fixture(scope="module")
def online():
    spec = box_world([], is_hidden=True)
    return OnlineBelief(spec, capacity=64, num_particles=256)


@pytest.mark.slow
def test_before_anything_was_fitted_a_belief_is_not_ok(online):
    assert online.posterior(online.init(jax.random.key(0))).diagnostics["ok"]
    belief = followed(online, simulate(1, ["free"] * 3))
    verdict = online.posterior(belief).diagnostics
    assert not verdict["ok"]
    assert any("nothing has been fitted yet" in reason for reason in verdict["reasons"])


@pytest.mark.slow
def test_forces_that_act_elsewhere_than_told_are_found_out(online):
    rows = simulate(2, ["free"] * 60)
    honest = online.posterior(followed(online, rows)).diagnostics
    assert not any("law" in reason for reason in honest["reasons"])
    action = rows.action.copy()
    action[:, 2] -= 0.06 * action[:, 1]
    belief = followed(online, rows._replace(action=np.asarray(action)))
    verdict = online.posterior(belief).diagnostics
    assert not verdict["ok"]
    assert any("box" in reason for reason in verdict["reasons"])
    unchecked = online.posterior(belief, check=False).diagnostics
    assert not any("law" in reason for reason in unchecked["reasons"])
