"""Kinds from scenes and histories: what is refused, what is seen, the file, a run."""

import dataclasses

import jax
import numpy as np
import pytest

from boomdp_jax.core.history import make_history
from boomdp_jax.inference import KindPrior, infer_kinds, load_kinds
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.hypotheses.prior import DEFAULT_SCALES
from boomdp_jax.inference.kinds.features import number_labels, outline_features
from boomdp_jax.inference.kinds.file import LearntKinds
from boomdp_jax.inference.kinds.infer_kinds import _check_options
from boomdp_jax.inference.kinds.objects import resting_pose, sample_alone
from boomdp_jax.inference.kinds.problem import settle
from boomdp_jax.inference.kinds.state import Tallies
from boomdp_jax.inference.samplers.structure_draws import SampleSettings
from boomdp_jax.physics.body_spec import read_body
from boomdp_jax.physics.scene_spec import scene_spec_from_dict
from tests.inference.recordings import DT, SIZE, free_box


def box(name: str, **fields) -> dict:
    return {"name": name, "shape": {"type": "box", "half_extents": SIZE}} | fields


def scene(bodies: list[dict], **fields):
    content = {
        "schema": "planar-scene-1",
        "gravity": [0.0, 0.0],
        "dt": DT,
        "bodies": bodies,
    }
    return scene_spec_from_dict(content | fields, source="room")


def nothing_seen(num_bodies: int):
    empty = np.full((2, num_bodies, 6), np.nan)
    return make_history(empty, np.zeros((2, num_bodies, 3)), empty, DT)


def test_tied_bodies_are_refused_by_name():
    rod = {"type": "distance", "a": "a", "b": "b", "length": 0.5}
    rod |= {"anchor_a": [0, 0], "anchor_b": [0, 0]}
    spec = scene([box("a"), box("b")], constraints=[rod])
    with pytest.raises(ValueError, match=r"body 'a': .*got a distance to 'b'"):
        infer_kinds(jax.random.key(0), spec, nothing_seen(2))


def test_bodies_with_other_constraints_are_refused_by_name():
    wheel = {"type": "wheel", "a": "b", "pose": [0, 0, 0], "viscous": [None, None]}
    spec = scene([box("a"), box("b")], constraints=[wheel])
    with pytest.raises(ValueError, match="body 'b': expected the constraints"):
        infer_kinds(jax.random.key(0), spec, nothing_seen(2))


