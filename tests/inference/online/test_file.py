"""An online belief that is saved and read goes on as if nothing had been."""

from pathlib import Path

import jax
import numpy as np
import pytest

from boomdp_jax.core.npz_file import read_npz, write_npz
from boomdp_jax.inference import OnlineBelief
from tests.inference.online_worlds import box_world, simulate

SIZES = {"capacity": 16, "num_particles": 64, "num_noise_levels": 1}
SCENE = box_world([], is_hidden=True, unknown={"ground": 1})


def same_bits(one, other) -> bool:
    """Whether two trees are equal, keys and all."""
    leaves = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(
        a.dtype == b.dtype
        and np.asarray(_words(a)).tobytes() == np.asarray(_words(b)).tobytes()
        for a, b in leaves
    )


def _words(leaf):
    is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The prior's belief, in a file."""
    path = tmp_path_factory.mktemp("belief") / "belief.npz"
    online = OnlineBelief(SCENE, **SIZES)
    online.save(online.init(jax.random.key(3)), path)
    return path


@pytest.mark.slow
def test_a_belief_comes_back_to_the_bit(written: Path):
    online = OnlineBelief(SCENE, **SIZES)
    found = online.load(written)
    assert same_bits(found, online.init(jax.random.key(3)))
    assert not same_bits(found, online.init(jax.random.key(4)))
    other = online.init(jax.random.key(3, impl="rbg"))
    online.save(other, written.with_name("other.npz"))
    found = online.load(written.with_name("other.npz"))
    assert same_bits(found, other)
    assert found.key.dtype == other.key.dtype


@pytest.mark.slow
def test_a_belief_goes_on_in_another_filter_as_in_its_own(tmp_path: Path):
    """Through steps, a refit and the oldest rows leaving a full table."""
    rows = simulate(1, ["free"] * 24)
    online = OnlineBelief(SCENE, **SIZES)
    belief = online.init(jax.random.key(0))
    for row in range(12):
        belief, _ = online.observe(belief, *rows.transition(row))
    online.save(belief, tmp_path / "belief.npz")
    other = OnlineBelief(SCENE, **SIZES)
    again = other.load(tmp_path / "belief.npz")
    assert same_bits(again, belief)
    for row in range(12, 24):
        belief, _ = online.observe(belief, *rows.transition(row))
        again, _ = other.observe(again, *rows.transition(row))
    assert int(belief.num_seen) == 24
    assert same_bits(again, belief)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"capacity": 24},
            "capacity: expected 24, as this OnlineBelief has it, got 16",
        ),
        ({"num_particles": 32}, "num_particles: expected 32, .* got 64"),
        ({"forgetting": 0.9}, "forgetting: expected 0.9, .* got 1.0"),
        ({"dt": 0.1}, "dt: expected 0.1, .* got 0.02"),
        ({"has_varying_dt": True}, "has_varying_dt: expected true, .* got false"),
        ({"change_rate": 0.0}, "change_rate: expected 0.0, .*"),
        ({"num_noise_levels": 2}, "num_noise_levels: expected 2, .* got 1"),
    ],
)
def test_a_belief_of_another_filter_is_refused(written: Path, changes, message: str):
    online = OnlineBelief(SCENE, **SIZES | changes)
    with pytest.raises(ValueError, match=f"^{written}: {message}$"):
        online.load(written)


def test_a_belief_of_another_scene_is_refused(written: Path):
    scene = box_world([], is_hidden=True, unknown={"wheel": 1})
    with pytest.raises(ValueError, match="scene: expected"):
        OnlineBelief(scene, **SIZES).load(written)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda a: a.pop("header"), "expected an online belief with a header"),
        (lambda a: a.pop("num_rows"), "num_rows: expected an array, got none"),
        (lambda a: a.update(more=np.zeros(1)), "more: expected no such array, got one"),
        (
            lambda a: a.update(num_seen=np.zeros(2, a["num_seen"].dtype)),
            r"num_seen: expected int\d+\[\], got int\d+\[2\]",
        ),
        (
            lambda a: a.update(num_seen=np.zeros((), np.float16)),
            r"num_seen: expected int\d+\[\], got float16\[\]",
        ),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, written: Path, damage, message):
    arrays = dict(read_npz(written))
    damage(arrays)
    path = tmp_path / "belief.npz"
    write_npz(path, arrays)
    with pytest.raises(ValueError, match=message):
        OnlineBelief(SCENE, **SIZES).load(path)


def test_a_file_of_something_else_is_refused(tmp_path: Path):
    path = tmp_path / "belief.npz"
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="expected an NPZ file"):
        OnlineBelief(SCENE, **SIZES).load(path)
