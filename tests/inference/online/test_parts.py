"""Parts of an online belief that need no physics: the table, resampling, the watch."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference import OnlineBelief
from boomdp_jax.inference.likelihoods.kalman import Estimate, NoiseLevel
from boomdp_jax.inference.online.likelihood import _chunks
from boomdp_jax.inference.online.moves import (
    distinct_sample_size,
    effective_sample_size,
    fit_mixture,
    resample,
)
from boomdp_jax.inference.online.rows import (
    append_row,
    append_track_row,
    new_row,
    shift_rows,
    step_length,
    track_row_of,
)
from boomdp_jax.inference.online.state import (
    BlockBelief,
    Champions,
    FitRecord,
    ParticleSet,
    Suspicion,
    Tally,
)
from boomdp_jax.inference.online.step import _watch, _Weights
from boomdp_jax.inference.posteriors.contact_numbers import untouched_notes
from boomdp_jax.inference.readings.track_data import track_data
from boomdp_jax.inference.samplers.mixture_building import add_spare_components
from boomdp_jax.physics import scene_spec_from_dict
from tests.inference.linear_gaussian import (
    closed_form,
    in_use,
    make_problem,
    sample_exactly,
    skewed_mixture,
)
from tests.inference.online_worlds import NOISE, box_world

CAPACITY = 12


def recorded(num_rows: int):
    """Two episodes of one body; some readings missing, some rows read twice."""
    rng = np.random.default_rng(4)
    state, next_state = rng.normal(size=(2, num_rows, 1, 6))
    action = rng.normal(size=(num_rows, 1, 3))
    episode = (np.arange(num_rows) >= 5).astype(int)
    for row in (1, 3, 6, 8):
        state[row] = next_state[row - 1]
    next_state[6, 0, 3:] = np.nan
    state[7, 0, :] = next_state[6, 0, :]
    state[5, 0, 1] = np.nan
    # What the two ends of an instant lack may differ.
    next_state[7, 0, 4] = state[8, 0, 2] = np.nan
    return state, action, next_state, episode


def appended(num_rows: int):
    """The same rows one by one, with the table of a block."""
    return appended_rows(*recorded(num_rows), 0.1)


def appended_rows(state, action, next_state, episode, dt: float):
    """Any rows."""
    empty = make_history(state[:0], action[:0], state[:0], dt, capacity=CAPACITY)
    history = eqx.tree_at(lambda h: h.dt, empty, jnp.full(CAPACITY, dt))
    data = track_data(history, (0,), True)

    @jax.jit
    def append(history, data, index, reading, starts):
        new = new_row(history, index, *reading, jnp.asarray(dt), starts)
        row = track_row_of(data, new, jnp.asarray([0]), new.starts_episode)
        data = append_track_row(data, index, row, 1.0)
        return append_row(history, index, new), data

    for row in range(len(state)):
        starts = row > 0 and episode[row] != episode[row - 1]
        reading = tuple(jnp.asarray(x[row]) for x in (state, action, next_state))
        history, data = append(
            history, data, jnp.asarray(row), reading, jnp.asarray(starts)
        )
    return history, data


def test_rows_appended_one_by_one_make_the_same_table():
    state, action, next_state, episode = recorded(10)
    whole = make_history(
        state, action, next_state, 0.1, episode=episode, capacity=CAPACITY
    )
    history, _ = appended(10)
    for name in ("state", "action", "next_state", "dt", "state_mask", "is_chained"):
        np.testing.assert_array_equal(
            np.asarray(getattr(history, name)), np.asarray(getattr(whole, name)), name
        )
    assert np.all(np.diff(np.asarray(history.episode)[:10]) == np.diff(episode))
    np.testing.assert_array_equal(np.asarray(history.mask), np.asarray(whole.mask))


def test_a_block_takes_rows_as_a_whole_history_gives_them():
    _, data = appended(10)
    state, action, next_state, episode = recorded(10)
    whole = track_data(
        make_history(
            state, action, next_state, 0.1, episode=episode, capacity=CAPACITY
        ),
        (0,),
        True,
    )
    for name in ("first_mask", "last_mask", "is_start", "is_second"):
        found, expected = np.asarray(getattr(data, name)), getattr(whole, name)
        np.testing.assert_array_equal(found[:10], np.asarray(expected)[:10], name)
    for name in ("state", "action", "next_state", "mask"):
        found, expected = getattr(data.steps, name), getattr(whole.steps, name)
        np.testing.assert_array_equal(np.asarray(found), np.asarray(expected), name)
    read = np.asarray(data.first_mask[:10]) > 0
    np.testing.assert_array_equal(
        np.asarray(data.start[:10])[read], np.asarray(whole.start[:10])[read]
    )


def test_a_wrench_that_is_not_finite_leaves_nothing_read():
    history, _ = appended(10)
    reading = jnp.ones((1, 6))
    new = new_row(
        history,
        jnp.asarray(10),
        reading,
        jnp.full((1, 3), jnp.nan),
        reading,
        jnp.asarray(0.1),
        jnp.asarray(False),
    )
    assert not np.any(new.state_mask)
    assert not np.any(new.next_state_mask)
    assert np.all(np.isfinite(new.action))


@pytest.mark.parametrize("length", [np.nan, np.inf, 0.0, -0.1])
def test_a_length_of_no_step_leaves_nothing_read(length):
    history, _ = appended(10)
    reading = jnp.ones((1, 6))
    push = jnp.ones((1, 3))
    new = new_row(
        history,
        jnp.asarray(10),
        reading,
        push,
        reading,
        jnp.asarray(length),
        jnp.asarray(False),
    )
    assert not np.any(new.state_mask)
    assert not np.any(new.next_state_mask)
    assert new.dt == history.dt[9] > 0
    with pytest.raises(ValueError, match="dt: expected positive seconds, got"):
        step_length(length, 0.1, is_uniform=False)


def test_what_could_collide_is_said_where_contact_is_left_out():
    def scene(*contacts):
        bodies = [
            {"name": name, "shape": {"type": "circle", "radius": 0.1}, **more}
            for name, more in zip("abc", contacts, strict=True)
        ]
        scene = {"schema": "planar-scene-1", "dt": 0.02, "bodies": bodies}
        return scene_spec_from_dict(scene)

    collides = {"contact": {"friction": 0.3, "restitution": 0.1}}
    notes = untouched_notes(scene(collides, {}, collides))
    assert notes == ["contact is left out, as if these never touched: a, c"]
    assert untouched_notes(scene(collides, {}, {})) == []


def test_the_oldest_rows_leave_off_the_front():
    table = {"a": jnp.arange(6.0), "b": jnp.arange(6) > 2}
    shifted = shift_rows(table, 2)
    np.testing.assert_array_equal(shifted["a"], [2, 3, 4, 5, 0, 0])
    np.testing.assert_array_equal(shifted["b"], [False, True, True, True, False, False])


def test_chunks_hold_every_point_once_beside_its_like():
    rng = np.random.default_rng(0)
    structure = rng.choice(5, size=300, p=[0.7, 0.0, 0.2, 0.06, 0.04])
    source, owner, num = _chunks(jnp.asarray(structure, jnp.int32), 5)
    used = np.asarray(source)[: int(num)]
    assert sorted(used[used < 300]) == list(range(300))
    for row, k in zip(used, np.asarray(owner), strict=False):
        assert np.all(structure[row[row < 300]] == k)
    assert np.all(np.asarray(source)[int(num) :] == 300)


def particle_set(structure, z, log_weight) -> ParticleSet:
    num = len(structure)
    return ParticleSet(
        jnp.asarray(structure, jnp.int32),
        jnp.asarray(z),
        jnp.asarray(log_weight),
        jnp.zeros((num, 1, 6)),
        jnp.zeros((num, 1, 4)),
    )


def test_resampling_is_systematic():
    rng = np.random.default_rng(1)
    weight = rng.gamma(0.3, size=400)
    weight /= weight.sum()
    before = particle_set(np.zeros(400), np.arange(400.0)[:, None], np.log(weight))
    after = resample(jax.random.key(0), before)
    count = np.bincount(np.asarray(after.z[:, 0]).astype(int), minlength=400)
    assert np.all(np.abs(count - 400 * weight) < 1.0)
    np.testing.assert_allclose(np.asarray(after.log_weight), -np.log(400))


def test_effective_sample_size_of_equal_and_of_single_weights():
    size = effective_sample_size(jnp.full(50, -jnp.log(50.0)))
    assert float(size) == pytest.approx(50.0)
    one = jnp.full(50, -jnp.inf).at[3].set(0.0)
    assert float(effective_sample_size(one)) == pytest.approx(1.0)


def test_copies_of_a_particle_count_as_one():
    """Three hypotheses, of which resampling made 6, 3 and 1; one in two structures."""
    z = np.repeat([[0.3, -1.2], [0.3, 0.7], [2.0, 0.7]], [6, 3, 1], axis=0)
    z = z[np.random.default_rng(0).permutation(10)]
    equal = particle_set(np.zeros(10), z, np.full(10, -np.log(10.0)))
    expected = 1.0 / (0.6**2 + 0.3**2 + 0.1**2)
    assert float(distinct_sample_size(equal)) == pytest.approx(expected)
    structure = np.where(z[:, 1] == 0.7, np.arange(10) % 2, 0)
    parts = np.unique(np.column_stack([structure, z]), axis=0, return_counts=True)[1]
    both = particle_set(structure, z, np.full(10, -np.log(10.0)))
    expected = 1.0 / np.sum((parts / 10.0) ** 2)
    assert float(distinct_sample_size(both)) == pytest.approx(expected)


def test_particles_that_are_all_different_count_by_their_weights():
    rng = np.random.default_rng(1)
    weight = rng.gamma(0.3, size=400)
    weight /= weight.sum()
    cloud = particle_set(np.zeros(400), rng.normal(size=(400, 9)), np.log(weight))
    found = float(distinct_sample_size(cloud))
    assert found == pytest.approx(float(effective_sample_size(cloud.log_weight)))


def test_particles_that_lie_close_are_not_copies():
    """In single precision, where a structure's number has no digits left for them."""
    rng = np.random.default_rng(2)
    z = (1e-4 * rng.normal(size=(400, 9))).astype(np.float32)
    with jax.enable_x64(False):
        equal = np.full(400, -np.log(400.0), np.float32)
        cloud = particle_set(np.full(400, 4000), z, equal)
        assert float(distinct_sample_size(cloud)) == pytest.approx(400.0, rel=0.01)


