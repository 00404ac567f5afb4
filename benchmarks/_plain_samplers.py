"""Samplers that know nothing of modes: the papers' own recipe, and a general SMC.

Both see single steps with one noise scale for metres, radians and rates, as equation 1
of "What Does Physics Bias" has it, and every constraint at all times: a switch value of
each says whether it acts, so that one is nulled by a value and not by a jump.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from boomdp_jax.core.history import History
from boomdp_jax.inference.assemble import assemble_posterior
from boomdp_jax.inference.block import Block, make_block
from boomdp_jax.inference.chain_diagnostics import diagnose_chains
from boomdp_jax.inference.evidence_report import BlockResult
from boomdp_jax.inference.one_step import readings, residuals
from boomdp_jax.inference.posterior import Posterior
from boomdp_jax.inference.sample import BlockDraws
from boomdp_jax.inference.structure_chain import ChainDraws
from boomdp_jax.physics.scene_spec import SceneSpec

# Middle and spread of the prior of log-sigma; the papers do not give theirs.
_LOG_SIGMA, _SIGMA_SPREAD = np.log(1e-2), 2.0
_ACCEPTED, _GAIN = 0.3, 0.05
# Steps of the SMC's random walks, of what is best for a normal density.
_SMC_STEP = 0.3


class PlainProblem(NamedTuple):
    """One vector, everything in it a priori standard normal or uniform."""

    block: Block
    size: int
    groups: np.ndarray
    """Which coordinates are proposed together, `[group, size]`."""
    log_prior: Callable[[jax.Array], jax.Array]
    log_likelihood: Callable[[jax.Array], jax.Array]
    split: Callable[[jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
    """Structure (-1: one that is left out), coordinates and sigma."""
    draw: Callable[[jax.Array], jax.Array]
    calls_each: int
    """Simulator steps of one likelihood."""


class PlainResult(NamedTuple):
    """What a sampler gave, and what it took."""

    posterior: Posterior
    num_calls: int
    seconds: dict[str, float]


def plain_problem(spec: SceneSpec, history: History) -> PlainProblem:
    """One body's posterior with switches, from single steps with a scalar sigma."""
    block = make_block(spec, (0,), history)
    target = block.target
    coordinates = target.log_likelihood.coordinates
    data = readings(history, (0,), True)
    structures = np.asarray(target.structures)
    prior = np.exp(np.asarray(target.log_prior, float))
    share = np.clip(prior @ structures, 1e-6, 1 - 1e-6)
    level = jnp.asarray(norm.ppf(share), jnp.float32)
    dim, num_slots = target.dim, structures.shape[1]
    size = dim + num_slots + 1
    num = float(np.sum(np.asarray(data.mask)))

    def split(x):
        z, switch = x[:dim], x[dim : dim + num_slots]
        same = jnp.all(target.structures == (switch < level)[None], axis=1)
        structure = jnp.where(jnp.any(same), jnp.argmax(same), -1)
        return structure, z, jnp.exp(_LOG_SIGMA + _SIGMA_SPREAD * x[-1])

    def log_prior(x):
        z, rest = x[:dim], x[dim:]
        period = target.period
        inside = jnp.all((period == 0) | (jnp.abs(z) <= 0.5 * period))
        value = jnp.sum(jnp.where(period > 0, 0.0, -0.5 * z**2))
        return jnp.where(inside, value - 0.5 * jnp.sum(rest**2), -jnp.inf)

    def log_likelihood(x):
        structure, z, sigma = split(x)
        active = target.structures[jnp.maximum(structure, 0)]
        params = coordinates(z, active)
        square = jnp.sum(residuals(coordinates.scene, params, data) ** 2)
        value = -0.5 * square / sigma**2 - num * jnp.log(sigma)
        return jnp.where((structure >= 0) & jnp.isfinite(value), value, -1e30)

    def draw(key):
        normal = jax.random.normal(key, (size,))
        turn = jax.random.uniform(jax.random.fold_in(key, 1), (dim,)) - 0.5
        z = jnp.where(target.period > 0, turn * target.period, normal[:dim])
        return normal.at[:dim].set(z)

    slot = np.append(np.asarray(target.slot), [*range(num_slots), num_slots])
    groups = np.stack([slot == name for name in range(-1, num_slots + 1)])
    groups = groups[groups.any(axis=1)]
    rows = int(np.asarray(data.mask).shape[0])
    return PlainProblem(
        block, size, groups, log_prior, log_likelihood, split, draw, rows
    )


