"""An online belief from its first row on; long, since it compiles everything."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import boomdp_jax
from boomdp_jax.inference import OnlineBelief
from boomdp_jax.inference.online.likelihood import tally_of, track_points
from tests.inference.online_worlds import MASS, Rows, box_world, simulate

pytestmark = pytest.mark.slow

CAPACITY, NUM_PARTICLES = 64, 512


@pytest.fixture(scope="module", autouse=True)
def single_precision():
    """As users run it."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="module")
def online():
    return OnlineBelief(
        box_world([], is_hidden=True), capacity=CAPACITY, num_particles=NUM_PARTICLES
    )


def followed(online: OnlineBelief, belief, rows: Rows, *, observes: bool = True):
    """All rows one by one; the belief and what each did."""
    found = []
    for index in range(len(rows.action)):
        if observes:
            belief, observed = online.observe(belief, *rows.transition(index))
            found.append(observed)
        else:
            belief, info = online.step(belief, *rows.transition(index))
            found.append(info)
    return belief, found


def constraints(posterior) -> list[str]:
    """Kinds of the most probable structure."""
    return sorted(c["type"] for c in posterior.to_json()["structure"][0]["constraints"])


def check_consistency(belief):
    """What was added up row by row is what all rows at once give."""
    block = jax.tree.map(lambda leaf: leaf[0], belief.blocks[0])
    particles = block.particles
    mean, square = track_points(
        block.target, particles.structure, particles.z, block.begin, belief.num_rows
    )
    alive = np.asarray(particles.log_weight) > -30
    for found, expected in ((particles.mean, mean), (particles.square, square)):
        np.testing.assert_allclose(
            np.asarray(found)[alive], np.asarray(expected)[alive], rtol=2e-2, atol=2e-3
        )
    whole = tally_of(block.target)
    np.testing.assert_allclose(block.tally.num, whole.num, rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(block.tally.log_volume, whole.log_volume, rtol=1e-3)


def test_a_box_that_gets_pinned_is_found_out_within_a_few_dozen_rows(online):
    rows = simulate(3, ["free"] * 40 + ["pinned"] * 24)
    belief, found = followed(online, online.init(jax.random.key(0)), rows)
    changes = [k for k, o in enumerate(found) if o.refit and o.refit.has_changed]
    assert len(changes) == 1
    assert 40 <= changes[0] < 60
    (block,) = found[changes[0]].refit.blocks
    assert abs(block.changed_at - 40) <= 1
    posterior = online.posterior(belief)
    assert constraints(posterior) == ["revolute"]
    mass = posterior.to_json()["bodies"]["box"]["mass"]
    assert mass["q05"] * 0.9 < MASS < mass["q95"] * 1.1


def test_a_wheel_that_locks_is_found_out_and_the_table_overflows_in_one_program(online):
    rows = simulate(5, ["cart"] * 56 + ["locked"] * 40)
    belief, found = followed(online, online.init(jax.random.key(1)), rows)
    changes = [k for k, o in enumerate(found) if o.refit and o.refit.has_changed]
    assert len(changes) == 1
    assert 56 <= changes[0] < 80
    assert sum(int(o.step.num_left) for o in found) >= CAPACITY // 8
    posterior = online.posterior(belief)
    assert "wheel" in constraints(posterior)
    # A locked wheel rolls as hardly as it slides.
    params = posterior.params
    kept = np.asarray(params.wheel.active[:, 0, 0])
    rates = np.asarray(params.wheel.viscous[:, 0, 0])[kept]
    assert np.median(rates.min(axis=1)) > 60.0
    assert online._step._cache_size() == 1
    check_consistency(belief)


def test_a_change_that_few_particles_survive_is_not_taken_for_noise(online):
    """One odd row leaves next to none; a refit of all rows then would hide it."""
    found_at = []
    for seed in range(20, 24):
        rows = simulate(seed, ["cart"] * 40 + ["locked"] * 20)
        _, found = followed(online, online.init(jax.random.key(seed)), rows)
        changes = [k for k, o in enumerate(found) if o.refit and o.refit.has_changed]
        assert len(changes) <= 1
        found_at += changes
    assert len(found_at) >= 3
    assert all(40 <= at < 56 for at in found_at)


def test_steps_alone_hold_their_sums_through_gaps_and_overflow(online):
    rows = simulate(7, ["cart"] * 80)
    gaps = np.random.default_rng(0).random((2, 80, 6)) < 0.2
    rows = Rows(
        np.where(gaps[0], np.nan, rows.state),
        rows.action,
        np.where(gaps[1], np.nan, rows.next_state),
    )
    history = Rows(*(part[:30] for part in rows)).to_history(capacity=CAPACITY)
    belief = online.init(jax.random.key(2), history)
    later = Rows(*(part[30:] for part in rows))
    belief, found = followed(online, belief, later, observes=False)
    assert sum(int(info.num_left) for info in found) == 2 * CAPACITY // 8
    assert int(belief.num_rows) == 80 - 2 * CAPACITY // 8
    check_consistency(belief)
    posterior = online.posterior(belief)
    assert constraints(posterior) == ["wheel"]
    assert online._step._cache_size() == 1


def test_the_same_key_gives_the_same_bits_step_by_step_and_scanned(online):
    rows = simulate(8, ["free"] * 12)
    start = online.init(jax.random.key(3))
    one, _ = followed(online, start, rows, observes=False)
    two, _ = followed(online, start, rows, observes=False)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        if not jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    inputs = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(rows.transition(k) for k in range(12))
    )
    scanned, infos = jax.lax.scan(lambda b, row: online.step(b, *row), start, inputs)
    assert infos.num_rows.tolist() == list(range(1, 13))
    weights = [x.blocks[0].particles.log_weight for x in (one, scanned)]
    sizes = [float(np.exp(2 * np.asarray(w)).sum()) for w in weights]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.5)


