"""Does anything that a user may write down make the engine fail?

Random worlds (`_random_worlds`) are stepped 200 times without wrenches: one to six
bodies, joints of every kind, wheels, floors, overlaps, speeds up to 50 m/s, masses of
one to a thousand kilograms. Counted are worlds that are not finite, and among those
whose outlines did not overlap at the start those that have gained more than one per
cent of energy (kinetic at the start and what their fall set free). The same worlds are
run without joints and without contact too.
"""

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from _random_worlds import NUM_BODIES, Kinds, World, draw_world
from _report import Reporter, parser_of

from boomdp_jax.physics import State, rollout

NUM_STEPS, BATCH = 200, 4096
MOST_GAIN = 0.01
CASES = {
    "contact": Kinds(contact=True, joints=False),
    "joints": Kinds(contact=False, joints=True),
    "contact and joints": Kinds(contact=True, joints=True),
}


def energies(world: World, state: State):
    """Kinetic and potential energy of what can move [J]."""
    scene, params, _ = world
    mass = jnp.where(scene.is_static, 0.0, params.density * scene.area)
    speed = state.twist[..., 0] ** 2 + state.twist[..., 1] ** 2
    kinetic = 0.5 * mass * (speed + scene.gyration * state.twist[..., 2] ** 2)
    height = jnp.sum(scene.gravity * state.pose[..., :2], axis=-1)
    return jnp.sum(kinetic, axis=-1), -jnp.sum(mass * height, axis=-1)


def judge(key, kinds: Kinds) -> dict:
    """Draw a world, run it and say what came of it."""
    world = draw_world(key, kinds)
    wrenches = jnp.zeros((NUM_STEPS, NUM_BODIES, 3))
    states, info = rollout(*world, wrenches)
    kinetic, potential = energies(world, states)
    first_kinetic, first_potential = energies(world, world.state)
    freed = jnp.maximum(first_potential - jnp.min(potential), 0.0)
    gain = kinetic + potential - first_kinetic - first_potential
    is_finite = jnp.all(info.is_finite) & jnp.all(jnp.isfinite(states.array))
    is_clear = jnp.ones((), bool) if info.overlap is None else info.overlap[0] <= 0.0
    return {
        "is_finite": is_finite,
        "is_clear": is_clear,
        "gain": jnp.max(gain) / (first_kinetic + freed + 1e-3),
        "drift": jnp.max(info.constraint_error),
        "overlap": jnp.zeros(()) if info.overlap is None else jnp.max(info.overlap),
    }


def run(kinds: Kinds, num_worlds: int, seed: int) -> tuple[dict, float]:
    """Results of many, and the seconds that took, but for the first batch."""
    function = jax.jit(jax.vmap(partial(judge, kinds=kinds)))
    batch, found, seconds = min(BATCH, num_worlds), [], 0.0
    for first in range(0, num_worlds, batch):
        keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), first), batch)
        start = time.perf_counter()
        found.append(jax.tree.map(np.asarray, jax.block_until_ready(function(keys))))
        seconds += time.perf_counter() - start if first else 0.0
    whole = {name: np.concatenate([f[name] for f in found]) for name in found[0]}
    return whole, seconds / max(1, len(found) - 1) / batch


def report(reporter: Reporter, case: str, found: dict, seconds: float) -> None:
    """Counts, and quantiles of what is not counted."""
    num, clear = len(found["is_finite"]), found["is_clear"]
    lost, gain = int(np.sum(~found["is_finite"])), found["gain"]
    too_much = int(np.sum(~(gain[clear] <= MOST_GAIN)))
    for metric, value, n, target in (
        ("worlds that are not finite", lost, num, 0),
        ("worlds that gain over 1 % of energy", too_much, int(clear.sum()), 0),
    ):
        reporter.report(
            case=case,
            metric=metric,
            value=value,
            n=n,
            target=target,
            met=value <= target,
        )
    figures = [("largest gain of energy", np.nanmax(gain[clear]), "")]
    if np.any(~clear):
        late = int(np.sum(~(gain[~clear] <= MOST_GAIN)))
        name = f"that gain over 1 %, of {int(np.sum(~clear))} that overlapped at first"
        figures.append((name, late, ""))
    figures += [
        (f"joint drift, {name}", np.nanquantile(found["drift"], q), "m")
        for name, q in (("99 of 100", 0.99), ("999 of 1000", 0.999))
    ]
    figures.append(
        ("deepest overlap, 99 of 100", np.quantile(found["overlap"], 0.99), "m")
    )
    if seconds > 0:
        per_step = 1e6 * seconds / NUM_STEPS
        figures.append(("time a world and step", per_step, "us"))
    for metric, value, unit in figures:
        reporter.report(case=case, metric=metric, value=float(value), unit=unit, n=num)


def main() -> int:
    """Run all cases."""
    parser = parser_of(__doc__)
    parser.add_argument("--num", type=int, default=16_384, help="worlds of each case")
    parser.add_argument("--case", default="", help="cases whose name contains this")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    reporter = Reporter(arguments.out)
    for case, kinds in CASES.items():
        is_left_out = arguments.quick and kinds.contact
        if arguments.case not in case or is_left_out:
            continue
        num = 256 if arguments.quick else arguments.num
        report(reporter, case, *run(kinds, num, arguments.seed))
    reporter.print_table()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
