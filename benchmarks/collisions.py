"""What collisions of two bodies tell, with no force applied and positions only.

Two discs of random size, mass, friction and restitution drift towards each other,
collide off their centres and part. A camera sees where they are and how they have
turned, never how fast. `infer` is asked for the ratio of their masses and for the
numbers of contact, and set against the closed form of `_two_discs.py`: error, coverage
of the 90 % intervals, and mean and sd of a posterior on a grid that knows the noise and
takes the motion as exact (`infer` infers both, so that its intervals are wider). Before
that the likelihood itself, at the grid's own noise, is set against the grid.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _report import Reporter, parser_of
from _two_discs import (
    DENSITY_SPREAD,
    DT,
    FRICTION,
    RESTITUTION,
    Collision,
    GridPosterior,
    grid_posterior,
    log_prior,
    random_collision,
)

import boomdp_jax
from boomdp_jax.core import History, make_history
from boomdp_jax.inference.blocks.block import make_block
from boomdp_jax.inference.likelihoods.filter_density import filter_density
from boomdp_jax.inference.likelihoods.kalman import NoiseLevel
from boomdp_jax.inference.readings.touching import find_touching
from boomdp_jax.physics import SceneSpec, scene_spec_from_dict

NAMES = ("log mass ratio", "restitution", "log friction")
LEVELS = (0.05, 0.95)
CHECK_SHIFT, CHECK_RATIO = 0.1, 0.05
"""By how many sds of the grid's posterior the likelihood's mean may differ, and by what
share its sd."""


class Found(NamedTuple):
    """Of one number of one collision."""

    mean: float
    sd: float
    is_covered: bool


def main() -> None:
    parser = parser_of(__doc__, quick="two collisions, no verdict")
    parser.add_argument("--collisions", type=int, default=24)
    parser.add_argument("--checked", type=int, default=4)
    parser.add_argument("--readings", type=int, default=41)
    parser.add_argument("--noise", type=float, default=1e-3, help="sd of a place [m]")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.quick:
        arguments.collisions, arguments.checked, arguments.readings = 2, 1, 25
    reporter = Reporter(arguments.out)
    collisions = [
        random_collision(
            np.random.default_rng([arguments.seed, number]),
            arguments.readings,
            arguments.noise,
        )
        for number in range(arguments.collisions)
    ]
    grids = [grid_posterior(collision) for collision in collisions]
    check_likelihood(reporter, collisions[: arguments.checked], grids)
    specs, histories = zip(*map(recording_of, collisions), strict=True)
    posteriors = boomdp_jax.infer_batch(
        jax.random.key(arguments.seed), specs, histories
    )
    for axis, name in enumerate(NAMES):
        truths = np.array([truth_of(collision)[axis] for collision in collisions])
        found = [
            _summary(numbers_of(posterior, collision)[axis], truth)
            for posterior, collision, truth in zip(
                posteriors, collisions, truths, strict=True
            )
        ]
        _report(reporter, name, axis, truths, found, grids, arguments.quick)
    seconds = posteriors[0].seconds
    num_ok = sum(posterior.diagnostics["ok"] for posterior in posteriors)
    case = "two discs, infer"
    n = len(posteriors)
    reporter.report(case=case, metric="diagnostics ok", value=num_ok / n, n=n)
    reporter.report(
        case=case, metric="run time of one", value=seconds["run"] / n, unit="s", n=n
    )
    reporter.report(
        case=case, metric="compile time", value=seconds["compile"], unit="s", n=n
    )
    reporter.print_table()


def recording_of(collision: Collision) -> tuple[SceneSpec, History]:
    """The scene, with everything left open, and poses without rates."""
    bodies = [
        {
            "name": name,
            "shape": {"type": "circle", "radius": float(radius)},
            "contact": {"friction": None, "restitution": None},
        }
        for name, radius in zip("ab", collision.radius, strict=True)
    ]
    spec = scene_spec_from_dict(
        {"schema": "planar-scene-1", "dt": DT, "bodies": bodies}, source="two discs"
    )
    state = np.full((len(collision.time), 2, 6), np.nan)
    state[..., :3] = collision.pose
    still = np.zeros((len(state) - 1, 2, 3))
    return spec, make_history(state[:-1], still, state[1:], DT)


def check_likelihood(
    reporter: Reporter, collisions: list[Collision], grids: list[GridPosterior]
) -> None:
    """Set the filter's likelihood, at known noise, against the closed form."""
    shifts, ratios = [], []
    with jax.enable_x64(True):
        for collision, grid in zip(collisions, grids, strict=False):
            ours = GridPosterior(grid.axes, _weights(collision, grid))
            for axis in range(2):
                (mean, sd), (own, own_sd) = grid.moments(axis), ours.moments(axis)
                shifts.append(abs(own - mean) / sd)
                ratios.append(own_sd / sd)
    n, case = len(shifts), "two discs, likelihood against closed form"
    shift, ratio = max(shifts), max(max(ratios), 1.0 / min(ratios))
    reporter.report(
        case=case,
        metric="worst shift of a mean",
        value=shift,
        unit="sd",
        n=n,
        target=CHECK_SHIFT,
        met=shift < CHECK_SHIFT,
    )
    reporter.report(
        case=case,
        metric="worst ratio of sds",
        value=ratio,
        n=n,
        target=1.0 + CHECK_RATIO,
        met=ratio < 1.0 + CHECK_RATIO,
    )
    if shift >= CHECK_SHIFT or ratio >= 1.0 + CHECK_RATIO:
        raise SystemExit(f"{case}: the likelihood is wrong")


