"""Draws of blocks put together: one posterior of the whole scene."""

import dataclasses
from typing import Any

import jax
import numpy as np

from boomdp_jax.core.arrays import Key, on_device
from boomdp_jax.core.random_numbers import host_generator
from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.blocks.model_sites import coordinate_names
from boomdp_jax.inference.doubts.evidence_report import BlockResult, report_evidence
from boomdp_jax.inference.doubts.residual_report import report_residuals
from boomdp_jax.inference.hypotheses.body_numbers import (
    UNASKED,
    get_number,
    with_numbers,
)
from boomdp_jax.inference.hypotheses.decode import decode
from boomdp_jax.inference.hypotheses.layout import BODY_NUMBERS
from boomdp_jax.inference.hypotheses.noise_level import prior_noise
from boomdp_jax.inference.hypotheses.slot_names import slot_names
from boomdp_jax.inference.posteriors.contact_numbers import with_contact_numbers
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.physics.constraint_spec import JOINTS, KINDS
from boomdp_jax.physics.params import WORLD, Params, empty_params
from boomdp_jax.physics.scene_spec import SceneSpec
from boomdp_jax.physics.turns import note_of_parts

NUM_PRIOR_DRAWS = 4096
"""Prior draws that a posterior carries, to judge what was identified."""


