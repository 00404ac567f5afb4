"""What presses on the floor with all of its area has no wheel."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.inference import infer, infer_batch
from boomdp_jax.inference.stance_doubts import stance_reasons
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
    spec, history, _ = pushed_object([11, 1], "four legs")
    told, *_ = pushed_object([11, 1], "four legs, told")
    found = infer(jax.random.key(0), spec, history, method="laplace")

    def with_slots(wheel: bool, ground: bool):
        params = found.params
        return eqx.tree_at(
            lambda p: (p.params.wheel.active, p.params.ground.active),
            found,
            (
                jnp.full_like(params.wheel.active, wheel),
                jnp.full_like(params.ground.active, ground),
            ),
        )

    both = with_slots(True, True)
    (reason,) = stance_reasons(spec, both)
    assert reason.startswith("object: has a wheel beside friction with the floor")
    assert "probability 1.00" in reason
    assert "expected 'feet' in the scene, got none" in reason
    assert stance_reasons(told, both) == []
    assert stance_reasons(spec, with_slots(True, False)) == []
    assert stance_reasons(spec, with_slots(False, True)) == []
