"""How many body-steps a second the engine takes, and what a gradient costs.

One body with a pin and a wheel, every hypothesis different, in single precision,
through the public `rollout` on a scene read by `load_scene`. The compiled call returns
every state and report, so that nothing is optimised away; a gradient is that of the sum
of their means, and is compared with a forward run that ends in the same sum.
The answer is checked first: the worst of many hypotheses against its own differential
equation, integrated by SciPy. Compile and run time are reported apart; a run is the
fastest of several, with the median and the slowest beside it.

Peer: MuJoCo in C, the same body held by an equality joint on planar joints, stepped by
`mujoco.rollout` on all cores (without the wheel, which MuJoCo does not have).
"""

import json
import os
import statistics
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from _report import Reporter, parser_of
from _timing import measure
from scipy.integrate import solve_ivp

from boomdp_jax.physics import Params, State, rollout
from boomdp_jax.physics.scene_file import load_scene

DT, NUM_STEPS = 0.02, 100
BATCHES = sorted([*(2**power for power in range(0, 17, 2)), 1000, 4000])
"""Powers of two, and two others: arrays whose lengths are multiples of 4 kB compete for
the same lines of a level-1 cache."""
QUICK_BATCHES = [1, 64, 1024, 4096]
# What is asked of batch 4096 on two cores, and of a gradient beside its forward run.
TARGET_BATCH, TARGET_RATE, TARGET_RATIO = 4096, 5e7, 4.0
# Largest error of a heading after the whole rollout [rad]: what steps of 20 ms in
# two substeps allow, on hypotheses whose wheel switches between sticking and slipping.
TOLERANCE = 5e-3

SCENE = {
    "schema": "planar-scene-1",
    "gravity": [0.0, 0.0],
    "normal_gravity": 9.81,
    "dt": DT,
    "bodies": [
        {
            "name": "table",
            "pose": [0.0, 0.0, 0.0],
            "shape": {"type": "box", "half_extents": [0.3, 0.1]},
            "density": 20.0,
        }
    ],
    "constraints": [
        {
            "type": "revolute",
            "a": "table",
            "b": "world",
            "anchor_a": [0.1, 0.0],
            "anchor_b": [0.1, 0.0],
            "viscous": 0.1,
            "dry": 1.0,
        },
        {
            "type": "wheel",
            "a": "table",
            "pose": [0.2, 0.0, 0.0],
            "viscous": [1.0, 30.0],
            "dry": [2.0, 10.0],
        },
    ],
}


