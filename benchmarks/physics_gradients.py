"""What the gradient of a hundred steps of ten bodies costs beside a forward run.

A chain of ten links, and ten boxes in a room, flying and piling up, through the public
`rollout` in single precision; the gradient is that of the mean of all states by all
densities, and its peer is a forward run that ends in the same mean. The answer is
checked first, in double precision and over as many steps as bodies need to meet: the
derivative along one direction, by both modes, beside central differences.
Compile and run time are apart; a run is the fastest of several.
"""

import dataclasses
import statistics

import jax
import jax.numpy as jnp
import numpy as np
from _peers_scenes import Case, all_cases
from _report import Reporter, parser_of
from _timing import measure

from boomdp_jax.physics import rollout, state_from_array

NUM_STEPS = 100
SCENES = ("chain of ten", "flying", "piling")
# Steps over which derivatives are compared: later ones are as chaotic as the worlds.
# Wide differences straddle jumps, where a contact begins a substep earlier: of 4 worlds
# of boxes one does within a millionth of its densities.
CHECKED_STEPS, CHECKED_WORLDS, STEP = 30, 4, 1e-8
TOLERANCE, TARGET_RATIO, TARGET_COMPILE = 1e-4, 4.0, 15.0


def problem(case: Case, batch: int, num_steps: int, dtype):
    """A function of densities, and where it is evaluated."""
    spec = case.spec
    params = jax.tree.map(_as(dtype), spec.params())
    scene = jax.tree.map(_as(dtype), spec.scene)
    start = state_from_array(jnp.asarray(case.starts(batch), dtype))
    wrenches = jnp.zeros((num_steps, spec.num_bodies, 3), dtype)

    def mean(density, scene, params, start):
        params = dataclasses.replace(params, density=density)
        states, _ = jax.vmap(lambda one: rollout(scene, params, one, wrenches))(start)
        return jnp.mean(states.pose) + jnp.mean(states.twist)

    return mean, (params.density, scene, params, start)


def _as(dtype):
    def convert(leaf):
        leaf = jnp.asarray(leaf)
        return leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf

    return convert


def check(reporter: Reporter, case: Case) -> bool:
    """Both modes beside central differences, along a random direction."""
    with jax.enable_x64(True):
        mean, (density, *rest) = problem(
            case, CHECKED_WORLDS, CHECKED_STEPS, jnp.float64
        )
        rng = np.random.default_rng(0)
        along = jnp.asarray(density * rng.normal(size=density.shape))
        value = jax.jit(lambda d: mean(d, *rest))
        low, high = (float(value(density + s * STEP * along)) for s in (-1.0, 1.0))
        expected = (high - low) / (2.0 * STEP)
        reverse = jax.jit(jax.grad(lambda d: mean(d, *rest)))(density)
        forward = jax.jit(lambda d, a: jax.jvp(value, (d,), (a,))[1])(density, along)
    along_reverse = np.vdot(np.asarray(reverse), np.asarray(along))
    found = {"reverse": float(along_reverse), "forward": float(forward)}
    is_right = True
    for mode, derivative in found.items():
        error = abs(derivative - expected) / abs(expected)
        is_right = is_right and error <= TOLERANCE
        reporter.report(
            case=f"{case.name.split(',')[0]}, {CHECKED_STEPS} steps",
            metric=f"error of a derivative in {mode} mode",
            value=error,
            peer="central differences",
            peer_value=expected,
            target=TOLERANCE,
            met=error <= TOLERANCE,
        )
    return is_right


def time_case(reporter: Reporter, case: Case, batch: int, num_runs: int) -> None:
    """A forward run and its gradient, one after the other."""
    mean, arguments = problem(case, batch, NUM_STEPS, jnp.float32)
    per_step = 1e6 / (batch * NUM_STEPS)
    name = f"{case.name.split(',')[0]}, {NUM_STEPS} steps, batch {batch}"
    fastest = []
    for kind, function in (
        ("forward run", mean),
        ("gradient", jax.value_and_grad(mean)),
    ):
        compiled, runs = measure(function, arguments, num_runs)
        fastest.append(min(runs))
        is_forward = kind == "forward run"
        reporter.report(
            case=name,
            metric=f"compile, {kind}",
            value=compiled,
            unit="s",
            target=TARGET_COMPILE if is_forward else None,
            met=compiled <= TARGET_COMPILE if is_forward else None,
        )
        reporter.report(
            case=name,
            metric=f"wall time of a world step, {kind} (spread: median run)",
            value=min(runs) * per_step,
            unit="us",
            n=num_runs,
            spread=statistics.median(runs) * per_step,
        )
    ratio = fastest[1] / fastest[0]
    reporter.report(
        case=name,
        metric="gradient beside forward run",
        value=ratio,
        peer="forward run",
        peer_value=1.0,
        target=TARGET_RATIO,
        met=ratio <= TARGET_RATIO,
    )


def main() -> int:
    """Check and time every scene."""
    parser = parser_of(__doc__, quick="the chain only, batch 64")
    parser.add_argument("--scene", default="", help="scenes whose name contains this")
    arguments = parser.parse_args()
    reporter, is_right = Reporter(arguments.out), True
    for case in all_cases():
        wanted = SCENES[:1] if arguments.quick else SCENES
        if arguments.scene not in case.name or not any(w in case.name for w in wanted):
            continue
        is_right = check(reporter, case) and is_right
        for batch in (64,) if arguments.quick else (64, 1024):
            time_case(reporter, case, batch, 3 if batch > 64 else 7)
    reporter.print_table()
    return 0 if is_right else 1


if __name__ == "__main__":
    raise SystemExit(main())
