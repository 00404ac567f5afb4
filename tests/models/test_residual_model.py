"""Physics and its rest: no harm where the law is right, much good where it is not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.models import LocallyWeighted, ResidualPhysics, TrueModel
from boomdp_jax.models.residual_model import FEWEST_ROWS
from boomdp_jax.physics import State, step

from .worlds import cart, part, ride

KEY = jax.random.key(0)
NUM_LEARNT, NUM_ROWS = 80, 160
DRAG = 12.0
"""Of the dry friction that physics does not know, against 20 N or so of force [N]."""


def physics():
    """One who believes in the viscous wheel of the scene and nothing else."""
    spec = cart()
    return TrueModel(spec.params(), lambda p, s, w: step(spec.scene, p, s, w)[0])


@pytest.fixture(scope="module")
def model():
    return ResidualPhysics(physics(), cart().scene, capacity=NUM_LEARNT)


def rides_with(force):
    """A ride in which a further force acts that the rows do not tell of.

    Args:
        force: from a state to the force along its own x and y [N].
    """
    spec, (_, wrench, _) = cart(), ride(NUM_ROWS)

    def one(state, told):
        own = force(state)
        c, s = jnp.cos(state.pose[0, 2]), jnp.sin(state.pose[0, 2])
        more = jnp.stack([c * own[0] - s * own[1], s * own[0] + c * own[1], 0.0 * c])
        after = step(spec.scene, spec.params(), state, told + more[None])[0]
        return after, (state, after)

    start = spec.initial_state()
    before, after = jax.jit(lambda: jax.lax.scan(one, start, wrench)[1])()
    return before, wrench, after


def drag(state):
    """Dry friction along the body, smooth about rest."""
    c, s = jnp.cos(state.pose[0, 2]), jnp.sin(state.pose[0, 2])
    along = c * state.twist[0, 0] + s * state.twist[0, 1]
    return jnp.stack([-DRAG * jnp.tanh(along / 0.05), 0.0 * along])


def drift(state):
    """A push from behind that never ends."""
    return jnp.stack([8.0, 0.0]) + 0.0 * state.pose[0, 0]


def learnt_from(model, rows, num=NUM_LEARNT):
    learnt = model.init(KEY)
    for index in range(num):
        learnt = model.update(learnt, *part_at(rows, index))
    return learnt


def part_at(rows, index):
    return jax.tree.map(lambda leaf: leaf[index], rows)


def errors(model, hypothesis, rows):
    """Root mean square error of six numbers, one step ahead."""
    before, wrench, after = rows
    told = jax.jit(jax.vmap(lambda s, w: model.transition(KEY, hypothesis, s, w)))(
        before, wrench
    )
    missed = np.asarray(told.array) - np.asarray(after.array)
    return np.sqrt(np.mean(missed**2, axis=(0, 1)))


def both_errors(model, rows):
    """On rows that were not learnt from: of the model, and of its physics alone."""
    learnt = learnt_from(model, rows)
    hypothesis = model.sample(KEY, learnt, 3)[0]
    rest = part(rows, NUM_LEARNT, NUM_ROWS)
    return (
        errors(model, hypothesis, rest),
        errors(model.physics, hypothesis.physics, rest),
        np.asarray(hypothesis.residual.share[0]),
    )


def noisy(rows, scale):
    """Rows as read with noise; the wrench is known."""
    before, wrench, after = rows
    keys = jax.random.split(jax.random.key(5), 4)

    def read(state, pose_key, twist_key):
        return State(
            state.pose + scale * jax.random.normal(pose_key, state.pose.shape),
            state.twist + scale * jax.random.normal(twist_key, state.twist.shape),
        )

    return read(before, *keys[:2]), wrench, read(after, *keys[2:])


def test_before_enough_rows_physics_is_left_alone(model):
    rows = rides_with(drag)
    learnt = learnt_from(model, rows, FEWEST_ROWS - 1)
    hypothesis = model.sample(KEY, learnt, 1)[0]
    np.testing.assert_array_equal(hypothesis.residual.share, 0.0)
    before, wrench, _ = part_at(rows, 50)
    told = model.transition(KEY, hypothesis, before, wrench)
    alone = model.physics.transition(KEY, hypothesis.physics, before, wrench)
    np.testing.assert_allclose(told.array, alone.array, atol=1e-12)


def test_right_physics_is_not_spoilt_by_noise(model):
    """What is left of a right law is noise: errors grow by a twentieth at most."""
    rows = rides_with(lambda state: jnp.zeros(2) + 0.0 * state.pose[0, 0])
    for scale in (0.01, 0.1):
        ours, alone, share = both_errors(model, noisy(rows, scale))
        assert np.all(ours <= 1.05 * alone), (scale, ours / alone, share)


@pytest.mark.parametrize(("force", "most"), [(drag, 0.75), (drift, 0.3)])
def test_what_a_wrong_law_misses_is_learnt(model, force, most):
    """A constant drift almost wholly; a step at rest as far as 80 rows show it."""
    ours, alone, share = both_errors(model, rides_with(force))
    assert alone[3] > 0.02
    # Of x and y, and their rates: that is where a force along the body tells.
    wrong = [0, 1, 3, 4]
    assert np.all(ours[wrong] < most * alone[wrong]), ours / alone
    assert np.all((share >= 0) & (share <= 1))


def test_far_from_rows_physics_is_left_alone(model):
    rows = rides_with(drag)
    hypothesis = model.sample(KEY, learnt_from(model, rows), 1)[0]
    assert np.any(np.asarray(hypothesis.residual.share) > 0.5)
    before, wrench, _ = part_at(rows, 50)
    fast = State(before.pose, before.twist + 100.0)
    told = model.transition(KEY, hypothesis, fast, wrench)
    alone = model.physics.transition(KEY, hypothesis.physics, fast, wrench)
    np.testing.assert_allclose(told.array, alone.array, rtol=1e-9)


def test_the_rest_is_the_same_wherever_and_whichever_way(model):
    """A motion turned and moved is foretold turned and moved."""
    rows = rides_with(drag)
    hypothesis = model.sample(KEY, learnt_from(model, rows), 1)[0]
    before, wrench, _ = part_at(rows, 100)
    told = model.transition(KEY, hypothesis, before, wrench)
    angle, away = 2.1, jnp.array([3.0, -1.0, 0.0])

    def turned(vector):
        c, s = jnp.cos(angle), jnp.sin(angle)
        matrix = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return vector @ matrix.T

    def moved(pose):
        return turned(pose) + (away + jnp.array([0.0, 0.0, angle]))[None]

    there = State(moved(before.pose), turned(before.twist))
    again = model.transition(KEY, hypothesis, there, turned(wrench))
    np.testing.assert_allclose(again.pose, moved(told.pose), atol=1e-9)
    np.testing.assert_allclose(again.twist, turned(told.twist), atol=1e-9)


def test_what_touched_something_is_not_learnt_from_and_not_corrected():
    rows = rides_with(drag)
    spec = cart()
    model = ResidualPhysics(
        physics(),
        spec.scene,
        capacity=NUM_LEARNT,
        moved_freely=lambda before, after: after.pose[:, 0] < 1e3,
        halted=lambda before, after: State(after.pose, jnp.minimum(after.twist, 0.1)),
    )
    learnt = learnt_from(model, rows, 20)
    before, wrench, after = part_at(rows, 20)
    away = State(after.pose + 2e3, after.twist)
    assert int(model.update(learnt, before, wrench, away).rows.num_seen) == 20
    unread = State(after.pose.at[0, 1].set(jnp.nan), after.twist)
    assert int(model.update(learnt, before, wrench, unread).rows.num_seen) == 20
    assert int(model.update(learnt, before, wrench, after).rows.num_seen) == 21
    hypothesis = model.sample(KEY, learnt, 1)[0]
    at_wall = State(before.pose + 2e3, before.twist)
    told = model.transition(KEY, hypothesis, at_wall, wrench)
    alone = model.physics.transition(KEY, hypothesis.physics, at_wall, wrench)
    np.testing.assert_allclose(told.pose, alone.pose, atol=1e-9)
    assert float(jnp.max(told.twist)) <= 0.1


def test_too_few_rows_are_refused():
    with pytest.raises(ValueError, match="capacity: expected at least 10, got 9"):
        ResidualPhysics(physics(), cart().scene, LocallyWeighted(), capacity=9)
