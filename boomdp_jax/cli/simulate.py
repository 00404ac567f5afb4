"""`simulate`: from a scene and wrenches to a recording, noisy if asked."""

import argparse
import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from boomdp_jax.cli.output import check_writable, print_notes, versions
from boomdp_jax.core.action_file import ActionTable, load_actions
from boomdp_jax.core.applied_force import wrench_at_reference
from boomdp_jax.core.arrays import Key
from boomdp_jax.core.history_file import save_transitions
from boomdp_jax.physics.params import Params
from boomdp_jax.physics.same_bodies import check_same_bodies
from boomdp_jax.physics.scene import Scene
from boomdp_jax.physics.scene_arrays import build_surface
from boomdp_jax.physics.scene_file import load_scene
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.start_gaps import start_gaps
from boomdp_jax.physics.state import State, state_from_array
from boomdp_jax.physics.turns import note_of_parts, parts_for_turns

_NUM_CHANNELS = np.array([2, 1, 2, 1])
"""Channels of a state that share a noise scale: position, angle, velocity, spin."""

_DEFAULTS = {
    "actuator.gain": "1",
    "actuator.bias": "0",
    "actuator.delay": "0 s",
    "center_of_mass": "where the pose is",
}
"""What is simulated of a number that a scene leaves to be inferred."""


def run(arguments: argparse.Namespace) -> None:
    """Simulate in 64 bit, which is what data files hold, and write the recording.

    Args:
        arguments: what `cli.main` parsed.

    Raises:
        ValueError: bad input; nothing has been written then.
    """
    check_writable(arguments.out)
    if arguments.draw is not None and arguments.posterior is None:
        raise ValueError("--draw: expected --posterior beside it, got none")
    with jax.enable_x64(True):
        spec = load_scene(arguments.scene)
        print_notes(spec.notes)
        _check_prior(spec)
        actions = load_actions(arguments.actions, spec)
        params, substeps = _load_params(arguments, spec)
        params = spec.with_surface(params)
        if spec.substeps is None:
            spec = dataclasses.replace(spec, substeps=substeps)
        if actions.initial_state is None:
            start, initial_state = f"{spec.source}: pose", spec.initial_state()
        else:
            start = f"{actions.source}: initial_state"
            initial_state = state_from_array(jnp.asarray(actions.initial_state))
        print_notes(
            [
                f"{start}: {gap}; the first step takes it there"
                for gap in start_gaps(params, initial_state, spec.names)
            ]
        )
        before, after = simulate(spec.scene, params, initial_state, actions)
        if spec.substeps is None:
            num_parts = parts_for_turns(after[..., 2] - before[..., 2])
            if num_parts > spec.scene.num_substeps:
                print_notes([f"{spec.source}: {note_of_parts(num_parts)}"])
                spec = dataclasses.replace(spec, substeps=num_parts)
                before, after = simulate(spec.scene, params, initial_state, actions)
        _check_finite(after, spec, actions)
        if arguments.noise is not None:
            key = jax.random.key(arguments.seed)
            moves = ~spec.is_static
            before, after = read_with_noise(
                key, before, after, actions.is_start, arguments.noise, moves
            )
    origin = {
        "scene": spec.to_dict(),
        "posterior": arguments.posterior,
        "draw": arguments.draw,
        "noise": arguments.noise,
        "seed": arguments.seed,
        "versions": versions(),
    }
    save_transitions(
        arguments.out,
        state=before,
        action=actions.action,
        next_state=after,
        dt=actions.dt,
        episode=actions.episode,
        point=actions.point,
        params=json.dumps(origin),
    )


def simulate(
    scene: Scene, params: Params, initial_state: State, actions: ActionTable
) -> tuple[Float[np.ndarray, "time body 6"], Float[np.ndarray, "time body 6"]]:
    """Apply wrenches row by row; each episode starts from the initial state.

    A force that acts at a point acts there as the body stands when the step begins.
    Where the params have a delay, a force from earlier acts at the point of the row.

    Args:
        scene: the scene.
        params: what is true of it.
        initial_state: where each episode starts.
        actions: what to apply.

    Returns:
        States before and after each row.
    """
    from boomdp_jax.physics import delayed_wrenches, step
    from boomdp_jax.physics.world_rollout import empty_cache

    first = (initial_state, empty_cache(scene))

    def advance(carry, row):
        action, point, dt, is_start = row
        state, cache = jax.tree.map(
            lambda now, start: jnp.where(is_start, start, now), carry, first
        )
        wrench = action
        if point is not None:
            wrench = wrench_at_reference(action, point, state.pose)
        next_state, info = step(scene, params, state, wrench, dt=dt, cache=cache)
        return (next_state, info.cache), (state.array, next_state.array)

    commands = delayed_wrenches(
        params, actions.action, actions.dt, is_start=actions.is_start
    )
    rows = (commands, actions.point, actions.dt, actions.is_start)
    rows = jax.tree.map(jnp.asarray, rows)
    run_rows = jax.jit(lambda rows: jax.lax.scan(advance, first, rows)[1])
    before, after = run_rows(rows)
    return np.asarray(before), np.asarray(after)


