"""How long does an online belief take for one transition more, and is it right?

A table of 256 transitions and 1,024 particles. First the answer: the belief after a
recording against batch inference on the same rows, structures and mass. Then the time
of one step, compiled and warm: of all steps, of those that resample, and of those at
which the oldest eighth of a full table leaves. Then recovery: a free box that gets
pinned and a cart whose wheel locks half-way; how many transitions until the change is
found, and until the new structure has more than 95 %.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from _changing_box import MASS, WORLDS, box_scene, recorded
from _report import Reporter, parser_of

import boomdp_jax
from boomdp_jax.core.history import make_history
from boomdp_jax.inference import OnlineBelief
from boomdp_jax.inference.online.likelihood import track_points
from boomdp_jax.physics.state import state_from_array

TARGET_SECONDS = 0.05
"""One step with 256 rows and 1,024 particles, two cores, warm."""

_DT = 0.02
_KINDS = {"free": [], "cart": ["wheel"], "pinned": ["revolute"], "locked": ["wheel"]}


def main() -> None:
    parser = parser_of(__doc__, quick="64 rows, 128 particles, steps from the prior")
    parser.add_argument("--capacity", type=int, default=256)
    parser.add_argument("--particles", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=100, help="that are timed")
    parser.add_argument(
        "--seeds", type=int, default=3, help="recoveries of each case; 0: none"
    )
    arguments = parser.parse_args()
    reporter = Reporter(arguments.out)
    if arguments.quick:
        online = OnlineBelief(box_scene([]), capacity=64, num_particles=128)
        belief = online.init(jax.random.key(0))
        time_steps(reporter, online, belief, recorded(0, ["cart"] * 80), 0)
    else:
        online = OnlineBelief(
            box_scene([]),
            capacity=arguments.capacity,
            num_particles=arguments.particles,
        )
        num_fitted = arguments.capacity - arguments.capacity // 8
        rows = recorded(0, ["cart"] * (num_fitted + arguments.steps))
        history = history_of(rows, num_fitted, arguments.capacity)
        belief = online.init(jax.random.key(0), history)
        time_steps(reporter, online, belief, rows, num_fitted)
        check_answer(reporter, online, rows)
        # Of no recoveries there is no worst.
        for case, names in WORLDS.items() if arguments.seeds else ():
            recover(reporter, online, case, names, arguments.seeds)
    reporter.print_table()


def history_of(rows, num: int, capacity: int):
    """The first rows as a table."""
    states, action = rows
    return make_history(
        states[:num], action[:num], states[1 : num + 1], _DT, capacity=capacity
    )


def transition(rows, index: int) -> tuple:
    """One row as a belief takes it."""
    states, action = rows
    pair = [state_from_array(jnp.asarray(states[i], float)) for i in (index, index + 1)]
    return pair[0], jnp.asarray(action[index], float), pair[1]


def time_steps(reporter: Reporter, online: OnlineBelief, belief, rows, first: int):
    """Step through the rest of the rows; check the sums, then report the seconds."""
    start = time.perf_counter()
    jax.block_until_ready(online.step(belief, *transition(rows, first)))
    compile_seconds = time.perf_counter() - start
    seconds, is_resampled, is_leaving = [], [], []
    for index in range(first, len(rows[1])):
        inputs = jax.block_until_ready(transition(rows, index))
        start = time.perf_counter()
        belief, info = jax.block_until_ready(online.step(belief, *inputs))
        seconds.append(time.perf_counter() - start)
        is_resampled.append(bool(info.blocks.is_resampled[0]))
        is_leaving.append(int(info.num_left) > 0)
    case = f"{online.capacity} rows x {belief.blocks[0].particles.z.shape[1]} particles"
    check_sums(reporter, case, belief)
    reporter.report(
        case=case, metric="first call, compiles", value=compile_seconds, unit="s"
    )
    is_full_size = online.capacity >= 256
    kinds = {
        "step": ~np.array(is_leaving),
        "step that resamples": np.array(is_resampled) & ~np.array(is_leaving),
        "step at which the oldest eighth leaves": np.array(is_leaving),
    }
    for name, mask in kinds.items():
        chosen = np.array(seconds)[mask]
        if not chosen.size:
            continue
        for metric, value in (("median", np.median(chosen)), ("worst", chosen.max())):
            reporter.report(
                case=case,
                metric=f"{name}, {metric}",
                value=float(value),
                unit="s",
                n=chosen.size,
                spread=[float(chosen.min()), float(chosen.max())],
                target=TARGET_SECONDS if is_full_size else None,
                met=bool(value < TARGET_SECONDS) if is_full_size else None,
            )


def check_sums(reporter: Reporter, case: str, belief) -> None:
    """What was added up row by row against all rows at once."""
    block = jax.tree.map(lambda leaf: leaf[0], belief.blocks[0])
    particles = block.particles
    _, square = jax.jit(track_points)(
        block.target, particles.structure, particles.z, block.begin, belief.num_rows
    )
    weight = np.exp(np.asarray(particles.log_weight, float))
    error = np.abs(np.asarray(particles.square) / np.asarray(square) - 1.0)
    worst = float(error[weight > 1e-6].max())
    reporter.report(
        case=case,
        metric="relative error of sums of squares",
        value=worst,
        target=0.02,
        met=worst < 0.02,
    )
    assert worst < 0.02, f"sums of squares are off by {worst}"


def check_answer(reporter: Reporter, online: OnlineBelief, rows) -> None:
    """A belief from the first row on, against inference on the same rows at once."""
    num = min(100, online.capacity)
    belief = online.init(jax.random.key(1))
    for index in range(num):
        belief, _ = online.observe(belief, *transition(rows, index))
    ours = online.posterior(belief)
    theirs = boomdp_jax.infer(
        jax.random.key(2), online.spec, history_of(rows, num, online.capacity)
    )
    p, q = ours.structure_probabilities(), theirs.structure_probabilities()
    distance = 0.5 * sum(abs(p.get(k, 0.0) - q.get(k, 0.0)) for k in p.keys() | q)
    mass, expected = (x.to_json()["bodies"]["box"]["mass"] for x in (ours, theirs))
    case = f"{num} rows against batch inference"
    reporter.report(
        case=case,
        metric="total variation of structures",
        value=distance,
        target=0.1,
        met=distance < 0.1,
    )
    for level in ("q05", "q50", "q95"):
        off = abs(mass[level] - expected[level]) / expected["sd"]
        reporter.report(
            case=case,
            metric=f"{level} of mass, off by",
            value=off,
            unit="posterior sd",
            target=0.5,
            met=off < 0.5,
        )


def recover(
    reporter: Reporter, online: OnlineBelief, case: str, names, num_seeds: int
) -> None:
    """Transitions after a change until it is found, and until the truth is."""
    before, after = names
    change, num = 48, 96
    found, right, refits, errors, alarms = [], [], [], [], 0
    for seed in range(num_seeds):
        rows = recorded(100 + seed, [before] * change + [after] * (num - change))
        belief = online.init(jax.random.key(seed))
        first, first_right = None, None
        for index in range(num):
            belief, observed = online.observe(belief, *transition(rows, index))
            if observed.refit is None:
                continue
            refits.append(observed.refit.seconds)
            if observed.refit.has_changed:
                alarms += index < change
                first = index + 1 - change if first is None else first
            if first is not None and first_right is None:
                top = online.posterior(belief).to_json()["structure"][0]
                kinds = sorted(c["type"] for c in top["constraints"])
                if kinds == _KINDS[after] and top["probability"] > 0.95:
                    first_right = index + 1 - change
        found.append(np.inf if first is None else first)
        right.append(np.inf if first_right is None else first_right)
        mass = online.posterior(belief).to_json()["bodies"]["box"]["mass"]["q50"]
        errors.append(abs(mass / MASS - 1.0))
    for metric, values in (
        ("transitions until the change is found", found),
        ("transitions until the truth has over 95 %", right),
    ):
        reporter.report(
            case=case,
            metric=f"{metric}, worst",
            value=float(max(values)),
            n=num_seeds,
            spread=[float(min(values)), float(max(values))],
            target=36,
            met=max(values) <= 36,
        )
    reporter.report(
        case=case,
        metric="false alarms before the change",
        value=float(alarms),
        n=num_seeds,
        target=0,
        met=alarms == 0,
    )
    reporter.report(
        case=case, metric="error of mass, worst", value=max(errors), n=num_seeds
    )
    reporter.report(
        case=case,
        metric="seconds of a refit, median",
        value=float(np.median(refits)),
        unit="s",
        n=len(refits),
        spread=[min(refits), max(refits)],
    )


if __name__ == "__main__":
    main()
