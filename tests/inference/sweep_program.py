"""A program of its own, to be killed: a sweep over recordings of free boxes.

python -m tests.inference.sweep_program OUT_DIR [I N]
"""

import sys

import jax
import numpy as np

from boomdp_jax.inference.sweeps.sweep import infer_sweep
from tests.inference.recordings import box_scene, free_box

NUM_OBJECTS = 8
OPTIONS = {"method": "smc", "num_chains": 2, "num_samples": 64, "num_warmup": 1}


def histories() -> list:
    """Of different lengths; half are padded."""
    return [free_box(np.random.default_rng(n), 5 + n % 4) for n in range(NUM_OBJECTS)]


def main() -> None:
    folder, *shard = sys.argv[1:]
    place, num = map(int, shard) if shard else (0, 1)
    infer_sweep(
        jax.random.key(3),
        box_scene({}),
        histories(),
        folder,
        shard=(place, num),
        batch=2,
        **OPTIONS,
    )


if __name__ == "__main__":
    main()