def _weights(collision: Collision, grid: GridPosterior) -> np.ndarray:
    """Posterior on the same grid by the extended filter."""
    spec, history = recording_of(collision)
    touching = find_touching(spec, history)
    block = make_block(spec, (0, 1), history, touching=touching)
    likelihood: Any = block.target.log_likelihood
    mesh = np.stack(np.meshgrid(*grid.axes, indexing="ij"), axis=-1).reshape(-1, 3)
    log_ratio, restitution, log_friction = mesh.T
    area = np.pi * collision.radius**2
    apart = 0.5 * (log_ratio - np.log(area[0] / area[1])) / DENSITY_SPREAD
    logit = np.log(restitution) - np.log1p(-restitution)
    z = np.stack(
        [
            apart,
            -apart,
            (log_friction - np.log(FRICTION[0])) / FRICTION[1],
            (logit - RESTITUTION[0]) / RESTITUTION[1],
        ],
        axis=-1,
    )
    # Rates are not read; what their noise is does not matter.
    reading = [collision.noise[0], collision.noise[2], 4e-3, 4e-3]
    noise = NoiseLevel(jnp.tile(jnp.array(reading), (2, 1)), jnp.full((2, 2), 1e-6))
    value = np.asarray(_densities(likelihood, noise, jnp.asarray(z)))
    value = value + log_prior(collision, log_ratio, restitution, log_friction)
    weight = np.exp(value - value.max())
    return (weight / weight.sum()).reshape(grid.weight.shape)


@jax.jit
def _densities(likelihood: Any, noise: NoiseLevel, z: jax.Array) -> jax.Array:
    coordinates = likelihood.coordinates

    def one(z: jax.Array) -> jax.Array:
        params = coordinates(z, jnp.zeros(0, bool))
        return filter_density(coordinates.world, params, likelihood.data, noise)

    return jax.lax.map(one, z, batch_size=256)


def truth_of(collision: Collision) -> tuple[float, float, float]:
    """Numbers that the posterior is about."""
    log_ratio = float(np.log(collision.mass[0] / collision.mass[1]))
    return log_ratio, collision.restitution, float(np.log(collision.friction))


def numbers_of(posterior: Any, collision: Collision) -> tuple[np.ndarray, ...]:
    """Equally weighted draws of the same."""
    density = np.asarray(posterior.params.density, float)
    mass = density * np.pi * collision.radius**2
    surface = posterior.params.surface
    return (
        np.log(mass[:, 0] / mass[:, 1]),
        np.asarray(surface.restitution, float)[:, 0],
        np.log(np.asarray(surface.friction, float)[:, 0]),
    )


def _summary(draws: np.ndarray, truth: float) -> Found:
    low, high = np.quantile(draws, LEVELS)
    return Found(float(draws.mean()), float(draws.std()), bool(low < truth < high))


def _report(
    reporter: Reporter,
    name: str,
    axis: int,
    truths: np.ndarray,
    found: list[Found],
    grids: list[GridPosterior],
    is_quick: bool,
) -> None:
    """Error, coverage, and what the closed form comes to."""
    n, case = len(found), f"two discs, {name}"
    mean, sd = np.array([f[:2] for f in found]).T
    exact = np.array([grid.moments(axis) for grid in grids])
    limits = np.array([grid.quantiles(axis, LEVELS) for grid in grids])
    peer = "closed form on a grid"
    coverage = float(np.mean([f.is_covered for f in found]))
    peer_coverage = float(np.mean((limits[:, 0] < truths) & (truths < limits[:, 1])))
    # Of so many, as many as chance leaves out in one of a hundred runs.
    least = 0.9 - 2.33 * np.sqrt(0.09 / n)
    reporter.report(
        case=case,
        metric="root mean square error",
        value=float(np.sqrt(np.mean((mean - truths) ** 2))),
        n=n,
        peer=peer,
        peer_value=float(np.sqrt(np.mean((exact[:, 0] - truths) ** 2))),
    )
    reporter.report(
        case=case,
        metric="coverage of 90 %",
        value=coverage,
        n=n,
        peer=peer,
        peer_value=peer_coverage,
        target=least,
        met=None if is_quick else coverage >= least,
    )
    reporter.report(
        case=case,
        metric="median sd",
        value=float(np.median(sd)),
        n=n,
        peer=peer,
        peer_value=float(np.median(exact[:, 1])),
    )
    reporter.report(
        case=case,
        metric="mean against the closed form's, root mean square",
        value=float(np.sqrt(np.mean(((mean - exact[:, 0]) / exact[:, 1]) ** 2))),
        unit="its sds",
        n=n,
    )


if __name__ == "__main__":
    main()