def read_scene():
    """The scene and its one hypothesis, by way of a file as a user has it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.json"
        path.write_text(json.dumps(SCENE), encoding="utf-8")
        spec = load_scene(path)
        return spec.scene, spec.params()


def draw(key, params: Params) -> tuple[Params, State, jax.Array]:
    """A random hypothesis with every slot active, a state on its pin, and wrenches."""
    keys = iter(jax.random.split(key, 12))

    def scaled(value):
        return value * jnp.exp(0.5 * jax.random.normal(next(keys), value.shape))

    anchor = jax.random.uniform(next(keys), (1, 2), minval=-0.3, maxval=0.3)
    theta = jax.random.uniform(next(keys), minval=-3.0, maxval=3.0)
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    arm = -jnp.array([[cos, -sin], [sin, cos]]) @ anchor[0]
    spin = jax.random.normal(next(keys))
    centre = params.revolute.anchor_b[0] + arm
    pose = jnp.stack([centre[0], centre[1], theta])
    twist = jnp.stack([-spin * arm[1], spin * arm[0], spin])
    revolute, wheel = params.revolute, params.wheel
    revolute = replaced(
        revolute,
        anchor_a=anchor,
        viscous=scaled(revolute.viscous),
        dry=scaled(revolute.dry),
    )
    position = jax.random.uniform(
        next(keys), wheel.position.shape, minval=-0.3, maxval=0.3
    )
    heading = jax.random.uniform(next(keys), wheel.heading.shape, maxval=6.28)
    wheel = replaced(
        wheel,
        position=position,
        heading=heading,
        viscous=scaled(wheel.viscous),
        dry=scaled(wheel.dry),
    )
    density = scaled(params.density)
    changed = replaced(params, density=density, revolute=revolute, wheel=wheel)
    wrench = jax.random.normal(next(keys), (1, 3)) * jnp.array([[3.0, 3.0, 1.0]])
    wrenches = jnp.tile(wrench, (NUM_STEPS, 1, 1))
    return changed, State(pose[None], twist[None]), wrenches


def replaced(module, **changes):
    """A copy of a module with some fields changed."""
    return type(module)(**{**vars(module), **changes})


def expected_heading(scene, params, state, wrench) -> float:
    """Heading at the end, from I theta'' = torque about the pin - friction."""
    mass = float(params.density[0] * scene.area[0])
    anchor = np.asarray(params.revolute.anchor_a[0], float)
    inertia = mass * (float(scene.gyration[0]) + anchor @ anchor)
    lever = np.asarray(params.wheel.position[0, 0], float) - anchor
    heading = float(params.wheel.heading[0, 0])
    across = np.array([-lever[1], lever[0]])
    axes = np.array(
        [[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]]
    )
    direction = axes @ across
    viscous = np.asarray(params.wheel.viscous[0, 0], float)
    dry = np.asarray(params.wheel.dry[0, 0], float)
    joint_viscous = float(params.revolute.viscous[0])
    joint_dry = float(params.revolute.dry[0])
    force, torque = np.asarray(wrench[:2], float), float(wrench[2])

    def rate(_, y):
        theta, spin = y
        pull = viscous * direction * spin
        pull = pull / max(1.0, np.linalg.norm(pull / dry))
        friction = direction @ pull
        friction += np.clip(joint_viscous * spin, -joint_dry, joint_dry)
        cos, sin = np.cos(theta), np.sin(theta)
        right = cos * anchor[0] - sin * anchor[1]
        up = sin * anchor[0] + cos * anchor[1]
        arm = np.array([-right, -up])
        push = torque + arm[0] * force[1] - arm[1] * force[0]
        return [spin, (push - friction) / inertia]

    start = [float(state.pose[0, 2]), float(state.twist[0, 2])]
    solution = solve_ivp(
        rate, (0.0, NUM_STEPS * DT), start, method="LSODA", rtol=1e-8, atol=1e-10
    )
    return float(solution.y[0, -1])


def check(reporter: Reporter, scene, params: Params, num_cases: int) -> bool:
    """Compare random hypotheses with their differential equation."""
    cases = jax.vmap(draw, in_axes=(0, None))(
        jax.random.split(jax.random.key(1), num_cases), params
    )
    states, info = jax.jit(jax.vmap(lambda p, s, w: rollout(scene, p, s, w)))(*cases)
    errors = []
    for i in range(num_cases):
        case_params, state, wrenches = jax.tree.map(lambda leaf, i=i: leaf[i], cases)
        end = expected_heading(scene, case_params, state, wrenches[0, 0])
        errors.append(abs(float(states.pose[i, -1, 0, 2]) - end))
    worst = max(errors)
    is_right = worst < TOLERANCE and bool(jnp.all(info.is_finite))
    reporter.report(
        case="pin and wheel, 20 ms, 100 steps",
        metric="largest error of the heading against SciPy",
        value=worst,
        unit="rad",
        n=num_cases,
        target=TOLERANCE,
        met=is_right,
    )
    drift = float(jnp.max(info.constraint_error))
    reporter.report(
        case="pin and wheel, 20 ms, 100 steps",
        metric="largest joint drift",
        value=1e3 * drift,
        unit="mm",
        n=num_cases,
        target=0.1,
        met=drift < 1e-4,
    )
    return is_right


def forward(scene, params, state, wrenches):
    """Every output of every hypothesis."""
    return jax.vmap(lambda p, s, w: rollout(scene, p, s, w))(params, state, wrenches)


def checksum(scene, params, state, wrenches):
    """The same in one number."""
    outputs = jax.tree.leaves(forward(scene, params, state, wrenches))
    return sum(jnp.mean(leaf.astype(jnp.float32)) for leaf in outputs)


MUJOCO_MODEL = f"""
<mujoco>
  <option timestep="{DT}" gravity="0 0 0" integrator="implicitfast">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="table">
      <joint type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 1 0"/>
      <joint type="hinge" axis="0 0 1"/>
      <inertial pos="0 0 0" mass="2.4" diaginertia="1 1 0.08"/>
    </body>
  </worldbody>
  <equality><connect body1="table" anchor="0.1 0 0"/></equality>