def assemble_posterior(
    key: Key,
    spec: SceneSpec,
    results: list[BlockResult],
    *,
    seconds: dict,
    notes: list[str],
    method: str,
) -> Posterior:
    """Put the draws of independent blocks side by side.

    Args:
        key: random key, for prior draws.
        spec: the scene.
        results: its blocks, each with as many draws.
        seconds: wall time.
        notes: what the user should know.
        method: how the draws were made.

    Returns:
        The posterior of the whole scene. Its `spec` has as many substeps as the
        likelihoods had where these were more, so that what it predicts moves as they
        took it to move.
    """
    spec, more = _as_stepped(spec, results)
    notes = [*notes, *more]
    num_chains = max((len(r.draws.chain_index) for r in results), default=1)
    posterior_parts, prior_parts, noise_parts, prior_noise_parts = [], [], [], []
    impulse_parts, prior_impulse_parts = [], []
    for number, result in enumerate(results):
        block, draws, place, _ = result
        target = block.target
        active = np.asarray(target.structures)[np.asarray(draws.structure[place])]
        likelihood: Any = target.log_likelihood
        coordinates = likelihood.coordinates
        posterior_parts.append(decode(coordinates, np.asarray(draws.z[place]), active))
        rng = host_generator(jax.random.fold_in(key, number))
        z = _prior_coordinates(rng, target)
        every = np.ones((NUM_PRIOR_DRAWS, target.structures.shape[1]), bool)
        prior_parts.append(decode(coordinates, z, every))
        noise_parts.append(draws.noise_scale[place])
        impulse_parts.append(
            None if draws.impulse_scale is None else draws.impulse_scale[place]
        )
        shape = (NUM_PRIOR_DRAWS, len(block.bodies))
        scale = np.asarray(coordinates.scales.noise, float)
        reading, impulse = prior_noise(rng, scale, shape)
        prior_noise_parts.append(reading)
        prior_impulse_parts.append(impulse)
    blocks = [r.block for r in results]
    params, inferred = merge_params(spec, blocks, posterior_parts)
    prior_params, _ = merge_params(spec, blocks, prior_parts)
    rng = host_generator(jax.random.fold_in(key, len(results)))
    params = with_contact_numbers(rng, spec, blocks, posterior_parts, params)
    prior_params = with_contact_numbers(rng, spec, blocks, prior_parts, prior_params)
    num_draws = params.density.shape[0]
    has_impulses = all(part is not None for part in impulse_parts)
    chain = results[0].draws.chain_index if results else np.arange(num_chains)
    return Posterior(
        params=params,
        noise_scale=_merge_noise(spec, blocks, noise_parts, num_draws, 4),
        log_weight=on_device(np.full(num_draws, -np.log(num_draws))),
        log_density=on_device(
            sum(
                (np.asarray(r.draws.log_density[r.place]) for r in results),
                start=np.zeros(num_draws),
            )
        ),
        chain=on_device(chain.repeat(num_draws // len(chain)), int),
        prior_params=prior_params,
        prior_noise_scale=_merge_noise(
            spec, blocks, prior_noise_parts, prior_params.density.shape[0], 4
        ),
        inferred=inferred,
        spec=spec,
        log_evidence=sum((float(r.draws.log_evidence[r.place]) for r in results), 0.0),
        diagnostics=_diagnostics(spec, results, notes, method)
        | report_evidence(spec, results),
        impulse_scale=_merge_noise(spec, blocks, impulse_parts, num_draws, 2)
        if has_impulses
        else None,
        prior_impulse_scale=_merge_noise(
            spec, blocks, prior_impulse_parts, prior_params.density.shape[0], 2
        )
        if has_impulses
        else None,
        seconds=seconds,
    )


def _as_stepped(
    spec: SceneSpec, results: list[BlockResult]
) -> tuple[SceneSpec, list[str]]:
    """The scene with steps cut as the likelihoods cut them, and a note where they did.

    Args:
        spec: the scene.
        results: its blocks.
    """
    num_parts = spec.scene.num_substeps
    for result in results:
        likelihood: Any = result.block.target.log_likelihood
        num_parts = max(num_parts, likelihood.coordinates.scene.num_substeps)
    if spec.substeps is not None or num_parts == spec.scene.num_substeps:
        return spec, []
    note = f"{note_of_parts(num_parts)}; predictions are made so too"
    return dataclasses.replace(spec, substeps=num_parts), [note]


def _prior_coordinates(rng: np.random.Generator, target) -> np.ndarray:
    period = np.asarray(target.period)
    shape = (NUM_PRIOR_DRAWS, target.dim)
    angle = period * (rng.random(shape) - 0.5)
    z = np.where(period > 0, angle, rng.standard_normal(shape))
    return z.astype(target.log_prior.dtype)


def merge_params(
    spec: SceneSpec, blocks: list[Block], parts: list[Params]
) -> tuple[Params, dict[str, np.ndarray]]:
    """Params of the scene from those of its blocks, and which slots are inferred.

    Args:
        spec: the scene.
        blocks: its independent blocks.
        parts: Φ of each, all with the same leading axis `draw`.

    Returns:
        Φ of the scene, leading axis `draw`; by kind, a mask of its inferred slots.
    """
    num_draws = parts[0].density.shape[0] if parts else 1
    num_joints = {
        kind: sum(block.layout.count(kind) for block in blocks) for kind in JOINTS
    }
    num_each = {
        kind: max((block.layout.count(kind) for block in blocks), default=0)
        for kind in ("wheel", "ground")
    }
    whole = empty_params(
        spec.num_bodies,
        num_revolute=num_joints["revolute"],
        num_distance=num_joints["distance"],
        num_wheel=num_each["wheel"],
        num_ground=num_each["ground"],
        num_prismatic=num_joints["prismatic"],
        num_weld=num_joints["weld"],
    )
    arrays = jax.tree.map(
        lambda leaf: np.broadcast_to(np.asarray(leaf), (num_draws, *leaf.shape)).copy(),
        whole,
    )
    fields: dict[str, dict[str, np.ndarray]] = {
        # Ranges and motors, which inference does not know, are None.
        kind: {k: v for k, v in vars(getattr(arrays, kind)).items() if v is not None}
        for kind in KINDS
        if getattr(arrays, kind) is not None
    }
    shape = (num_draws, spec.num_bodies)
    fields["wheel"]["half_track"] = np.zeros((*shape, num_each["wheel"]))
    fields["ground"]["torque_share"] = np.zeros((*shape, num_each["ground"]))
    fields["ground"]["load_shift"] = np.zeros((*shape, num_each["ground"], 2))
    fields["ground"]["stance_scale"] = np.zeros((*shape, num_each["ground"], 2))
    for name in ("corner_share", "diagonal_share"):
        fields["ground"][name] = np.zeros((*shape, num_each["ground"]))
    inferred = {
        kind: np.zeros(fields[kind]["active"].shape[1:], bool) for kind in fields
    }
    density = np.array(arrays.density)
    first = {kind: 0 for kind in JOINTS if kind in fields}
    for block, part in zip(blocks, parts, strict=True):
        index = np.asarray(block.bodies)
        density[:, index] = np.asarray(part.density)
        to_scene = np.append(index, WORLD)
        for kind in fields:
            group = getattr(part, kind)
            if group is None:
                continue
            block_fields = vars(group)
            count = block.layout.count(kind)
            for name, values in block_fields.items():
                if name not in fields[kind]:
                    continue
                values = np.asarray(values)
                if kind in first:
                    rows = slice(first[kind], first[kind] + count)
                    if name in ("body_a", "body_b"):
                        values = to_scene[values]
                    fields[kind][name][:, rows] = values
                else:
                    fields[kind][name][:, index, :count] = values
        for slot in block.layout.slots:
            if slot.kind in first:
                inferred[slot.kind][first[slot.kind] + slot.index] = True
            else:
                inferred[slot.kind][index[slot.body_a], slot.index] = True
        for kind in first:
            first[kind] += block.layout.count(kind)
    dtype = whole.density.dtype

    def build(kind: str) -> Any:
        kwargs = {
            name: on_device(
                value,
                dtype if np.issubdtype(value.dtype, np.floating) else value.dtype,
            )
            for name, value in fields[kind].items()
        }
        return type(getattr(whole, kind))(**kwargs)

    params = Params(
        density=on_device(density, dtype),
        **{kind: build(kind) for kind in fields},
    )
    params = with_numbers(params, _merge_numbers(blocks, parts, shape))
    return params, inferred


def _merge_numbers(
    blocks: list[Block], parts: list[Params], shape: tuple[int, int]
) -> dict[str, Any]:
    """Numbers of the scene's bodies, those that a block infers."""
    numbers = {}
    for name, count in BODY_NUMBERS.items():
        whole = np.full((*shape, count) if count > 1 else shape, UNASKED[name])
        found = [get_number(part, name) for part in parts]
        for block, values in zip(blocks, found, strict=True):
            if values is not None:
                whole[:, np.asarray(block.bodies)] = np.asarray(values)
                numbers[name] = whole
    return {name: on_device(whole) for name, whole in numbers.items()}


def _merge_noise(
    spec: SceneSpec, blocks: list[Block], parts: list, num_draws: int, num: int
):
    """Noise of all bodies, `num` of each; one where a body is in no block."""
    out = np.ones((num_draws, spec.num_bodies, num))
    for block, part in zip(blocks, parts, strict=True):
        out[:, np.asarray(block.bodies)] = np.asarray(part)
    return on_device(out)


def _diagnostics(
    spec: SceneSpec, results: list[BlockResult], notes: list[str], method: str
) -> dict:
    """Verdict over all blocks, with the worst of every number."""
    reasons, r_hat, sizes, jumps = [], [], [], []
    residual, doubts, further = report_residuals(spec, results)
    for block, draws, place, _ in results:
        names = "+".join(spec.names[i] for i in block.bodies)
        verdict = draws.diagnostics[place]
        named = _named(spec, block, verdict.reasons)
        reasons += [f"{names}: {reason}" for reason in named]
        r_hat += list(verdict.r_hat.values())
        sizes += list(verdict.effective_sample_size.values())
        if "jump" in verdict.acceptance:
            jumps.append(verdict.acceptance["jump"])
    reasons += doubts
    return {
        "ok": not reasons,
        "reasons": reasons,
        "notes": [*notes, *further],
        "method": method,
        # Of NumPy, for which NaN, not judged, is the worst.
        "r_hat": float(np.max(r_hat)) if r_hat else None,
        "effective_sample_size": float(np.min(sizes)) if sizes else None,
        "jump_acceptance": min(jumps, default=None),
        "residual": residual,
    }


def _named(spec: SceneSpec, block: Block, reasons: list[str]) -> list[str]:
    """Reasons with names of numbers and constraints in place of where they are kept."""
    names = tuple(spec.names[i] for i in block.bodies)
    numbers = coordinate_names(names, block.layout)
    slots = slot_names(names, block.layout)
    kept = {f"z_{i}": name for i, name in enumerate(numbers)}
    # Directions are judged by functions that half a turn does not change.
    kept |= {f"z_{i}_cos": f"cos 2 {name}" for i, name in enumerate(numbers)}
    kept |= {f"z_{i}_sin": f"sin 2 {name}" for i, name in enumerate(numbers)}
    for i, slot in enumerate(block.layout.slots):
        kept[f"slot_{i}"] = f"whether {slots[slot]} exists"
    found = []
    for reason in reasons:
        head, colon, rest = reason.partition(":")
        found.append(f"{kept.get(head, head)}{colon}{rest}")
    return found
