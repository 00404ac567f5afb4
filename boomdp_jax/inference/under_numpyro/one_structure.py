"""Posteriors of the numbers of one structure, whatever samples them.

The structure is given, or the most probable one by fits and importance sampling. Each
block of bodies is a NumPyro model of its own; a sampler draws from it.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.history import History
from boomdp_jax.inference.assemble import assemble_posterior
from boomdp_jax.inference.blocks.block import Block, make_block
from boomdp_jax.inference.blocks.fixed_structure import (
    Structure,
    scene_layout,
    structure_blocks,
    structure_of_slots,
)
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.posteriors.posterior import Posterior, with_diagnostics
from boomdp_jax.inference.readings.components import independent_blocks
from boomdp_jax.inference.readings.touching import find_touching
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.inference.samplers.chain_diagnostics import ChainDiagnostics
from boomdp_jax.inference.samplers.fitted_mixture import fitted_mixture
from boomdp_jax.inference.under_numpyro.numpyro_model import model_of_blocks
from boomdp_jax.physics.params import WORLD
from boomdp_jax.physics.scene_spec import SceneSpec

# Probability below which the chosen structure does not stand for the posterior.
_SURE = 0.95


class ModelDraws(NamedTuple):
    """Draws from the model of one block, leading axes chain and draw."""

    z: Float[Array, "chain draw dim"]
    noise_scale: Float[Array, "chain draw body 4"]
    log_density: Float[Array, "chain draw"]
    """Of coordinates and log noise scales, as the sampler sees them."""
    diagnostics: ChainDiagnostics
    log_evidence: float
    """NaN where the sampler gives none."""
    extras: dict[str, float]
    """Further numbers for the posterior's diagnostics; summed over blocks."""


def infer_numbers(
    key: Key,
    spec: SceneSpec,
    history: History,
    sampler: Callable[..., ModelDraws],
    *,
    method: str,
    structure: Structure | Bool[np.ndarray, " slot"] | None = None,
    progress_bar: bool = False,
) -> Posterior:
    """Posterior over the numbers of one structure, noise scales included.

    Args:
        key: random key.
        spec: the scene: outlines, what is known, what may exist.
        history: recorded transitions. An empty one gives the prior.
        sampler: of key, model of one block and a function that is told of stages.
        method: its name, for messages.
        structure: constraints that exist besides the known ones, as in `make_model`;
            default: the most probable ones.
        progress_bar: show stages on standard error.

    Returns:
        Draws of all chains, all with this structure.

    Raises:
        ValueError: a structure that the scene does not allow, or a history of another
            number of bodies.
    """
    if history.num_bodies != spec.num_bodies:
        raise ValueError(
            f"{spec.source}: history: expected {spec.num_bodies} bodies, got "
            f"{history.num_bodies}"
        )
    start = time.perf_counter()
    choice_key, run_key, assemble_key = jax.random.split(key, 3)
    with _Stages(progress_bar, method) as stages:
        notes: list[str] = []
        doubts: list[str] = []
        if structure is None and scene_layout(spec).slots:
            stages.show("choosing a structure")
            structure, notes, doubts = _most_probable(choice_key, spec, history, method)
        blocks = structure_blocks(spec, history, structure)
        drawn = []
        for number, block in enumerate(blocks):
            names = "+".join(spec.names[i] for i in block.bodies)
            draws = sampler(
                jax.random.fold_in(run_key, number),
                model_of_blocks([_renumbered(block)], _generic_names(block)),
                report=lambda stage, names=names: stages.show(f"{names}: {stage}"),
            )
            drawn.append(draws)
    posterior = assemble_posterior(
        assemble_key,
        spec,
        [
            BlockResult(block, _block_draws(spec, block, draws), 0)
            for block, draws in zip(blocks, drawn, strict=True)
        ],
        seconds={"compile": None, "run": time.perf_counter() - start},
        notes=notes,
        method=method,
    )
    extras: dict[str, float] = {}
    for draws in drawn:
        for name, value in draws.extras.items():
            extras[name] = extras.get(name, 0) + value
    return with_diagnostics(posterior, doubts, extras)


