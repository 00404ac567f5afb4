"""Push an unknown object a few times, and know what it is.

Bayesian model-based reinforcement learning whose model is a differentiable planar
physics engine. The names here are those that a user needs daily; each part is a
package of its own.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

# Name -> module; loaded at first use, so that importing the package stays light.
_LAZY = {
    "History": "boomdp_jax.core",
    "keep_programs": "boomdp_jax.core",
    "load_history": "boomdp_jax.core",
    "make_history": "boomdp_jax.core",
    "save_history": "boomdp_jax.core",
    "Params": "boomdp_jax.physics",
    "Scene": "boomdp_jax.physics",
    "SceneSpec": "boomdp_jax.physics",
    "State": "boomdp_jax.physics",
    "load_scene": "boomdp_jax.physics",
    "rollout": "boomdp_jax.physics",
    "step": "boomdp_jax.physics",
    "OnlineBelief": "boomdp_jax.inference",
    "Posterior": "boomdp_jax.inference",
    "infer": "boomdp_jax.inference",
    "infer_batch": "boomdp_jax.inference",
    "infer_sweep": "boomdp_jax.inference",
    "load_posterior": "boomdp_jax.inference",
    "sparse_sampling": "boomdp_jax.planning",
}

__all__ = [
    "History",
    "OnlineBelief",
    "Params",
    "Posterior",
    "Scene",
    "SceneSpec",
    "State",
    "__version__",
    "infer",
    "infer_batch",
    "infer_sweep",
    "keep_programs",
    "load_history",
    "load_posterior",
    "load_scene",
    "make_history",
    "rollout",
    "save_history",
    "sparse_sampling",
    "step",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'boomdp_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    return __all__
