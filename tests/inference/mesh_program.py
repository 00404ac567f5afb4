"""A program of its own: the same inference over meshes of several sizes.

    python -m tests.inference.mesh_program OUT.npz METHOD NUM_DEVICES... [--join I PORT]

writes the numbers of all posteriors, by mesh. With `--join` it is process I of two that
have half of the devices each.
"""

import argparse

import jax
import numpy as np
from jax.sharding import AxisType, Mesh

from boomdp_jax.inference.infer import infer_batch
from tests.inference.recordings import box_scene, free_box

COUNTS = {"num_chains": 3, "num_warmup": 50, "num_samples": 50}


def numbers(mesh: Mesh | None, method: str) -> list[np.ndarray]:
    """Every array of the posteriors of two boxes."""
    specs = [box_scene({})] * 2
    histories = [free_box(np.random.default_rng(n), n) for n in (9, 12)]
    options = COUNTS | ({"structure": {}} if method == "nuts" else {})
    posteriors = infer_batch(
        jax.random.key(5), specs, histories, method=method, mesh=mesh, **options
    )
    return [np.asarray(leaf) for leaf in jax.tree.leaves(posteriors)]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("method")
    parser.add_argument("devices", nargs="+", type=int)
    parser.add_argument("--join", nargs=2, type=int)
    arguments = parser.parse_args()
    if arguments.join:
        place, port = arguments.join
        jax.distributed.initialize(f"localhost:{port}", 2, place)
    found = {}
    for count in arguments.devices:
        mesh = None
        if count:
            devices = jax.devices()[:count]
            mesh = jax.make_mesh((count,), ("x",), (AxisType.Auto,), devices=devices)
        for index, array in enumerate(numbers(mesh, arguments.method)):
            found[f"{count}.{index}"] = array
    np.savez(arguments.out, **found)


if __name__ == "__main__":
    main()
