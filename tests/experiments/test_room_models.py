"""Models of furniture: kinds made to fit other outlines, regressions among others."""

import equinox as eqx
import jax
import numpy as np
import pytest

from boomdp_jax.envs.furniture import PIECES, WHEEL_VISCOUS
from boomdp_jax.experiments import agent_of, make_task
from boomdp_jax.experiments.known_furniture import fitted_to


@pytest.fixture(scope="module")
def room():
    task = make_task("living-room", 4)
    return task, task.default_params()


def of_kind(room, name):
    """A kind's true numbers as the only draw, and its piece."""
    task, params = room
    body = [piece.name for piece in PIECES].index(name)
    numbers = task.lone_params(params.physics)
    return jax.tree.map(lambda leaf: leaf[body][None], numbers), PIECES[body]


def test_a_kind_keeps_what_is_its_own_on_another_outline(room):
    draws, desk = of_kind(room, "desk")
    _, table = of_kind(room, "dining table")
    fitted = fitted_to(draws, desk, table)
    np.testing.assert_array_equal(fitted.density, draws.density)
    # As far along the longer body, and as much friction for each kilogram.
    share = table.half_extents[0] / desk.half_extents[0]
    np.testing.assert_allclose(fitted.wheel.position[0, 0, 0, 0], desk.wheels * share)
    mass = np.prod(table.half_extents) / np.prod(desk.half_extents)
    np.testing.assert_allclose(
        fitted.wheel.viscous[0, 0, 0], mass * np.array(WHEEL_VISCOUS), rtol=1e-6
    )
    same = fitted_to(draws, desk, desk)
    np.testing.assert_allclose(same.ground.viscous, draws.ground.viscous, rtol=1e-6)


def test_a_pinned_kind_is_pinned_where_the_piece_stands(room):
    draws, table = of_kind(room, "kitchen table")
    _, desk = of_kind(room, "desk")
    slot = int(np.argmax(np.asarray(draws.revolute.active[0])))
    same = fitted_to(draws, table, table)
    np.testing.assert_allclose(
        same.revolute.anchor_b[0, slot], draws.revolute.anchor_b[0, slot], rtol=1e-6
    )
    fitted = fitted_to(draws, table, desk)
    lever = np.array(table.pin) * np.divide(desk.half_extents, table.half_extents)
    np.testing.assert_allclose(
        fitted.revolute.anchor_b[0, slot], np.add(desk.start, lever), rtol=1e-6
    )


@pytest.mark.slow
def test_what_knows_nothing_expects_pieces_to_stay(room):
    task, params = room
    model = agent_of("oo-lwr", task, params).model
    learnt = model.init(jax.random.key(0))
    state = task.start(jax.random.key(1), params)
    belief = model.sample(jax.random.key(2), learnt, 1)
    told = eqx.filter_jit(type(model).transition)(
        model, jax.random.key(3), belief[0], state, task.actions[3]
    )
    np.testing.assert_allclose(told.array, state.array, atol=1e-6)
    # Only the piece that was pushed learns.
    moved = task.start(jax.random.key(4), params)
    learnt = model.update(learnt, state, task.actions[13], moved)
    counts = [int(part.table.num_seen[0]) for part in learnt.parts]
    np.testing.assert_array_equal(counts, np.arange(len(PIECES)) == 1)