@pytest.mark.slow
def test_the_mixture_is_fitted_to_the_particles_of_each_structure():
    target, design, data = make_problem()
    _, probability, means, covariances = closed_form(design, data)
    num = 20000
    structure, z = sample_exactly(5, num, probability, means, covariances)
    mixture = add_spare_components(target, skewed_mixture(target, means, covariances))
    integer, zero = jnp.asarray(0), jnp.zeros(())
    noise = NoiseLevel(jnp.ones((1, 4)), jnp.ones((1, 2)))
    estimate = Estimate(jnp.zeros((6, 1, 6)), jnp.zeros((6, 6, 6)))
    block = BlockBelief(
        target=target,
        champions=Champions(jnp.zeros((6, 5)), estimate, noise),
        tally=Tally(jnp.zeros((6, 1, 4)), jnp.zeros(6)),
        particles=particle_set(structure, z, np.full(num, -np.log(num))),
        mixture=mixture,
        base_log_weight=mixture.log_weight,
        starts=jnp.zeros((4, 1, 6)),
        begin=integer,
        step_size=zero,
        num_moves=integer,
        suspicion=Suspicion(zero, integer, integer, jnp.asarray(False)),
        fit=FitRecord(integer, integer),
    )
    fitted = jax.jit(fit_mixture)(block)
    share = np.bincount(structure, minlength=6) / num
    base = np.exp(np.asarray(mixture.structure_log_weight(target)))
    whole = np.exp(np.asarray(fitted.structure_log_weight(target)))
    np.testing.assert_allclose(whole, 0.7 * share + 0.3 * base, rtol=1e-6)
    for k in range(6):
        used, count = np.flatnonzero(in_use(k)), num * share[k]
        spare = fitted.num_components - 6 + k
        sd = np.sqrt(np.diag(covariances[k]))
        # Five standard errors of a mean, and of a variance.
        error = np.abs(np.asarray(fitted.mean)[spare][used] - means[k]) / sd
        assert np.max(error) < 5.0 / np.sqrt(count)
        factor = np.asarray(fitted.scale_tril)[spare][np.ix_(used, used)]
        found = factor @ factor.T / np.outer(sd, sd)
        expected = covariances[k] / np.outer(sd, sd)
        assert np.max(np.abs(found - expected)) < 5.0 * np.sqrt(2.0 / count)


