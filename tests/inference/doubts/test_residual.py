"""A wrong law shows as such, and a right one does not."""

import json
from typing import Any

import jax
import numpy as np
import pytest
from scipy import stats

import boomdp_jax
from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.doubts.residual import FEWEST_ROWS, ResidualCheck
from boomdp_jax.inference.doubts.residual_laws import LAWS
from boomdp_jax.inference.doubts.residual_report import describe_law, report_residuals
from boomdp_jax.physics.scene_spec import SceneSpec, scene_spec_from_dict
from tests.inference import residual_worlds as worlds
from tests.inference.recordings import AREA, DT, MASS, box_scene, free_box
from tests.inference.residual_checks import (
    IMPULSE,
    assert_names,
    check,
    known_boxes,
)


def scaled(spec: SceneSpec, history: History, name: str, value: float) -> float:
    """Coordinate of a number, given the value of what is normal a priori."""
    likelihood: Any = make_block(spec, (0,), history).target.log_likelihood
    scales = likelihood.coordinates.scales
    return (value - float(scales.center[name])) / float(scales.spread[name])


WRONG = {
    "viscous": (worlds.viscous(3.0), [-3.0]),
    "coulomb": (worlds.dry(2.0), [-2.0]),
    "constant_force": (worlds.slope(1.0, -0.5), [1.0, -0.5]),
    "lever": (worlds.lever(0.05, -0.02), [0.05, -0.02]),
    # Torques then do 1 / 1.6 of what the model has them do.
    "torque_gain": (worlds.inertia(1.6), [1.0 / 1.6 - 1.0]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", list(WRONG))
def test_a_law_that_is_added_is_named_with_its_coefficient(name):
    """Coefficients within four sds, which the noise of the motion makes wide."""
    force, expected = WRONG[name]
    history = worlds.record_box(np.random.default_rng(1), 100, force)
    (found,) = check([history])
    assert_names(found, name, expected)


@pytest.mark.slow
def test_a_free_box_follows_no_further_law():
    """Twenty of them, whose noise is known: a bound of 1 in 2,000 for each."""
    rng = np.random.default_rng(2)
    histories = [worlds.record_box(rng, 60) for _ in range(20)]
    threshold = np.log(2000.0)
    for found in check(histories, impulse=np.array([1e-4, 1e-4])):
        assert found.laws[0].fit.log_bayes_factor < threshold
        (white,) = found.whiteness
        assert set(white) == {"position", "angle", "velocity", "spin"}
        assert min(white.values()) > 1e-4


@pytest.mark.slow
def test_the_law_is_found_on_the_body_that_has_it():
    """Two bodies of one block, one of them pushed off its centre of mass."""
    rng = np.random.default_rng(3)
    tables = [
        worlds.box_table(rng, 60),
        worlds.box_table(rng, 60, worlds.lever(0.05, -0.02), first=np.full(6, 0.5)),
    ]
    parts = [np.stack(part, axis=1) for part in zip(*tables, strict=True)]
    (found,) = check([make_history(*parts, DT)], known_boxes(2))
    assert found.laws[0].body == 1
    assert_names(found, "lever", [0.05, -0.02])
    others = [each for each in found.laws if each.body == 0]
    assert others[0].fit.log_bayes_factor < np.log(2000.0)


@pytest.mark.slow
def test_positions_alone_and_steps_of_any_length_will_do():
    rng = np.random.default_rng(4)
    dt = rng.uniform(0.015, 0.04, size=100)
    state, action, next_state = worlds.box_table(rng, 100, worlds.viscous(4.0), dt=dt)
    state[:, 3:], next_state[:, 3:] = np.nan, np.nan
    # Some readings are missing altogether.
    next_state[20:24], state[21:25] = np.nan, np.nan
    history = make_history(state[:, None], action[:, None], next_state[:, None], dt)
    (found,) = check([history])
    assert_names(found, "viscous", [-4.0])
    assert set(found.whiteness[0]) == {"position", "angle"}
    assert found.num_rows == 96


@pytest.mark.slow
def test_padding_changes_nothing_and_few_rows_are_left_alone():
    rng = np.random.default_rng(5)
    history = worlds.record_box(rng, 40, worlds.viscous(3.0))
    short = worlds.record_box(rng, FEWEST_ROWS - 1, worlds.viscous(3.0))
    plain = check([history])[0]
    padded, few = check([history.padded(64), short.padded(64)])
    assert few == ResidualCheck(FEWEST_ROWS - 1, [], [])
    assert padded.num_rows == plain.num_rows == 40
    for first, second in zip(plain.laws, padded.laws, strict=True):
        assert first.law.name == second.law.name
        evidence = first.fit.log_bayes_factor
        np.testing.assert_allclose(second.fit.log_bayes_factor, evidence, rtol=1e-4)


def test_a_density_that_is_free_absorbs_a_mass_and_no_more():
    """Force and torque both by 1.25: a fifth less mass; force alone: a law."""
    rng = np.random.default_rng(6)

    def both(state, wrench):
        return 1.25 * wrench

    def force_alone(state, wrench):
        return wrench * np.array([1.25, 1.25, 1.0])

    histories = [worlds.record_box(rng, 60, law) for law in (both, force_alone)]
    spec, found = box_scene(), []
    for history, mass in zip(histories, (MASS / 1.25, MASS), strict=True):
        z = scaled(spec, history, "density", np.log(mass / AREA))
        found += check([history], spec, z=np.array([z]))
    assert found[0].laws[0].fit.log_bayes_factor < np.log(2000.0)
    best = found[1].laws[0]
    assert best.fit.log_bayes_factor > 10.0
    assert best.law.name in ("force_gain_x", "force_gain_y", "torque_gain")


@pytest.mark.slow
def test_dry_friction_is_not_viscous():
    """A model whose friction may only be viscous takes up what it can of it.

    The box rubs with 2 N; its model is a castor at its centre with any coefficient.
    """
    law = {"viscous": [None, None]}
    spec = scene_spec_from_dict(
        {
            **known_boxes().to_dict(),
            "constraints": [{"type": "wheel", "a": "box0", "pose": [0, 0, 0], **law}],
        },
        source="test",
    )
    history = worlds.record_box(np.random.default_rng(10), 100, worlds.dry(2.0))
    z = np.zeros(9)
    z[4] = scaled(spec, history, "wheel.lateral_rate", np.log(2.5 / MASS))
    z[6] = scaled(spec, history, "wheel.viscous_ratio", 3.0)
    # On a point it does not resist spin, which the box does not either.
    z[8] = scaled(spec, history, "wheel.half_track", np.log(1e-3))
    (found,) = check([history], spec, 0.4 * IMPULSE, z)
    laws = {each.law.name: each.fit for each in found.laws}
    # Beside free viscous friction a force that does not grow with speed and one that
    # grows the faster, with the other sign, are much the same.
    assert found.laws[0].law.name in ("coulomb", "drag")
    assert laws["coulomb"].log_bayes_factor > 10.0
    error = laws["coulomb"].coefficient + 2.0
    np.testing.assert_array_less(np.abs(error), 4.0 * laws["coulomb"].sd)
    assert laws["viscous"].log_bayes_factor < 0.0


@pytest.mark.slow
def test_reports_say_the_law_in_words_and_numbers():
    history = worlds.record_box(np.random.default_rng(7), 100, worlds.viscous(3.0))
    (found,) = check([history])
    text = describe_law(found.laws[0])
    assert text.startswith("a force in proportion to its velocity, -")
    assert "N s/m (log Bayes factor " in text
    spec = known_boxes()
    result = BlockResult(make_block(spec, (0,), history), None, 0, found)
    entries, reasons, notes = report_residuals(spec, [result])
    assert reasons == [
        f"box0: its motion also follows a law that the model lacks: {text}"
    ]
    assert notes == []
    (entry,) = json.loads(json.dumps(entries))
    assert entry["bodies"] == ["box0"]
    assert entry["laws"][0]["law"] == "viscous"
    assert entry["laws"][0]["unit"] == "N s/m"
    # Markov's bound of one in a hundred for all laws together, and three nats.
    assert entry["threshold"] == pytest.approx(np.log(100.0 * len(LAWS)) + 3.0)
    # Not looked at: nothing to say.
    bare = result._replace(residual=None)
    assert report_residuals(spec, [bare]) == ([], [], [])


@pytest.mark.parametrize(
    ("size", "by_chance", "is_reason", "is_note"),
    [
        (0.6, 1e-12, True, False),
        (0.6, 1e-5, False, True),
        (0.5, 1e-12, False, True),
        (-0.6, 1e-12, False, True),
        (0.6, 0.1, False, False),
    ],
)
def test_what_goes_on_from_reading_to_reading_is_a_doubt(
    size: float, by_chance: float, is_reason: bool, is_note: bool
):
    """Where it is both large and sure; a little of it is a note."""
    spec = known_boxes()
    history = worlds.record_box(np.random.default_rng(16), 20)
    white = {"position": 0.5, "angle": by_chance}
    found = ResidualCheck(20, [], [white], (), ({"position": 0.9, "angle": size},))
    result = BlockResult(make_block(spec, (0,), history), None, 0, found)
    (entry,), reasons, notes = report_residuals(spec, [result])
    assert entry["correlation"] == {"box0": {"position": 0.9, "angle": size}}
    said = [line for line in reasons if "angle readings goes on from one to" in line]
    assert len(said) == len(reasons) == is_reason
    assert len(notes) == is_note


@pytest.mark.slow
def test_checks_tell_how_readings_hang_together():
    """Of a free box next to nothing; of one that is pulled on unseen, much."""
    rng = np.random.default_rng(17)
    quiet, pulled = check(
        [worlds.record_box(rng, 100), worlds.record_box(rng, 100, worlds.viscous(9.0))],
        impulse=np.array([1e-4, 1e-4]),
    )
    assert max(quiet.correlation[0].values()) < 0.4
    assert pulled.correlation[0]["velocity"] > 0.5


COUNTS = {"num_samples": 100, "num_warmup": 50}


@pytest.mark.slow
def test_honest_recordings_raise_no_doubt():
    """Forty, noise of 0 to 15 % of each channel: at most one in a hundred doubted.

    The bound is the binomial's, exceeded once in a thousand by a rate of 1 %.
    """
    rng = np.random.default_rng(8)
    # Sds of the channels of such recordings, about [m, m, rad, m/s, m/s, rad/s].
    spread = np.array([0.3, 0.3, 0.5, 0.7, 0.7, 2.0])
    with jax.enable_x64(False):
        histories = [
            free_box(rng, 40, noise=share * spread)
            for share in np.tile([0.0, 0.002, 0.01, 0.05, 0.15], 8)
        ]
        posteriors = boomdp_jax.infer_batch(
            jax.random.key(0), [box_scene()] * len(histories), histories, **COUNTS
        )
    doubted = ["law" in "; ".join(p.diagnostics["reasons"]) for p in posteriors]
    assert sum(doubted) <= stats.binom(len(histories), 0.01).ppf(0.999)


@pytest.fixture(scope="module")
def posteriors() -> dict:
    """Of boxes that obey laws which a free box of unknown density does not."""
    rng = np.random.default_rng(9)
    forces = {name: force for name, (force, _) in WRONG.items()}
    forces["free"] = worlds.nothing_else
    with jax.enable_x64(False):
        histories = [worlds.record_box(rng, 80, force) for force in forces.values()]
        found = boomdp_jax.infer_batch(
            jax.random.key(0), [box_scene()] * len(forces), histories, **COUNTS
        )
    return dict(zip(forces, found, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(WRONG))
def test_inference_says_which_law_its_model_lacks(posteriors, name):
    """What the noise was inferred to be hides none of them.

    An outline that is thirty per cent too small in truth has too small an inertia for
    its mass: the density takes the mass, so it is torques that do too little.
    """
    diagnostics = posteriors[name].diagnostics
    assert not diagnostics["ok"]
    (reason,) = diagnostics["reasons"]
    assert reason.startswith("box: its motion also follows a law that the model lacks")
    (entry,) = diagnostics["residual"]
    best = entry["laws"][0]
    assert best["law"] == name
    error = np.abs(np.array(best["coefficient"]) - WRONG[name][1])
    assert np.all(error < 4.0 * np.array(best["sd"]))
    summary = posteriors[name].summary()
    assert "NOT OK: box: its motion also follows" in summary
    assert "further law   box: " + name.replace("_", " ") in summary
    assert posteriors[name].to_json()["diagnostics"]["residual"][0]["laws"]


@pytest.mark.slow
def test_inference_finds_nothing_in_a_free_box(posteriors):
    diagnostics = posteriors["free"].diagnostics
    assert diagnostics["ok"]
    (entry,) = diagnostics["residual"]
    assert entry["laws"][0]["log_bayes_factor"] < entry["threshold"]
    assert "further law   none; likeliest is box: " in posteriors["free"].summary()
