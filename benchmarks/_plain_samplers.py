"""Samplers that know nothing of modes: the papers' own recipe, and a general SMC.

Both sample the problem as the papers put it (`boomdp_jax.inference.plain_problem`).
"""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from boomdp_jax.core.history import History
from boomdp_jax.inference.assemble import assemble_posterior
from boomdp_jax.inference.blocks.block import Block
from boomdp_jax.inference.doubts.evidence_report import BlockResult
from boomdp_jax.inference.posteriors.posterior import Posterior
from boomdp_jax.inference.samplers.block_draws import BlockDraws
from boomdp_jax.inference.samplers.chain_diagnostics import diagnose_chains
from boomdp_jax.inference.samplers.plain_metropolis import plain_metropolis
from boomdp_jax.inference.samplers.plain_problem import PlainProblem, plain_problem
from boomdp_jax.inference.samplers.structure_chain import ChainDraws
from boomdp_jax.physics.scene_spec import SceneSpec

# Steps of the SMC's random walks, of what is best for a normal density.
_SMC_STEP = 0.3


class PlainResult(NamedTuple):
    """What a sampler gave, and what it took."""

    posterior: Posterior
    num_calls: int
    seconds: dict[str, float]


def metropolis(
    key: jax.Array,
    spec: SceneSpec,
    history: History,
    *,
    num_chains: int = 30,
    num_iterations: int = 20_000,
    num_kept: int = 100,
) -> PlainResult:
    """The papers' sampler; half of the iterations are thrown away."""
    block, problem = plain_problem(spec, history)
    options = {
        "num_chains": num_chains,
        "num_iterations": num_iterations,
        "num_burn_in": num_iterations // 2,
        "thin": max(num_iterations // 2 // num_kept, 1),
    }
    start = time.perf_counter()
    run = plain_metropolis.lower(key, problem, **options).compile()
    middle = time.perf_counter()
    draws = jax.block_until_ready(run(key, problem, **options))
    seconds = {"compile": middle - start, "run": time.perf_counter() - middle}
    num_calls = num_chains * (num_iterations + 1) * problem.calls_each
    posterior = as_posterior(block, problem, spec, draws.x, seconds, "metropolis")
    return PlainResult(posterior, num_calls, seconds)


def blackjax_smc(
    key: jax.Array, spec: SceneSpec, history: History, *, num_particles: int = 2048
) -> PlainResult:
    """BlackJAX's adaptive tempered SMC from the prior, with random-walk moves."""
    import blackjax
    from blackjax.smc import resampling

    block, problem = plain_problem(spec, history)
    num_moves = 10

    walk = blackjax.additive_step_random_walk.build_kernel()

    def move(key, state, log_density, spread):
        def random_step(key, position):
            return jax.random.normal(key, position.shape) * spread

        return walk(key, state, log_density, random_step)

    kernel = blackjax.smc.adaptive_tempered.build_kernel(
        problem.log_prior,
        problem.log_likelihood,
        move,
        blackjax.additive_step_random_walk.init,
        resampling.systematic,
        target_ess=0.5,
    )

    def advance(key, state):
        spread = _SMC_STEP * 2.38 / np.sqrt(problem.size) * jnp.std(state.particles, 0)
        return kernel(key, state, num_moves, {"spread": spread[None] + 1e-6})

    start = time.perf_counter()
    init_key, run_key = jax.random.split(key)
    particles = jax.vmap(problem.draw)(jax.random.split(init_key, num_particles))
    state = blackjax.smc.tempered.init(particles)
    step = jax.jit(advance)
    step = step.lower(run_key, state).compile()
    middle = time.perf_counter()
    num_rounds = 0
    while float(state.tempering_param) < 1.0 and num_rounds < 200:
        state, _ = step(jax.random.fold_in(run_key, num_rounds), state)
        num_rounds += 1
    seconds = {"compile": middle - start, "run": time.perf_counter() - middle}
    calls = num_rounds * num_particles * (num_moves + 2) * problem.calls_each

    xs = state.particles.reshape(4, -1, problem.size)
    posterior = as_posterior(block, problem, spec, xs, seconds, "blackjax")
    return PlainResult(posterior, calls, seconds)


def as_posterior(
    block: Block, problem: PlainProblem, spec: SceneSpec, xs, seconds: dict, method: str
) -> Posterior:
    """Draws `[chain, draw, size]` as a posterior."""
    structure, z, sigma = jax.jit(jax.vmap(jax.vmap(problem.split)))(xs)
    value = np.asarray(jax.jit(jax.vmap(jax.vmap(problem.log_density)))(xs), float)
    structure = np.maximum(np.asarray(structure), 0)
    target = block.target
    active = np.asarray(target.structures)[structure]
    slot = np.asarray(target.slot)
    in_use = (slot < 0) | active[..., np.maximum(slot, 0)]
    z = np.where(in_use, np.asarray(z), 0.0).astype(np.float32)
    verdict = diagnose_chains(target, ChainDraws(structure, z, value))
    num = structure.size
    draws = BlockDraws(
        structure=structure.reshape(1, -1),
        z=z.reshape(1, num, -1),
        log_density=value.reshape(1, -1),
        noise_scale=np.tile(np.asarray(sigma).reshape(1, num, 1, 1), (1, 1, 1, 4)),
        impulse_scale=None,
        log_evidence=np.full(1, np.nan),
        evidence=None,
        diagnostics=[verdict],
        chain_index=np.arange(len(structure)),
    )
    return assemble_posterior(
        jax.random.key(0),
        spec,
        [BlockResult(block, draws, 0)],
        seconds=seconds,
        notes=[],
        method=method,
    )