@pytest.mark.parametrize("name", ["free", "cart", "pinned"])
def test_a_belief_agrees_with_inference_on_all_rows_at_once(online, name):
    rows = simulate(11, [name] * 60)
    belief, _ = followed(online, online.init(jax.random.key(4)), rows)
    posterior = online.posterior(belief)
    batch = boomdp_jax.infer(
        jax.random.key(5), online.spec, rows.to_history(capacity=CAPACITY)
    )
    ours, theirs = (x.structure_probabilities() for x in (posterior, batch))
    # 512 particles know a probability to 0.03 at worst, gains frozen at different fits
    # move log-odds by some tenths of a nat.
    for structure in ours.keys() | theirs.keys():
        difference = ours.get(structure, 0.0) - theirs.get(structure, 0.0)
        assert abs(difference) < 0.12, structure
    mass, expected = (x.to_json()["bodies"]["box"]["mass"] for x in (posterior, batch))
    assert abs(mass["q50"] - expected["q50"]) < 0.5 * expected["sd"]
    # Noise is averaged over in eight levels, and much depends on it in this pinned
    # world: by its key the belief came out 0.78 to 1.16 times as wide as `infer`; with
    # one level at 0.42. With noise fixed at the truth in both they agree within 5 %.
    assert 0.5 < mass["sd"] / expected["sd"] < 1.5


@pytest.mark.parametrize("unknown", [{}, {"revolute": 1}], ids=["no joint", "a pin"])
def test_few_structures_are_all_asked_for_their_noise(unknown):
    """None is left over, with one structure or with two that hold their own."""
    spec = box_world([], is_hidden=True, unknown=unknown)
    online = OnlineBelief(spec, capacity=CAPACITY, num_particles=NUM_PARTICLES)
    belief = online.init(jax.random.key(0))
    rows = simulate(3, ["free"] * 12)
    # With the first rows a pin may still be.
    belief, _ = followed(online, belief, Rows(*(part[:2] for part in rows)))
    belief, _ = online.refit(belief)
    belief, _ = followed(online, belief, Rows(*(part[2:] for part in rows)))
    belief, again = online.refit(belief)
    # Particles that are kept tell nothing of the evidence.
    assert again.blocks[0].is_warm
    assert np.isnan(again.blocks[0].log_evidence)
    posterior = online.posterior(belief)
    mass = 0.24 * np.asarray(posterior.params.density)[:, 0]
    weight = np.exp(np.asarray(posterior.log_weight))
    mean = np.average(mass, weights=weight)
    sd = np.sqrt(np.average((mass - mean) ** 2, weights=weight))
    assert abs(mean - MASS) < 4 * sd < 0.2 * MASS
    assert constraints(posterior) == []


def test_forgetting_discounts_rows_by_their_age():
    rate = 0.9
    online = OnlineBelief(
        box_world([], is_hidden=True),
        capacity=16,
        num_particles=64,
        forgetting=rate,
    )
    rows = simulate(12, ["free"] * 12)
    start = online.init(jax.random.key(6))
    belief, _ = followed(online, start, rows, observes=False)
    block = jax.tree.map(lambda leaf: leaf[0], belief.blocks[0])
    ages = np.arange(11, -1, -1.0)
    weight = np.asarray(block.target.log_likelihood.data.weight)[:12]
    np.testing.assert_allclose(weight, rate**ages, rtol=1e-5)
    # Two readings of position, one of the angle, and so on, of each row.
    counts = np.array([2.0, 1.0, 2.0, 1.0]) * np.sum(rate**ages)
    np.testing.assert_allclose(block.tally.num[0, 0], counts, rtol=1e-4)
    check_consistency(belief)


def test_step_lengths_are_refused_or_asked_for(online):
    rows = simulate(8, ["free"] * 2)
    belief = online.init(jax.random.key(7))
    with pytest.raises(ValueError, match="dt: expected none"):
        online.step(belief, *rows.transition(0), 0.02)