def read_with_noise(
    key: Key,
    before: Float[np.ndarray, "time body 6"],
    after: Float[np.ndarray, "time body 6"],
    is_start: np.ndarray,
    scales: list[float],
    moves: np.ndarray,
) -> tuple[Float[np.ndarray, "time body 6"], Float[np.ndarray, "time body 6"]]:
    """Take one noisy reading of each instant.

    What is read after a row is, to the bit, what is read before the next one of its
    episode.

    Args:
        key: randomness.
        before: true states before each row.
        after: true states after each row.
        is_start: which rows begin an episode.
        scales: standard deviation of position [m], angle [rad], velocity [m/s] and
            spin [rad/s].
        moves: which bodies are read with noise.

    Returns:
        Readings before and after each row.
    """
    scale = np.repeat(scales, _NUM_CHANNELS) * moves[:, None]
    start_key, after_key = jax.random.split(key)
    start_noise = np.asarray(jax.random.normal(start_key, before.shape))
    after_noise = np.asarray(jax.random.normal(after_key, after.shape))
    readings_after = after + scale * after_noise
    readings_before = np.where(
        is_start[:, None, None],
        before + scale * start_noise,
        np.roll(readings_after, 1, axis=0),
    )
    return readings_before, readings_after


def _load_params(
    arguments: argparse.Namespace, spec: SceneSpec
) -> tuple[Params, int | None]:
    """From the scene file, or from a draw of a posterior over the same bodies.

    Returns:
        The params, and in how many parts steps were made where they come from.
    """
    if arguments.posterior is None:
        if any(spec.unknown.values()):
            print_notes([f"{spec.source}: unknown constraints are taken to be absent"])
        print_notes(_defaults(spec))
        return spec.params(), spec.substeps
    from boomdp_jax.inference.posteriors.posterior import load_posterior

    posterior = load_posterior(arguments.posterior)
    as_in = f", as in {spec.source}"
    check_same_bodies(posterior.spec, spec, arguments.posterior, as_in)
    draw, num_draws = arguments.draw or 0, posterior.params.density.shape[0]
    if draw >= num_draws:
        raise ValueError(
            f"{arguments.posterior}: --draw: expected less than {num_draws}, got {draw}"
        )
    params = jax.tree.map(lambda leaf: leaf[draw], posterior.params)
    return params, posterior.spec.substeps


def _check_prior(spec: SceneSpec) -> None:
    """Refuse what inference from the recording would, before there is one."""
    if spec.prior:
        from boomdp_jax.inference.hypotheses.prior import read_prior

        read_prior(spec.prior, spec.source)


def _defaults(spec: SceneSpec) -> list[str]:
    """What stands in for numbers of bodies that are to be inferred."""
    taken = [
        f"{spec.source}: unknown.{name} is taken to be {default}"
        for name, default in _DEFAULTS.items()
        if name in spec.unknown_numbers
    ]
    surface = build_surface(spec.bodies)
    if surface is None:
        return taken
    for field in ("friction", "restitution"):
        numbers = np.asarray(getattr(surface, field))
        for body, number in zip(spec.bodies, numbers, strict=True):
            given = getattr(body, field)
            if given is not None and np.isnan(given):
                taken.append(
                    f"{spec.source}: body {body.name!r}: unknown contact.{field} is "
                    f"taken to be {number:g}"
                )
    return taken


def _check_finite(
    after: Float[np.ndarray, "time body 6"], spec: SceneSpec, actions: ActionTable
) -> None:
    if not np.all(np.isfinite(after)):
        row, body, _ = np.argwhere(~np.isfinite(after))[0]
        raise ValueError(
            f"{actions.source}: body {spec.names[body]!r}: expected a motion that "
            f"stays finite, got one that does not from row {row}"
        )
