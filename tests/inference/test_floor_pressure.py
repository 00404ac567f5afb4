"""What presses on the floor with all of its area has no wheel."""

import jax
import numpy as np
import pytest

from boomdp_jax.inference import infer_batch
from boomdp_jax.inference.doubts.stance_doubts import stance_reasons
from boomdp_jax.physics import empty_params
from tests.inference.made_posteriors import draws_like, make_posterior, table_spec
from tests.inference.standing_objects import pushed_object

NUM_OBJECTS = 6


@pytest.mark.slow
@pytest.mark.parametrize(
    "stance", ["all of it", "four legs", "legs that rock", "four legs, told"]
)
def test_discs_and_boxes_that_slip_every_way_have_friction_and_no_wheel(stance):
    objects = [pushed_object([11, i], stance) for i in range(NUM_OBJECTS)]
    specs, histories, truths = zip(*objects, strict=True)
    found = infer_batch(jax.random.key(0), list(specs), list(histories))
    right = [p.structure_probabilities().get("friction", 0.0) for p in found]
    assert np.median(right) > 0.95
    # Nine feet are 1 to 2 % off an even pressure, which shows where a small disc turns
    # fast in every row: of 22 such one had a wheel, for certain.
    assert sorted(right)[1 if stance == "all of it" else 0] > 0.5
    for posterior, probability in zip(found, right, strict=True):
        # A wheel beside friction is never believed of what may stand in any way.
        assert probability > 0.5 or not posterior.diagnostics["ok"]
    for posterior, spec, truth in zip(found, specs, truths, strict=True):
        density = np.asarray(posterior.params.density)[:, 0]
        mean = posterior.weights @ density * float(spec.scene.area[0])
        assert mean == pytest.approx(truth["mass"], rel=0.06)


def test_a_wheel_beside_friction_is_doubted_where_nobody_gave_the_feet():
    spec, told = table_spec(), table_spec(feet=[[0.1, 0.1], [-0.1, 0.1], [0.0, -0.1]])
    empty = empty_params(1, num_revolute=1, num_wheel=1, num_ground=1)

    def reasons(spec, wheel, ground):
        params = draws_like(empty, 10, wheel_active=wheel, ground_active=ground)
        return stance_reasons(spec, make_posterior(spec, params, params))

    (reason,) = reasons(spec, True, True)
    assert reason.startswith("table: has a wheel beside friction with the floor")
    assert "probability 1.00" in reason
    assert "expected 'feet' in the scene, got none" in reason
    assert reasons(told, True, True) == []
    assert reasons(spec, True, False) == []
    assert reasons(spec, False, True) == []