def watched(factors: list[float]) -> list[Suspicion]:
    """The watch after rows with these log Bayes factors."""
    zero, integer = jnp.zeros(()), jnp.asarray(-1)
    suspicion = Suspicion(zero, integer, jnp.asarray(4), jnp.asarray(False))
    out = []
    for index, factor in enumerate(factors):
        weights = _Weights(jnp.zeros(1), zero, jnp.asarray(float(factor)))
        suspicion = _watch(suspicion, weights, jnp.asarray(index))
        out.append(suspicion)
    return out


def test_the_watch_adds_up_from_where_readings_grew_odd():
    # The highest sum of factors up to each row over all starts, none above eight.
    factors = [-3.0, 2.0, -4.0, 1.5, 20.0, -1.0, 3.0]
    found = watched(factors)
    capped = np.minimum(factors, 8.0)
    for index, suspicion in enumerate(found):
        sums = [capped[k : index + 1].sum() for k in range(index + 1)]
        best = max(0.0, *sums)
        assert float(suspicion.log_factor) == pytest.approx(best)
        expected = int(np.argmax(sums)) if best > 0 else -1
        assert int(suspicion.since) == expected


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"capacity": 4}, "capacity: expected at least 8, got 4"),
        ({"num_particles": 100}, "num_particles: expected a multiple of 16, got 100"),
        ({"num_noise_levels": 0}, "num_noise_levels: expected at least 1, got 0"),
        ({"forgetting": 0.0}, "forgetting: expected in"),
        ({"change_rate": 1.0}, "change_rate: expected in"),
        ({"dt": -1.0}, "dt: expected positive seconds, got -1.0"),
    ],
)
def test_settings_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        OnlineBelief(box_world([], is_hidden=True), **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"capacity": "64"}, "capacity: expected a whole number, at least 8, got '64'"),
        ({"num_particles": 64.0}, "num_particles: expected a whole number, .* 64.0"),
        (
            {"num_noise_levels": 2.7},
            "num_noise_levels: expected a whole number, .* 2.7",
        ),
        ({"forgetting": "a"}, "forgetting: expected real numbers, got"),
        ({"forgetting": [0.5, 1.0]}, "forgetting: expected one number, got shape"),
        ({"change_rate": None}, "change_rate: expected real numbers, got"),
        ({"dt": "a"}, "dt: expected real numbers, got"),
        ({"screen": "x"}, "screen: expected a History, .*; got str"),
        ({"spec": {}}, "spec: expected a SceneSpec, .*; got dict"),
        ({"spec": None}, "spec: expected a SceneSpec, .*; got None"),
    ],
)
def test_settings_of_another_type_are_refused(no_type_checks, options, message):
    with pytest.raises((TypeError, ValueError), match=f"^{message}"):
        OnlineBelief(**({"spec": box_world([], is_hidden=True)} | options))


def test_a_number_of_hypotheses_is_whole(no_type_checks):
    online = OnlineBelief(box_world([], is_hidden=True), capacity=8, num_particles=16)
    for wrong in (2.5, 0, True):
        with pytest.raises(ValueError, match="num_samples: expected"):
            online.sample_params(jax.random.key(0), None, wrong)


def test_histories_that_do_not_fit_are_refused():
    belief = OnlineBelief(box_world([], is_hidden=True), capacity=8)
    assert belief.blocks == [("box",)]
    state = NOISE * np.ones((9, 1, 6))
    long = make_history(state, state[..., :3], state, 0.02)
    with pytest.raises(ValueError, match="expected at most 8 transitions"):
        belief.init(jax.random.key(0), long)
    slow = make_history(state[:2], state[:2, :, :3], state[:2], 0.05)
    with pytest.raises(ValueError, match=r"expected steps of 0\.02 s"):
        belief.init(jax.random.key(0), slow)
