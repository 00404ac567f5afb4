"""Posteriors by single steps and open loops: what they find, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import boomdp_jax
from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.sweeps.sweep import infer_sweep
from boomdp_jax.interop import hide, random_object, record_random_pushes
from boomdp_jax.physics import State, step
from boomdp_jax.physics.scene_spec import SceneSpec
from tests.inference.exact_predictions import (
    GROUPS,
    SCALE,
    by_newton,
    errors_of,
    log_student,
)
from tests.inference.recordings import (
    AREA,
    DT,
    MASS,
    box_scene,
    free_box,
)
from tests.inference.two_discs import RADIUS, approaching, discs_spec, state_at

METHODS = ("rj", "enumerate", "smc", "laplace", "map")


def oracle(history: History, horizon: int | None) -> tuple[float, float, float]:
    """Mean and sd of a free box's log-density, and its log-evidence, by quadrature."""
    true = np.log(MASS / AREA)
    grid = true + np.linspace(-0.2, 0.2, 801)
    value = [
        log_student(errors_of(history, by_newton(AREA * np.exp(x)), horizon))
        for x in grid
    ]
    value = np.array(value) + stats.norm.logpdf(grid, np.log(30.0), 1.5)
    weight = np.exp(value - value.max())
    total = np.trapezoid(weight, grid)
    mean = np.trapezoid(weight * grid, grid) / total
    variance = np.trapezoid(weight * (grid - mean) ** 2, grid) / total
    assert weight[[0, -1]].max() < 1e-9
    return mean, np.sqrt(variance), value.max() + np.log(total)


def log_density_of(posterior) -> np.ndarray:
    return np.log(np.asarray(posterior.params.density, float)[:, 0])


@pytest.fixture(scope="module")
def free() -> History:
    return free_box(np.random.default_rng(8), 24, num_episodes=2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("horizon", "method"),
    [*((horizon, m) for horizon in (1, None) for m in METHODS), (5, "enumerate")],
)
def test_posteriors_are_those_of_quadrature(free, horizon, method):
    """Mean, sd and evidence; mean to five, sd to four standard errors of the draws."""
    mean, sd, log_evidence = oracle(free, horizon)
    name = "one-step" if horizon == 1 else "open-loop"
    posterior = boomdp_jax.infer(
        jax.random.key(2),
        box_scene(),
        free,
        method=method,
        likelihood=name,
        horizon=None if name == "one-step" else horizon,
    )
    draws = log_density_of(posterior)
    if method == "map":
        # The peak of a density that is a little skewed.
        assert abs(draws[0] - mean) < 0.3 * sd
    else:
        size = 500.0
        assert abs(draws.mean() - mean) < 5.0 * sd / np.sqrt(size)
        assert draws.std() == pytest.approx(sd, rel=4.0 / np.sqrt(2.0 * size))
    # The bumps' precision leaves out how noise answers to the density.
    slack = 0.5 if method in ("laplace", "map") else 0.03
    assert float(posterior.log_evidence) == pytest.approx(log_evidence, abs=slack)
    assert posterior.impulse_scale is None
    errors = np.array(errors_of(free, by_newton(AREA * np.exp(mean)), horizon))
    for place, group in enumerate(GROUPS):
        each = errors[:, group].ravel()
        # Peak of the inverse-gamma density of log-noise.
        peak = np.sqrt(
            (SCALE[group[0]] ** 2 + 0.5 * np.sum(each**2)) / (1.0 + 0.5 * each.size)
        )
        found = np.median(np.asarray(posterior.noise_scale, float)[:, 0, place])
        # A standard error of the noise itself; draws scatter by far less.
        assert found == pytest.approx(peak, rel=1.0 / np.sqrt(2.0 * each.size))
    diagnostics = posterior.diagnostics
    assert diagnostics["likelihood"] == name
    is_narrow = any("intervals are too narrow" in x for x in diagnostics["notes"])
    assert is_narrow == (name == "open-loop")
    assert posterior.to_json()["diagnostics"]["likelihood"] == name
    assert ("horizon" in diagnostics) == (name == "open-loop")


