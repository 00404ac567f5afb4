"""Random decision processes with few states, and their values by backward induction."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Tabular(NamedTuple):
    """Where actions lead, what that pays, and where the episode ends."""

    probability: np.ndarray
    """`[state, action, next]`."""
    reward: np.ndarray
    """`[state, action, next]`."""
    is_terminal: np.ndarray
    """`[state]`."""

    def transition_fn(self, key, hypothesis, state, action):
        del hypothesis
        logits = jnp.log(jnp.asarray(self.probability))[state, action]
        after = jax.random.categorical(key, logits).astype(state.dtype)
        return after, jnp.asarray(self.is_terminal)[after]

    def reward_fn(self, hypothesis, state, action, after):
        del hypothesis
        return jnp.asarray(self.reward)[state, action, after]

    def model(self) -> dict:
        """What planners ask for."""
        return {
            "transition_fn": self.transition_fn,
            "reward_fn": self.reward_fn,
            "actions": self.probability.shape[1],
        }

    def q_values(self, depth: int, discount: float) -> np.ndarray:
        """Of all states and actions at a horizon `[state, action]`."""
        goes_on = 1.0 - self.is_terminal
        value = np.zeros(self.probability.shape[0])
        for _ in range(depth):
            future = self.reward + discount * (goes_on * value)
            q_values = np.sum(self.probability * future, axis=2)
            value = q_values.max(axis=1)
        return q_values


def random_process(
    seed: int, num_states: int, num_actions: int, *, is_deterministic: bool = False
) -> Tabular:
    """Transitions to two or three states each (one where deterministic)."""
    rng = np.random.default_rng([41, seed])
    shape = (num_states, num_actions, num_states)
    logits = rng.gumbel(size=shape) * 3.0
    probability = np.exp(logits - logits.max(axis=2, keepdims=True))
    if is_deterministic:
        probability = (logits == logits.max(axis=2, keepdims=True)).astype(float)
    probability = probability / probability.sum(axis=2, keepdims=True)
    is_terminal = np.zeros(num_states, bool)
    is_terminal[-1] = True
    return Tabular(probability, rng.standard_normal(shape), is_terminal)