def test_scenes_with_other_priors_are_refused_by_number():
    """Objects of a kind share numbers in units of their prior."""
    wide = {"density": {"center": 100.0, "spread": 1.0}}
    specs = [scene([box("a")]), scene([box("a")], prior=wide)]
    with pytest.raises(ValueError, match=r"prior: density: .*; got \(100\.0"):
        infer_kinds(jax.random.key(0), specs, [nothing_seen(1)] * 2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sampler": "gibbs"}, "sampler: expected one of collapsed, sticks"),
        ({"concentration": 0.0}, "concentration: expected a positive number, or 0"),
        ({"prior": KindPrior(weights=(1.0,))}, "weights: expected 4 positive"),
        ({"num_chains": 0}, "num_chains: expected at least 1, got 0"),
        ({"num_warmup": -1}, "num_warmup: expected at least 0, got -1"),
        ({"num_samples": 0}, "num_samples: expected at least 1, got 0"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, message):
    spec = scene([box("a")])
    with pytest.raises(ValueError, match=message):
        infer_kinds(jax.random.key(0), spec, nothing_seen(1), **options)


@pytest.mark.parametrize(
    ("option", "error", "message"),
    [
        (
            {"prior_kinds": "k.npz"},
            TypeError,
            "prior_kinds: expected LearntKinds, .*got 'k.npz'",
        ),
        ({"prior": {}}, TypeError, "prior: expected a KindPrior; got {}"),
        ({"concentration": "1"}, ValueError, "concentration: expected .*got '1'"),
        ({"concentration": True}, ValueError, "concentration: expected .*got True"),
    ],
)
def test_what_is_of_another_type_is_refused_by_name(option, error, message):
    """Of the check itself, as tests run with types checked on every call."""
    options = {"prior_kinds": None, "prior": None, "concentration": None} | option
    with pytest.raises(error, match=message):
        _check_options(sampler="collapsed", **options)


def test_histories_of_other_scenes_are_refused():
    spec = scene([box("a")])
    with pytest.raises(ValueError, match="history: expected 1 bodies, got 2"):
        infer_kinds(jax.random.key(0), spec, nothing_seen(2))
    with pytest.raises(ValueError, match="histories: expected one per scene, 2, got 1"):
        infer_kinds(jax.random.key(0), [spec, spec], nothing_seen(1))
    with pytest.raises(ValueError, match="specs: expected at least one, got none"):
        infer_kinds(jax.random.key(0), [], [])


def test_outlines_are_told_apart_whatever_their_pose():
    square = [[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]]
    tilt = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    turned = (np.array(square) @ tilt.T + [0.3, 0.1]).tolist()
    shapes = [
        {"type": "polygon", "vertices": square},
        {"type": "polygon", "vertices": turned},
        {"type": "circle", "radius": float(np.sqrt(1 / np.pi))},
    ]
    features = [
        outline_features(read_body({"name": "x", "shape": shape}, "room", 0))
        for shape in shapes
    ]
    np.testing.assert_allclose(features[0], features[1], atol=1e-9)
    # A disc of the same area has less inertia and no fewer corners.
    assert features[2][0] == pytest.approx(features[0][0])
    assert features[2][2] < features[0][2]
    assert features[2][3] > features[0][3]


def test_labels_are_numbered_by_first_use():
    numbers, names = number_labels(["chair", None, "box", "chair"], ["table"])
    assert names == ("table", "chair", "box")
    assert numbers.tolist() == [1, -1, 2, 1]


def test_a_body_at_rest_tells_nothing_and_its_pin_is_where_it_stands():
    pose = np.array([1.0, 2.0, 0.7])
    rng = np.random.default_rng(0)
    reading = np.concatenate([pose, np.zeros(3)]) + 1e-3 * rng.normal(size=(6, 1, 6))
    history = make_history(reading[:5], np.zeros((5, 1, 3)), reading[1:], DT)
    spec = scene([box("a")], unknown={"revolute": 1, "distance": 1})
    alone = sample_alone(jax.random.key(0), [spec], [history], SampleSettings())
    assert alone.bodies[0].bumps is None
    found = resting_pose(spec, history, 0)
    assert found is not None
    np.testing.assert_allclose(found, pose, atol=2e-3)
    block = make_block(spec, (0,), history)
    coordinates = block.target.log_likelihood.coordinates
    z = settle(coordinates, rng.normal(size=(5, block.layout.dim)), pose)
    for row in z:
        params = coordinates(jax.numpy.asarray(row), jax.numpy.ones(2, bool))
        turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
        place = pose[:2] + turn @ np.asarray(params.revolute.anchor_a[0])
        np.testing.assert_allclose(place, params.revolute.anchor_b[0], atol=1e-9)
        place = pose[:2] + turn @ np.asarray(params.distance.anchor_a[0])
        length = np.hypot(*(place - np.asarray(params.distance.anchor_b[0])))
        assert length == pytest.approx(float(params.distance.length[0]))


def learnt() -> LearntKinds:
    rng = np.random.default_rng(1)
    shape = (3, 2)
    tallies = Tallies(
        count=np.array([[4.0, 2.0]] * 3),
        structure=rng.random((*shape, 2)),
        label=rng.random((*shape, 3)),
        num=rng.random((*shape, 5)),
        first=rng.random((*shape, 5)),
        second=rng.random((*shape, 5)),
    )
    return LearntKinds(
        tallies=tallies,
        spread=rng.integers(0, 4, (*shape, 5)),
        concentration=rng.random(3),
        slots=("ground",),
        labels=("chair", "table"),
        num_features=4,
        reach=0.5,
        scales={name: (0.1, 1.5) for name in DEFAULT_SCALES},
        prior=KindPrior(structure_weight=0.3),
        versions={"jax": "0"},
    )


def test_learnt_kinds_survive_their_file(tmp_path):
    kinds = learnt()
    kinds.save(tmp_path / "kinds.npz")
    read = load_kinds(tmp_path / "kinds.npz")
    for field in dataclasses.fields(kinds):
        before, after = getattr(kinds, field.name), getattr(read, field.name)
        if field.name == "tallies":
            for one, other in zip(before, after, strict=True):
                np.testing.assert_array_equal(one, other)
        elif isinstance(before, np.ndarray):
            np.testing.assert_array_equal(before, after)
        else:
            assert before == after


def test_damaged_files_of_kinds_are_refused(tmp_path):
    path = tmp_path / "kinds.npz"
    kinds = learnt()
    cases = {
        "spread: expected indices under 4": {"spread": kinds.spread + 9},
        "concentration: expected shape": {"concentration": np.zeros((3, 1))},
        "label: expected shape": {"labels": ("chair",)},
        "first: expected finite": {
            "tallies": kinds.tallies._replace(first=kinds.tallies.first * np.nan)
        },
        "prior: spreads: expected numbers": {"prior": KindPrior(spreads=(2.0,))},
        "scales: density: expected a centre and a spread, got None": {"scales": {}},
    }
    for message, change in cases.items():
        dataclasses.replace(kinds, **change).save(path)
        with pytest.raises(ValueError, match=message):
            load_kinds(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="expected an NPZ file"):
        load_kinds(path)


def test_kinds_of_other_bodies_are_no_prior():
    spec = scene([box("a")])
    with pytest.raises(ValueError, match="prior_kinds: expected kinds of bodies that"):
        infer_kinds(jax.random.key(0), spec, nothing_seen(1), prior_kinds=learnt())


def test_bodies_that_nobody_saw_keep_the_prior_and_share_it():
    """Without readings densities are log-normal, and equal bodies are alike."""
    spec = scene([box("a", label="x"), box("b", label="x")], unknown={"ground": 1})
    found = infer_kinds(
        jax.random.key(1), spec, nothing_seen(2), num_warmup=20, num_samples=64
    )
    density = np.log(np.asarray(found.posterior.params.density))
    # 32 chains, each draw independent of the last but for its kind.
    assert abs(density.mean() - np.log(30.0)) < 4.5 * 1.5 / np.sqrt(1000)
    assert density.std() == pytest.approx(1.5, rel=0.1)
    together = found.co_clustering()[0, 1]
    assert together > 0.8  # Same outline and label.
    same = found.kind[:, 0] == found.kind[:, 1]
    gap = np.abs(density[:, 0] - density[:, 1])
    # Spreads within a kind are of a tenth of 1.5 or so; of strangers the gap is 1.4.
    assert np.median(gap[same]) < 0.5
    assert sum(found.num_kinds().values()) == pytest.approx(1.0)
    assert found.groups() == [[0, 1]]
    assert "group 1  a, b" in found.summary()
    active = np.asarray(found.posterior.params.ground.active[:, :, 0])
    assert active.mean() == pytest.approx(0.5, abs=0.1)


def test_several_scenes_share_kinds():
    spec = scene([box("a")], unknown={"ground": 1})
    nothing = nothing_seen(1)
    found = infer_kinds(
        jax.random.key(2),
        [spec, spec],
        [nothing, nothing],
        num_warmup=5,
        num_samples=8,
        sampler="sticks",
        use_outlines=False,
    )
    assert found.names == ("0.a", "1.a")
    assert found.kind.shape == (256, 2)
    notes = found.posteriors[1].diagnostics["notes"]
    assert "known by their kinds alone, never in motion: a" in notes
    same = found.kind[:, 0] == found.kind[:, 1]
    one, other = (np.log(p.params.density[:, 0]) for p in found.posteriors)
    assert np.median(np.abs(one - other)[same]) < 0.5
    assert np.median(np.abs(one - other)[~same]) > 0.5


@pytest.mark.slow
def test_an_untouched_box_is_known_from_its_like(tmp_path):
    """Two boxes are pushed; a third one and one in another room look the same."""
    with jax.enable_x64(False):
        rng = np.random.default_rng(2)
        one, other = free_box(rng, 20), free_box(rng, 20)
        rest = np.zeros((20, 1, 6))
        state = np.concatenate([one.state, other.state, rest], axis=1)
        after = np.concatenate([one.next_state, other.next_state, rest], axis=1)
        push = np.concatenate([one.action, other.action, rest[..., :3]], axis=1)
        bodies = [box(name, label="box") for name in "abc"]
        spec = scene(bodies, unknown={"ground": 1})
        history = make_history(state, push, after, DT)
        found = infer_kinds(jax.random.key(0), spec, history)
        density = np.asarray(found.posterior.params.density)
        truth = 3.0 / (4 * SIZE[0] * SIZE[1])
        assert np.median(density[:, 2]) == pytest.approx(truth, rel=0.1)
        low, high = np.quantile(density[:, 2], [0.25, 0.75])
        assert low < truth < high
        assert np.quantile(density[:, 0], 0.5) == pytest.approx(truth, rel=0.03)
        assert found.co_clustering()[0, 1] > 0.9
        assert found.posterior.diagnostics["r_hat"] < 1.1
        found.save(tmp_path / "kinds.npz")
        new = scene([box("d", label="box"), box("e")], unknown={"ground": 1})
        again = infer_kinds(
            jax.random.key(1),
            new,
            nothing_seen(2),
            prior_kinds=load_kinds(tmp_path / "kinds.npz"),
            concentration=0.0,
        )
        density = np.asarray(again.posterior.params.density)
        assert np.median(density[:, 0]) == pytest.approx(truth, rel=0.1)
        assert np.median(density[:, 1]) == pytest.approx(truth, rel=0.1)