</mujoco>
"""


def mujoco_rate(batch: int, num_runs: int) -> float:
    """Body-steps a second of MuJoCo, best of several runs."""
    model = mujoco.MjModel.from_xml_string(MUJOCO_MODEL)
    workers = [mujoco.MjData(model) for _ in range(os.cpu_count() or 1)]
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.zeros((batch, size))
    start[:, 1 + model.nq + 2] = np.linspace(0.1, 1.0, batch)
    seconds = []
    for _ in range(num_runs):
        begin = time.perf_counter()
        mujoco.rollout.rollout(model, workers, start, nstep=NUM_STEPS)
        seconds.append(time.perf_counter() - begin)
    return batch * NUM_STEPS / min(seconds)


def time_forward(reporter, scene, params, batches, num_runs) -> None:
    """Forward rollouts at every batch size."""
    sizes = {min(batch, 4096) for batch in batches}
    peers = {batch: mujoco_rate(batch, num_runs) for batch in sizes}
    largest = peers[max(peers)]
    for batch in batches:
        keys = jax.random.split(jax.random.key(0), batch)
        arguments = jax.jit(jax.vmap(draw, in_axes=(0, None)))(keys, params)
        compile_seconds, runs = measure(forward, (scene, *arguments), num_runs)
        case = f"pin and wheel, float32, batch {batch}"
        work = batch * NUM_STEPS
        is_asked = batch == TARGET_BATCH
        reporter.report(
            case=case,
            metric="forward, fastest run",
            value=work / min(runs),
            unit="body-steps/s",
            n=num_runs,
            spread=[work / max(runs), work / statistics.median(runs)],
            peer="MuJoCo C, mujoco.rollout",
            peer_value=peers.get(batch, largest),
            target=TARGET_RATE if is_asked else None,
            met=work / statistics.median(runs) >= TARGET_RATE if is_asked else None,
        )
        reporter.report(case=case, metric="compile", value=compile_seconds, unit="s")


def time_gradient(reporter, scene, params, batches, num_runs) -> None:
    """Reverse-mode gradient over forward, on the same checksum."""
    for batch in batches:
        keys = jax.random.split(jax.random.key(0), batch)
        drawn, state, wrenches = jax.vmap(draw, in_axes=(0, None))(keys, params)
        leaves, treedef = jax.tree.flatten(drawn)
        is_number = [jnp.issubdtype(leaf.dtype, jnp.floating) for leaf in leaves]
        fixed = [None if n else leaf for n, leaf in zip(is_number, leaves, strict=True)]
        moving = [leaf for n, leaf in zip(is_number, leaves, strict=True) if n]

        def loss(scene, moving, state, wrenches, fixed=fixed, treedef=treedef):
            numbers = iter(moving)
            full = [next(numbers) if leaf is None else leaf for leaf in fixed]
            return checksum(scene, jax.tree.unflatten(treedef, full), state, wrenches)

        arguments = (scene, moving, state, wrenches)
        _, ahead = measure(loss, arguments, num_runs)
        compile_seconds, backward = measure(
            jax.value_and_grad(loss, argnums=(1, 2, 3)), arguments, num_runs
        )
        case = f"pin and wheel, float32, batch {batch}, 100 steps"
        ratio = statistics.median(backward) / statistics.median(ahead)
        reporter.report(
            case=case,
            metric="value and gradient over value, fastest runs",
            value=min(backward) / min(ahead),
            unit="times",
            n=num_runs,
            spread=[ratio],
            target=TARGET_RATIO,
            met=ratio <= TARGET_RATIO,
        )
        reporter.report(
            case=case, metric="compile of the gradient", value=compile_seconds, unit="s"
        )


def main() -> int:
    """Check the answer, then time it."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--batches", nargs="+", type=int, help="of rollout and gradient"
    )
    arguments = parser.parse_args()
    reporter = Reporter(arguments.out)
    scene, params = read_scene()
    is_right = check(reporter, scene, params, 8 if arguments.quick else 64)
    num_runs = 5 if arguments.quick else 11
    batches = QUICK_BATCHES if arguments.quick else BATCHES
    time_forward(reporter, scene, params, arguments.batches or batches, num_runs)
    batches = [64, 4096] if arguments.quick else [1, 64, 1000, 4096, 16384]
    time_gradient(reporter, scene, params, arguments.batches or batches, num_runs)
    reporter.print_table()
    return 0 if is_right else 1


if __name__ == "__main__":
    raise SystemExit(main())
