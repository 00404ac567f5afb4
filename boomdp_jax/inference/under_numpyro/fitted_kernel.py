"""The jump sampler of one scene as a NumPyro kernel, from what a user has."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from boomdp_jax.core.arrays import Key
from boomdp_jax.core.history import History
from boomdp_jax.inference.arguments import check_history, check_spec
from boomdp_jax.inference.blocks.block import Block, make_block
from boomdp_jax.inference.hypotheses.slot_names import (
    known_numbers,
    physical_numbers,
    slot_names,
)
from boomdp_jax.inference.readings.components import independent_blocks
from boomdp_jax.inference.readings.touching import Touching, find_touching
from boomdp_jax.inference.samplers.fitted_mixture import fitted_mixture
from boomdp_jax.inference.samplers.structure_chain import ChainSettings
from boomdp_jax.inference.samplers.structure_kernel import StructureKernel
from boomdp_jax.physics.scene_spec import SceneSpec


def structure_kernel(
    key: Key,
    spec: SceneSpec,
    history: History,
    *,
    bodies: Sequence[str] | None = None,
    settings: ChainSettings | None = None,
) -> StructureKernel:
    """Fit a scene and set up reversible jumps between its structures.

        kernel = structure_kernel(key, spec, history)
        mcmc = MCMC(kernel, num_warmup=200, num_samples=500, num_chains=4,
                    chain_method="vectorized")
        mcmc.run(key)
        mcmc.print_summary()

    `get_samples()` has the number `structure` (a row of `kernel.target.structures`),
    and by name whether each constraint exists, `table.revolute`, whose mean is its
    probability, and every physical number, `table.mass` [kg],
    `table.revolute.anchor_a` [m], zero where the constraint does not exist. Noise is
    integrated out. Coordinates come with `extra_fields=("chain.point.z",)`. Prefer
    `infer` for whole scenes: it draws all jumps ahead, in batches.

    Args:
        key: random key, for the fit.
        spec: the scene: outlines, what is known, what may exist.
        history: recorded transitions.
        bodies: names of bodies that may interact with each other and no others. May be
            left out where all bodies that can move form one such block.
        settings: how often to make each move.

    Returns:
        The kernel, for `numpyro.infer.MCMC`.

    Raises:
        TypeError: a scene or history that is none.
        ValueError: several independent blocks and no `bodies`, or `bodies` that are
            not one of the blocks; the message lists them. A history of another number
            of bodies, or no body that can move.
    """
    check_spec(spec)
    check_history(spec, history)
    touching = find_touching(spec, history)
    chosen = _choose_block(spec, history, touching, bodies)
    block = make_block(spec, chosen, history, touching=touching)
    names = tuple(spec.names[i] for i in block.bodies)
    fitted = fitted_mixture(key, block.target)
    block = block._replace(target=fitted.target)
    return StructureKernel(
        fitted.target,
        fitted.mixture,
        settings,
        postprocess=NamedNumbers(block, names),
    )


class NamedNumbers(eqx.Module):
    """From a sample of structure and coordinates to physical numbers by name."""

    block: Block
    names: tuple[str, ...] = eqx.field(static=True)
    """Of the block's bodies."""

    def __call__(self, sample: dict[str, Array]) -> dict[str, Array]:
        """Name the numbers of one sample.

        Args:
            sample: `structure` and `z`.

        Returns:
            `structure`, indicators of inferred constraints, physical numbers.
        """
        layout, target = self.block.layout, self.block.target
        likelihood: Any = target.log_likelihood
        coordinates = likelihood.coordinates
        active = target.structures[sample["structure"]]
        params = coordinates(sample["z"], active)
        names = slot_names(self.names, layout)
        indicators = {
            names[slot]: active[place].astype(jnp.int32)
            for place, slot in enumerate(layout.slots)
        }
        numbers = physical_numbers(self.names, layout, params, coordinates.scene.area)
        around = coordinates.surroundings
        given = known_numbers(self.names, layout, around.known, around.density)
        kept = {name: value for name, value in numbers.items() if name not in given}
        contact = coordinates.contact_numbers(sample["z"])
        kept |= {f"contact.{name}": value for name, value in contact.items()}
        return {"structure": sample["structure"], **indicators, **kept}


def _choose_block(
    spec: SceneSpec,
    history: History,
    touching: Touching | None,
    bodies: Sequence[str] | None,
) -> tuple[int, ...]:
    """The block of bodies that was meant."""
    blocks, _ = independent_blocks(spec, history, touching)
    if not blocks:
        raise ValueError(f"{spec.source}: expected a body that can move, got none")
    lists = "; ".join(str([spec.names[i] for i in block]) for block in blocks)
    if bodies is None:
        if len(blocks) > 1:
            raise ValueError(
                f"{spec.source}: bodies: expected one of the blocks that do not "
                f"interact, {lists}; got none"
            )
        return blocks[0]
    if isinstance(bodies, str):
        bodies = [bodies]
    chosen = tuple(sorted(spec.index(name) for name in bodies))
    if chosen not in blocks:
        raise ValueError(
            f"{spec.source}: bodies: expected one of the blocks that do not interact, "
            f"{lists}; got {list(bodies)}"
        )
    return chosen
