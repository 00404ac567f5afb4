"""Likelihoods of single steps and open loops, against the engine and closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import boomdp_jax
from boomdp_jax.core.history import History, make_history
from boomdp_jax.inference.block import make_block, stack_blocks
from boomdp_jax.inference.exact_starts import ExactStarts, with_open_loop
from boomdp_jax.physics import State, step
from boomdp_jax.physics.scene_spec import SceneSpec
from tests.inference.recordings import (
    AREA,
    DT,
    MASS,
    box_scene,
    free_box,
    response,
    transition_matrix,
)

# Prior scales of the noise of readings, of the channels x, y, theta and their rates.
SCALE = np.array([1e-3, 1e-3, 1e-3, 4e-3, 4e-3, 4e-3])
GROUPS = ((0, 1), (2,), (3, 4), (5,))
METHODS = ("rj", "enumerate", "smc", "laplace", "map")


def windows(history: History, horizon: int | None) -> list[list[int]]:
    """Rows of each prediction, the way a person would mark them in the table."""
    state_is_whole = np.asarray(history.state_mask).all(axis=(1, 2))
    rows, episode = np.asarray(history.mask), np.asarray(history.episode)
    found: list[list[int]] = []
    is_open = False
    for row in np.flatnonzero(rows):
        if row == 0 or episode[row] != episode[row - 1]:
            is_open = False
        if is_open and len(found[-1]) == horizon:
            is_open = False
        if is_open:
            found[-1].append(int(row))
        elif state_is_whole[row]:
            found.append([int(row)])
            is_open = True
    return found


def log_student(errors: list[np.ndarray]) -> float:
    """Errors `[channel]`, NaN where none, of one body; noise integrated out.

    Normal errors whose variance is inverse-gamma of shape 1 and rate b are
    multivariate Student-t of two degrees of freedom and scale matrix b.
    """
    table = np.array(errors)
    total = 0.0
    for group in GROUPS:
        each = table[:, group].ravel()
        each = each[~np.isnan(each)]
        shape = SCALE[group[0]] ** 2 * np.eye(len(each))
        total += stats.multivariate_t.logpdf(each, shape=shape, df=2.0)
    return float(total)


def errors_of(history: History, predict, horizon: int | None) -> list[np.ndarray]:
    """Of everything that a prediction says, by going through the table row by row."""
    seen = np.asarray(history.state_mask), np.asarray(history.next_state_mask)
    first = np.where(seen[0], np.asarray(history.state), np.nan)[:, 0]
    last = np.where(seen[1], np.asarray(history.next_state), np.nan)[:, 0]
    found = []
    for rows in windows(history, horizon):
        now = first[rows[0]]
        for row in rows:
            if row != rows[0] and not history.is_chained[row]:
                found.append(first[row] - now)
            now = predict(now, np.asarray(history.action)[row, 0])
            found.append(last[row] - now)
    return found


@jax.jit
def engine_step(scene, params, now, wrench):
    return step(scene, params, State(now[None, :3], now[None, 3:]), wrench[None])[0]


@eqx.filter_jit
def value_of(target, z, active):
    """Log-likelihood, and the hypothesis that it is of."""
    likelihood = target.log_likelihood
    return likelihood(z, active), likelihood.coordinates(z, active)


def by_newton(mass: float):
    """A free box under a wrench that is held over a step."""
    return lambda now, wrench: transition_matrix() @ now + response(mass) @ wrench


def target_of(spec: SceneSpec, history: History, horizon: int | None):
    """The posterior's density, as samplers see it."""
    stacked = stack_blocks([make_block(spec, (0,), history)])
    starts = ExactStarts(horizon)
    return jax.tree.map(lambda leaf: leaf[0], with_open_loop(stacked, starts))


def pushed_box(is_chained: bool, has_gaps: bool) -> History:
    """Three runs of ten rows, with room for more, some of it not read."""
    rng = np.random.default_rng(3)
    history = free_box(rng, 30, is_chained=is_chained, num_episodes=3)
    state, last = np.array(history.state), np.array(history.next_state)
    if has_gaps:
        for row, channel in ((0, 4), (5, 0), (14, 2), (15, 5), (27, 3)):
            state[row, 0, channel] = np.nan
            if is_chained and row % 10:
                last[row - 1, 0, channel] = np.nan
        last[29, 0, 1] = np.nan
    action, episode = np.asarray(history.action), np.asarray(history.episode)
    return make_history(state, action, last, DT, episode=episode, capacity=37)


@pytest.mark.parametrize("has_gaps", [False, True], ids=["whole", "gaps"])
@pytest.mark.parametrize("is_chained", [True, False], ids=["one", "two"])
@pytest.mark.parametrize("horizon", [1, 2, 4, 30, None])
def test_log_likelihoods_are_those_of_rollouts(horizon, is_chained, has_gaps):
    """Of the engine, at hypotheses with and without a wheel and floor friction.

    One or two readings of each instant; single steps are open loops of one step.
    """
    history = pushed_box(is_chained, has_gaps)
    target = target_of(box_scene({"wheel": 1, "ground": 1}), history, horizon)
    scene = target.log_likelihood.coordinates.world
    rng = np.random.default_rng(4)
    for active in target.structures:
        z = jnp.asarray(0.7 * rng.standard_normal(target.dim))
        found, params = value_of(target, z, active)

        def by_engine(now, wrench, params=params):
            after = engine_step(scene, params, jnp.asarray(now), jnp.asarray(wrench))
            return np.asarray(after.array)[0]

        expected = log_student(errors_of(history, by_engine, horizon))
        np.testing.assert_allclose(float(found), expected, rtol=1e-9)


def test_a_second_reading_that_nothing_starts_from_counts():
    """Twice as many errors as rows, but for the rows that predictions start in."""
    whole = windows(pushed_box(False, False), 4)
    assert [len(rows) for rows in whole] == [4, 4, 2] * 3
    errors = errors_of(pushed_box(False, False), by_newton(MASS), 4)
    assert len(errors) == 2 * 30 - 9


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
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("horizon", [1, 5, None])
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
    slack = 0.1 if method in ("laplace", "map") else 0.03
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
