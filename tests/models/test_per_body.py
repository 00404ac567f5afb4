"""Models body by body: each learns from its own pushes and from nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import (
    BodyRegression,
    LinearRegression,
    PerBody,
    ScenePhysics,
    TrueModel,
)
from boomdp_jax.models.model import AbstractModel
from boomdp_jax.models.per_body import stacked
from boomdp_jax.physics import State, step
from boomdp_jax.planning import Belief

from .worlds import cart, part, ride

KEY = jax.random.key(0)


def regressions(**options):
    models = tuple(BodyRegression(cart().scene, LinearRegression()) for _ in range(2))
    return PerBody(models, stacked(list(models)), num_hypotheses=1, **options)


def known(params):
    """A model of one body that is never asked to move it."""
    return TrueModel(params, lambda *row: row[1])


def side_by_side(rows):
    """Two bodies on the same ride, and a third that never moves."""

    def widen(leaf):
        still = jnp.zeros_like(leaf[:, :1])
        return jnp.concatenate([leaf, leaf + 0.0, still], axis=1)

    return jax.tree.map(widen, rows)


def learnt_from(model, rows, pushed):
    """All rows, in which only one body is pushed."""
    learnt = model.init(KEY)
    before, wrench, after = rows
    wrench = wrench * (jnp.arange(3) == pushed)[None, :, None]
    for index in range(len(wrench)):
        row = jax.tree.map(lambda leaf, i=index: leaf[i], (before, wrench, after))
        learnt = model.update(learnt, *row)
    return learnt


@pytest.mark.slow
def test_only_the_pushed_body_learns():
    rows = side_by_side(part(ride(40), 0, 12))
    model = regressions()
    begun, learnt = model.init(KEY), learnt_from(model, rows, 1)
    for old, new in zip(
        jax.tree.leaves(begun.parts[0]), jax.tree.leaves(learnt.parts[0]), strict=True
    ):
        np.testing.assert_array_equal(old, new)
    assert learnt.is_broken == (True, False)
    # What the pushed one foretells is what a model of it alone does.
    alone = model.models[1]
    taught = alone.init(KEY)
    lone = part(ride(40), 0, 12)
    for index in range(12):
        row = jax.tree.map(lambda leaf, i=index: leaf[i], lone)
        taught = alone.update(taught, *row)
    hypothesis = alone.sample(KEY, taught, 1)[0]
    state, wrench, _ = jax.tree.map(lambda leaf: leaf[5], part(ride(40), 12, 24))
    expected = alone.transition(KEY, hypothesis, state, wrench)
    draws = model.sample(KEY, learnt, 1)[0]
    both = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * 2 + [0 * leaf]), state)
    found = model.transition(KEY, draws, both, jnp.concatenate([wrench] * 3))
    np.testing.assert_allclose(found.pose[1], expected.pose[0], atol=1e-9)
    assert np.max(np.abs(found.pose[0] - expected.pose[0])) > 1e-4
    np.testing.assert_array_equal(found.pose[2], both.pose[2])


def test_bodies_that_touched_something_learn_nothing():
    rows = side_by_side(part(ride(40), 0, 4))
    model = regressions(moved_freely=lambda state, after: jnp.zeros(3, bool))
    learnt = learnt_from(model, rows, 1)
    assert learnt.is_broken == (True, True)
    for old, new in zip(
        jax.tree.leaves(model.init(KEY).parts),
        jax.tree.leaves(learnt.parts),
        strict=True,
    ):
        np.testing.assert_array_equal(old, new)


@pytest.mark.slow
def test_known_bodies_move_as_each_does_alone():
    specs = [cart(), cart()]
    numbers = [specs[0].params(), specs[1].params()]
    heavier = jax.tree.map(lambda leaf: leaf, numbers[1])
    heavier = type(heavier)(**{**vars(heavier), "density": 2 * heavier.density})
    models = tuple(known(each) for each in (numbers[0], heavier))
    laws = ScenePhysics(stacked([spec.scene for spec in specs]))
    model = PerBody(models, laws, num_hypotheses=3)
    belief = model.sample(KEY, model.init(KEY), 3)
    assert belief.num_hypotheses == 3
    before, wrench, _ = jax.tree.map(lambda leaf: leaf[9], side_by_side(ride(40)))
    found = model.transition(KEY, belief[2], before, wrench)
    for body, each in enumerate((numbers[0], heavier)):
        lone = State(before.pose[body][None], before.twist[body][None])
        expected, _ = step(specs[body].scene, each, lone, wrench[body][None])
        np.testing.assert_allclose(found.array[body], expected.array[0], atol=1e-12)


class Anything(AbstractModel):
    """A model of a number that nothing is known of."""

    is_compiled = False

    def init(self, key):
        return jnp.zeros(())

    def update(self, learnt, state, wrench, next_state, *, starts_episode=False):
        return learnt

    def sample(self, key, learnt, num_hypotheses):
        draws = jax.random.normal(key, (num_hypotheses,))
        return Belief(draws, jnp.zeros(num_hypotheses))

    def transition(self, key, hypothesis, state, wrench):
        return state


def test_no_body_is_taken_for_ever_for_what_it_was_at_first():
    model = PerBody((Anything(),) * 4, None, num_hypotheses=3)
    learnt = model.init(KEY)
    keys = jax.random.split(jax.random.key(1), 60)
    draws = np.array([model.sample(key, learnt, 3).hypotheses for key in keys])
    is_new = np.any(draws != learnt.draws, axis=1)
    assert np.all(is_new.sum(axis=1) == 1)
    assert np.all(is_new.sum(axis=0) > 5)
    # Others each time.
    new = draws[is_new[:, 0], :, 0]
    assert len(np.unique(new)) == new.size


def test_bad_settings_are_refused():
    with pytest.raises(ValueError, match="models: expected at least one, got none"):
        PerBody((), None, num_hypotheses=1)
    with pytest.raises(ValueError, match="num_hypotheses: expected at least 1, got 0"):
        PerBody((known(cart().params()),), None, num_hypotheses=0)