def check_numbers(
    spec: SceneSpec,
    history: History,
    structure: Structure | Bool[np.ndarray, " slot"] | None = None,
) -> None:
    """Raise as `infer_numbers` would, before anything is fitted.

    Raises:
        ValueError: a scene or structure of which numbers cannot be inferred.
    """
    if structure is not None or not scene_layout(spec).slots:
        structure_blocks(spec, history, structure)
        return
    touching = find_touching(spec, history)
    for bodies in independent_blocks(spec, history, touching)[0]:
        make_block(spec, bodies, history, touching=touching)


def _most_probable(
    key: Key, spec: SceneSpec, history: History, method: str
) -> tuple[dict[str, list], list[str], list[str]]:
    """The most probable structure of every block, notes, and reasons for doubt."""
    touching = find_touching(spec, history)
    blocks, notes = independent_blocks(spec, history, touching)
    notes = list(notes)
    structure: dict[str, list] = {}
    doubts = []
    for number, bodies in enumerate(blocks):
        block = make_block(spec, bodies, history, touching=touching)
        fitted = fitted_mixture(jax.random.fold_in(key, number), block.target)
        evidence = fitted.evidence
        best = int(jnp.argmax(evidence.probability))
        probability = float(evidence.probability[best])
        active = np.asarray(block.target.structures[best])
        slots = [
            slot._replace(
                body_a=bodies[slot.body_a],
                body_b=WORLD if slot.body_b == WORLD else bodies[slot.body_b],
            )
            for slot, is_active in zip(block.layout.slots, active, strict=True)
            if is_active
        ]
        found = structure_of_slots(spec, slots)
        for name, entries in found.items():
            structure.setdefault(name, []).extend(entries)
        names = "+".join(spec.names[i] for i in bodies)
        text = f"{names}: structure {found}, of probability {probability:.2f}"
        notes.append(f"{text}, chosen for {method.upper()}")
        if not probability >= _SURE:
            doubts.append(
                f"{text}: {method.upper()} leaves the others out; use method rj"
            )
    return structure, notes, doubts


def _generic_names(block: Block) -> tuple[str, ...]:
    return tuple(f"body_{i}" for i in range(len(block.bodies)))


def _renumbered(block: Block) -> Block:
    """The block by itself, so that equal blocks share a compiled program."""
    return block._replace(bodies=tuple(range(len(block.bodies))))


def _block_draws(spec: SceneSpec, block: Block, draws: ModelDraws) -> BlockDraws:
    """Draws in the form of all samplers, chains one after the other."""
    num_chains, num_samples = draws.log_density.shape
    num_draws = num_chains * num_samples

    def flat(leaf):
        return np.asarray(leaf).reshape(1, num_draws, *leaf.shape[2:])

    verdict = draws.diagnostics
    named = [_named(spec, block, reason) for reason in verdict.reasons]
    return BlockDraws(
        structure=np.zeros((1, num_draws), np.int32),
        z=flat(draws.z),
        log_density=flat(draws.log_density),
        noise_scale=flat(draws.noise_scale),
        impulse_scale=None,
        log_evidence=np.full(1, draws.log_evidence),
        evidence=None,
        diagnostics=[verdict._replace(reasons=named)],
        chain_index=np.arange(num_chains),
    )


def _named(spec: SceneSpec, block: Block, text: str) -> str:
    """Put the bodies' names back."""
    for generic, body in zip(_generic_names(block), block.bodies, strict=True):
        text = text.replace(f"{generic}.", f"{spec.names[body]}.")
        text = text.replace(f"_to_{generic}", f"_to_{spec.names[body]}")
    return text


class _Stages:
    """Stages on standard error; nothing unless asked for."""

    def __init__(self, is_shown: bool, desc: str):
        self._bar = None
        if is_shown:
            from tqdm import tqdm

            self._bar = tqdm(desc=desc, bar_format="{desc} {elapsed} {postfix}")

    def show(self, stage: str) -> None:
        """Say what is being done."""
        if self._bar is not None:
            self._bar.set_postfix_str(stage)

    def __enter__(self) -> "_Stages":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