def infer_box(history: History, **options):
    return boomdp_jax.infer(jax.random.key(0), box_scene(), history, **options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"likelihood": "kalman"},
            "likelihood: expected one of auto, .* got 'kalman'",
        ),
        ({"horizon": 3}, "horizon: expected none with likelihood 'filtered'"),
        (
            {"likelihood": "one-step", "horizon": 3},
            "horizon: expected none with likelihood 'one-step', .*; got 3",
        ),
        *(
            (
                {"likelihood": "open-loop", "horizon": value},
                "horizon: expected a whole number, at least 1, or None; got",
            )
            for value in (0, -2, True)
        ),
        (
            {"likelihood": "open-loop", "outliers": "student-t"},
            "outliers: expected none with likelihood 'open-loop', got 'student-t'",
        ),
        (
            {"likelihood": "filtered", "method": "nuts"},
            "likelihood: expected auto or one-step with method 'nuts', got 'filtered'",
        ),
        (
            {"likelihood": "open-loop", "method": "svi"},
            "likelihood: expected auto or one-step with method 'svi', got 'open-loop'",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(free, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        infer_box(free, **options)
    if "outliers" in options:
        return
    with pytest.raises(ValueError, match=message):
        infer_sweep(jax.random.key(0), box_scene(), [free], tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def positions_only(history: History) -> History:
    state, last = np.array(history.state), np.array(history.next_state)
    state[..., 3:], last[..., 3:] = np.nan, np.nan
    return make_history(
        state, history.action, last, DT, episode=np.asarray(history.episode)
    )


@pytest.mark.parametrize("method", ["rj", "nuts"])
def test_exact_starts_need_velocities(free, method):
    message = (
        "test: box: likelihood 'one-step': expected rows that start from a reading of "
        "every pose, velocity and spin; got none; likelihood 'filtered' does without"
    )
    with pytest.raises(ValueError, match=message):
        infer_box(positions_only(free), method=method, likelihood="one-step")


@pytest.mark.slow
def test_rows_without_a_start_are_left_out_and_counted(free):
    state = np.array(free.state)
    state[[3, 7, 8], 0, 4] = np.nan
    gaps = make_history(
        state, free.action, free.next_state, DT, episode=np.asarray(free.episode)
    )
    kept = np.setdiff1d(np.arange(24), [3, 7, 8])
    rest = jax.tree.map(lambda leaf: leaf[kept], free)
    rest = make_history(rest.state, rest.action, rest.next_state, DT, episode=kept)
    options = {"likelihood": "one-step", "method": "map"}
    posterior, expected = infer_box(gaps, **options), infer_box(rest, **options)
    assert "box: 3 of 24 rows do not count" in posterior.diagnostics["notes"][0]
    assert float(posterior.log_evidence) == pytest.approx(
        float(expected.log_evidence), abs=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"likelihood": "one-step"},
        {"likelihood": "open-loop", "horizon": 10},
    ],
    ids=["one-step", "ten steps"],
)
def test_on_clean_dense_readings_all_find_the_truth(options):
    """Pin, wheel or floor friction, the density, and where the pin is."""
    truths, specs, histories = [], [], []
    for number, family in enumerate(("box", "table", "cart")):
        rng = np.random.default_rng([31, number])
        truth = random_object(rng, family)
        truths.append(truth)
        specs.append(hide(truth))
        histories.append(record_random_pushes(rng, truth, 80).to_history())
    posteriors = boomdp_jax.infer_batch(
        jax.random.key(1), specs, histories, method="enumerate", **options
    )
    for truth, posterior in zip(truths, posteriors, strict=True):
        first = posterior.to_json()["structure"][0]
        kinds = sorted(c["type"] for c in first["constraints"])
        assert kinds == sorted(c.kind for c in truth.constraints)
        assert first["probability"] > 0.9
        mass = posterior.to_json()["bodies"]["object"]["mass"]
        expected = truth.bodies[0].density * truth.bodies[0].area
        assert mass["q50"] == pytest.approx(expected, rel=0.02)
        assert posterior.diagnostics["likelihood"] == options["likelihood"]
    (pin,) = posteriors[1].to_json()["structure"][0]["constraints"]
    numbers = truths[1].constraints[0].numbers
    for key in ("anchor_a", "anchor_b"):
        assert np.hypot(*np.subtract(pin[key]["mean"], numbers[key])) < 5e-3


NUM_OBJECTS, NUM_ROWS = 16, 100
DRAG = 35.0
"""Of the floor, known [N s/m]; a box of median density loses five parts a second."""

FEWEST = int(stats.binom.ppf(1e-3, NUM_OBJECTS, 0.9))
"""Right 90 % intervals cover fewer than this once in a thousand."""


def dragged_box() -> SceneSpec:
    ground = {"type": "ground", "a": "box", "viscous": DRAG, "dry": 1e6}
    return box_scene(constraints=[ground])


@jax.jit
def roll(target, z, start, wrenches, kicks):
    coordinates = target.log_likelihood.coordinates
    params = coordinates(jnp.zeros(target.dim).at[0].set(z), target.structures[0])

    def advance(now, row):
        wrench, kick = row
        kicked = State(now[:, :3], now[:, 3:] + kick)
        after = step(coordinates.scene, params, kicked, wrench)[0].array
        return after, after

    return jax.lax.scan(advance, start, (wrenches, kicks))[1]


def dragged_boxes(reading: np.ndarray, kick: np.ndarray) -> tuple[list, np.ndarray]:
    """Recordings of boxes that are slowly pushed about, and their log-densities.

    Args:
        reading: sd of the noise of readings, `[6]`.
        kick: sd of the impulse on the twist before each step, `[3]`.
    """
    histories, truths = [], []
    for number in range(NUM_OBJECTS):
        rng = np.random.default_rng([23, number])
        z = 0.3 * rng.standard_normal()
        wrench = rng.standard_normal((NUM_ROWS, 1, 3)) * [0.2, 0.2, 0.2]
        for row in range(1, NUM_ROWS):
            # Correlated over half a second, so that drag and push nearly balance.
            wrench[row] = 0.96 * wrench[row - 1] + 0.28 * wrench[row] / 0.2
        wrench = wrench * [20.0, 20.0, 1.0]
        start = 0.3 * rng.standard_normal((1, 6))
        kicks = kick * rng.standard_normal((NUM_ROWS, 1, 3))
        blank = np.zeros((NUM_ROWS, 1, 6))
        history = make_history(blank, wrench, blank, DT)
        target = make_block(dragged_box(), (0,), history).target
        after = roll(target, *map(jnp.asarray, (z, start, wrench, kicks)))
        state = np.concatenate([start[None], np.asarray(after)])
        state = state + reading * rng.standard_normal(state.shape)
        histories.append(make_history(state[:-1], wrench, state[1:], DT))
        truths.append(np.log(30.0) + 1.5 * z)
    return histories, np.array(truths)


SMALL, LARGE = SCALE, np.array([5e-3, 5e-3, 5e-3, 0.08, 0.08, 0.08])
"""Readings of next to no noise, and of a fifth of the speeds' own spread."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("reading", "kick", "likelihood", "is_right"),
    [
        (LARGE, 0.0, "filtered", True),
        (LARGE, 0.0, "one-step", False),
        (LARGE, 0.0, "open-loop", False),
        (SMALL, 0.05, "filtered", True),
        (SMALL, 0.05, "one-step", True),
        (SMALL, 0.05, "open-loop", False),
    ],
)
def test_noise_where_it_is_left_out_spoils_intervals(
    reading, kick, likelihood, is_right
):
    """That of readings single steps and open loops, that of the motion open loops.

    One structure, one mode: draws from the bump on it will do.
    """
    histories, truth = dragged_boxes(reading, np.full(3, kick))
    posteriors = boomdp_jax.infer_batch(
        jax.random.key(3),
        [dragged_box()] * NUM_OBJECTS,
        histories,
        method="laplace",
        likelihood=likelihood,
    )
    draws = np.array([log_density_of(posterior) for posterior in posteriors])
    low, high = np.quantile(draws, [0.05, 0.95], axis=1)
    num_covered = int(np.sum((low <= truth) & (truth <= high)))
    assert (num_covered >= FEWEST) == is_right, num_covered
    if likelihood == "one-step" and not is_right:
        # Drag on noise looks like inertia that is not there: boxes come out too light.
        score = (draws.mean(axis=1) - truth) / draws.std(axis=1)
        assert np.mean(score) < -3.0 / np.sqrt(NUM_OBJECTS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [{"likelihood": "one-step"}, {"likelihood": "open-loop", "horizon": 5}],
    ids=["one-step", "five steps"],
)
def test_discs_that_collide_are_followed(options):
    """Nothing pushes them: what can be known is the ratio of their masses."""
    rng, masses = np.random.default_rng(12), (1.5, 0.6)
    contact = {"friction": 0.2, "restitution": 0.5}
    rows = []
    for run in range(6):
        start = approaching(rng, touch=0.11)
        numbers = (*masses, contact["restitution"], contact["friction"])
        states = np.stack([state_at(start, numbers, DT * k) for k in range(13)])
        states = states + 0.1 * np.tile(SCALE, 2).reshape(2, 6) * rng.standard_normal(
            states.shape
        )
        rows.append((states[:-1], states[1:], np.full(12, run)))
    first, last, episode = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    still = np.zeros((len(first), 2, 3))
    history = make_history(first, still, last, DT, episode=episode)
    posterior = boomdp_jax.infer(
        jax.random.key(0), discs_spec(contact=contact), history, **options
    )
    density = np.asarray(posterior.params.density, float)
    area = np.pi * RADIUS**2
    ratio = np.log(density[:, 0] * area[0]) - np.log(density[:, 1] * area[1])
    low, high = np.quantile(ratio, [0.005, 0.995])
    assert low - 0.02 < np.log(masses[0] / masses[1]) < high + 0.02
    assert ratio.std() < 0.05
