"""A neural posterior estimator on the same problem as the plain samplers (`sbi`)."""

import time

import jax
import jax.numpy as jnp
import numpy as np
from _plain_samplers import PlainResult, as_posterior

from boomdp_jax.core.history import History
from boomdp_jax.inference.likelihoods.one_step import residuals
from boomdp_jax.inference.samplers.plain_problem import plain_problem
from boomdp_jax.physics.scene_spec import SceneSpec

# Differences from the readings enter as they are below this, beyond it by logarithms:
# most hypotheses of the prior are far off.
_SCALE = 1e-2
_NUM_KEPT = 2048
_NUM_FEATURES = 64


def neural_posterior(
    key: jax.Array,
    spec: SceneSpec,
    history: History,
    *,
    num_simulations: int = 20_000,
    num_epochs: int = 200,
) -> PlainResult:
    """A spline flow, trained on simulations of this object's pushes from the prior.

    Papamakarios and Murray (2016), Fast epsilon-free inference of simulation models;
    Greenberg et al. (2019). One round; the time of simulations and training counts,
    since another object with other pushes needs them anew.
    """
    import torch
    from sbi.inference import NPE
    from sbi.neural_nets import posterior_nn
    from sbi.neural_nets.embedding_nets import FCEmbedding

    block, problem = plain_problem(spec, history)
    data = problem.data

    def simulate(key):
        """A hypothesis, and what would be read less what was."""
        draw_key, noise_key = jax.random.split(key)
        x = problem.draw(draw_key)
        structure, _, sigma = problem.split(x)
        error = residuals(problem.coordinates.scene, problem.params(x), data)
        noise = sigma * jax.random.normal(noise_key, error.shape)
        features = jnp.arcsinh((error + noise * data.mask) / _SCALE).reshape(-1)
        return x, features, (structure >= 0) & jnp.all(jnp.isfinite(features))

    start = time.perf_counter()
    sim_key, seed_key = jax.random.split(key)
    keys = jax.random.split(sim_key, num_simulations)
    run = jax.jit(jax.vmap(simulate)).lower(keys).compile()
    middle = time.perf_counter()
    xs, features, is_valid = (np.asarray(part) for part in run(keys))
    torch.manual_seed(int(jax.random.randint(seed_key, (), 0, 2**31 - 1)))
    embedding = FCEmbedding(
        input_dim=features.shape[1], output_dim=_NUM_FEATURES, num_hiddens=128
    )
    trainer = NPE(
        prior=None,
        density_estimator=posterior_nn("nsf", embedding_net=embedding),
        show_progress_bars=False,
    )
    trainer.append_simulations(
        torch.as_tensor(xs[is_valid]), torch.as_tensor(features[is_valid])
    )
    flow = trainer.train(max_num_epochs=num_epochs)
    read = torch.zeros(1, features.shape[1])
    kept: list[np.ndarray] = []
    support = jax.jit(
        jax.vmap(lambda x: (problem.split(x)[0] >= 0) & (problem.log_prior(x) > -1e30))
    )
    # Draws outside of the prior's support are thrown away, as `sbi` does.
    for _ in range(20):
        with torch.no_grad():
            found = flow.sample((_NUM_KEPT,), condition=read)[:, 0].numpy()
        kept.append(found[np.asarray(support(found))])
        if sum(map(len, kept)) >= _NUM_KEPT:
            break
    draws = np.concatenate(kept)
    if not len(draws):
        raise RuntimeError("npe: expected draws within the prior's support, got none")
    draws = np.resize(draws[:_NUM_KEPT], (4, _NUM_KEPT // 4, problem.size))
    seconds = {"compile": middle - start, "run": time.perf_counter() - middle}
    posterior = as_posterior(block, problem, spec, jnp.asarray(draws), seconds, "npe")
    return PlainResult(posterior, num_simulations * problem.calls_each, seconds)