def metropolis(
    key: jax.Array,
    spec: SceneSpec,
    history: History,
    *,
    num_chains: int = 30,
    num_iterations: int = 20_000,
    num_kept: int = 100,
) -> PlainResult:
    """Random-walk Metropolis from prior draws, one constraint's numbers at a time.

    The papers give neither scales nor blocks. Here each chain's scale of every block is
    tuned in the first half, which is thrown away.
    """
    problem = plain_problem(spec, history)
    groups = jnp.asarray(problem.groups, jnp.float32)

    def log_density(x):
        return problem.log_prior(x) + problem.log_likelihood(x)

    def step(carry, inputs):
        x, value, log_scale = carry
        key, number = inputs
        noise_key, group_key, verdict_key = jax.random.split(key, 3)
        group = jax.random.randint(group_key, (), 0, len(groups))
        noise = jax.random.normal(noise_key, x.shape)
        trial = x + jnp.exp(log_scale[group]) * groups[group] * noise
        found = log_density(trial)
        gain = jnp.where(jnp.isnan(found), -jnp.inf, found) - value
        accepts = jnp.log(jax.random.uniform(verdict_key)) < gain
        is_early = number < num_iterations // 2
        change = _GAIN * (accepts - _ACCEPTED) * is_early
        log_scale = log_scale.at[group].add(change)
        x = jnp.where(accepts, trial, x)
        return (x, jnp.where(accepts, found, value), log_scale), (x, is_early * 0.0)

    def chain(key):
        start_key, run_key = jax.random.split(key)
        x = problem.draw(start_key)
        carry = x, log_density(x), jnp.full(len(groups), -1.0)
        keys = jax.random.split(run_key, num_iterations)
        _, (xs, _) = jax.lax.scan(step, carry, (keys, jnp.arange(num_iterations)))
        thin = num_iterations // 2 // num_kept
        return xs[num_iterations // 2 :: thin][:num_kept]

    start = time.perf_counter()
    keys = jax.random.split(key, num_chains)
    run = jax.jit(jax.vmap(chain)).lower(keys).compile()
    middle = time.perf_counter()
    xs = jax.block_until_ready(run(keys))
    seconds = {"compile": middle - start, "run": time.perf_counter() - middle}
    num_calls = num_chains * (num_iterations + 1) * problem.calls_each
    posterior = as_posterior(problem, spec, xs, log_density, seconds, "metropolis")
    return PlainResult(posterior, num_calls, seconds)


def blackjax_smc(
    key: jax.Array, spec: SceneSpec, history: History, *, num_particles: int = 2048
) -> PlainResult:
    """BlackJAX's adaptive tempered SMC from the prior, with random-walk moves."""
    import blackjax
    from blackjax.smc import resampling

    problem = plain_problem(spec, history)
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

    def log_density(x):
        return problem.log_prior(x) + problem.log_likelihood(x)

    xs = state.particles.reshape(4, -1, problem.size)
    posterior = as_posterior(problem, spec, xs, log_density, seconds, "blackjax")
    return PlainResult(posterior, calls, seconds)


def as_posterior(
    problem: PlainProblem, spec: SceneSpec, xs, log_density, seconds: dict, method: str
) -> Posterior:
    """Draws `[chain, draw, size]` as a posterior."""
    structure, z, sigma = jax.jit(jax.vmap(jax.vmap(problem.split)))(xs)
    value = np.asarray(jax.jit(jax.vmap(jax.vmap(log_density)))(xs), float)
    structure = np.maximum(np.asarray(structure), 0)
    target = problem.block.target
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
        [BlockResult(problem.block, draws, 0)],
        seconds=seconds,
        notes=[],
        method=method,
    )
