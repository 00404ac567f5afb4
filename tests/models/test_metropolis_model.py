"""When the papers' learner fits anew, and what it refuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.envs import Acrobot, Cart
from boomdp_jax.models import MetropolisModel
from boomdp_jax.physics import State

SHORT = {"num_chains": 2, "num_iterations": 30, "num_burn_in": 10, "thin": 5}


@pytest.mark.slow
def test_it_fits_anew_when_steps_have_doubled():
    task = Cart()
    params = task.default_params()
    model = MetropolisModel(task.spec, task.advance, task.moved_freely, **SHORT)
    learnt = model.init(jax.random.key(0))
    state = State(jnp.array([[1.6, 1.2, 0.4]]), jnp.zeros((1, 3)))
    num_rows, changes = 0, []
    # Forth and back, so that no wall is near; one step more than the last refit.
    for number in range(1, 6):
        wrench = task.actions[4 * (number % 2)]
        after = task.advance(params.physics, state, wrench)
        num_rows += bool(task.moved_freely(state, after)[0])
        before, learnt = learnt, model.update(learnt, state, wrench, after)
        assert len(learnt.rows) == num_rows
        if learnt.params is not before.params:
            changes.append(number)
        state = after
    assert num_rows >= 4
    assert changes == [1, 2, 4]
    belief = model.sample(jax.random.key(1), learnt, 9)
    assert belief.num_hypotheses == 1
    assert np.all(np.isfinite(np.asarray(belief.hypotheses.density)))


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        (Acrobot, {}, "acrobot: expected a scene of one body, got 2"),
        (Cart, {"num_chains": 0}, "num_chains: expected at least 1, got 0"),
        (Cart, {"thin": 0}, "thin: expected at least 1, got 0"),
        (Cart, {"num_iterations": 99}, "num_iterations: expected at least 1010, got"),
    ],
)
def test_what_cannot_be_is_refused(task, options, message):
    made = task()
    with pytest.raises(ValueError, match=message):
        MetropolisModel(made.spec, made.advance, made.moved_freely, **options)
