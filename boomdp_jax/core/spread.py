"""Equal calls of one program, on threads of this process or over a mesh of devices.

Calls are dealt out to the devices of a mesh in turn. Every device runs the program that
a lone device would run, and so computes the same bits: whatever their number, and
wherever they are. One program that is partitioned over the mesh (`shard_map`) does not:
XLA simplifies it in another order once there are two devices, which moved the last bits
of likelihoods, and from there whole chains. The price is that the program is compiled
once for each device of this process, side by side; JAX's compilation cache
(`JAX_COMPILATION_CACHE_DIR`) saves that from the second run on.

With devices of several processes (`jax.distributed`) each runs the whole Python
program, its devices take their turns, and all processes get all results.
"""

import contextlib
from collections.abc import Callable, Generator, Sequence
from contextvars import ContextVar
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh

from boomdp_jax.core.quick_compile import QuickCompile
from boomdp_jax.core.side_by_side import call_each, num_threads


class Program:
    """Functions compiled one by one, of which each takes what the one before returns.

    Args:
        stages: pure functions of trees of arrays. The first takes what all calls share,
            and then the arguments of one call; every further one the tuple that the one
            before returns, item by item. A stage that is a `QuickCompile` already is
            taken as it is: programs that share it compile it once.
    """

    def __init__(self, *stages: Callable[..., Any]):
        self._stages = [
            stage if isinstance(stage, QuickCompile) else QuickCompile(stage)
            for stage in stages
        ]

    def __call__(self, shared: Any, *arguments: Any) -> Any:
        """One call on the default device, its result on the host."""
        first, *rest = self._stages
        value = first(shared, *arguments)
        for stage in rest:
            value = stage(*value)
        return jax.tree.map(np.asarray, value)

    def on(self, device: jax.Device | None, shared: Any, *arguments: Any) -> Any:
        """One call on a device (None: the default one), where what is shared lies."""
        if device is not None:
            # Not by `jax.default_device`: for each of those a program is traced again.
            arguments = jax.device_put(arguments, device)
        return self(shared, *arguments)


def run_each(program: Program, shared: Any, inputs: Sequence[tuple]) -> list[Any]:
    """Run a program once on each tuple of arguments.

    Args:
        program: what to run.
        shared: tree of arrays that all calls share.
        inputs: arguments of each call: trees of arrays on the host, of the same shapes
            and types.

    Returns:
        The results on the host, in order.
    """
    over = _over.get()
    if over is None:
        return call_each(program, [(shared, *rest) for rest in inputs], shared)
    return over.run(program, shared, inputs)


@contextlib.contextmanager
def spread_over(mesh: Mesh | None) -> Generator[None, None, None]:
    """Let `run_each` use a mesh within a block of this thread.

    Args:
        mesh: of one axis; None: threads of this process.

    Raises:
        ValueError: a mesh of several axes or of another axis type than Auto; one of
            several processes that leaves out one, or has more devices of another.
    """
    token = _over.set(None if mesh is None else _Over(mesh))
    try:
        yield
    finally:
        _over.reset(token)


def is_spread() -> bool:
    """Whether calls go over a mesh here."""
    return _over.get() is not None


def num_at_a_time() -> int:
    """How many calls `run_each` makes at the same time."""
    over = _over.get()
    return num_threads() if over is None else over.num_devices


class _Over:
    """The devices of a mesh, and what has been copied to those of this process."""

    def __init__(self, mesh: Mesh):
        if len(mesh.axis_names) != 1:
            raise ValueError(f"mesh: expected one axis, got {mesh.axis_names}")
        (kind,) = mesh.axis_types
        if kind != AxisType.Auto:
            raise ValueError(f"mesh: expected an axis of type Auto, got {kind}")
        # What is compiled for the default device serves where none is asked for.
        default = jax.device_put(0.0).devices()
        devices = list(mesh.devices.flat)
        self._devices = [None if {each} == default else each for each in devices]
        # Process of the device whose turn it is.
        self._owners = np.array([device.process_index for device in devices])
        self._me = jax.process_index()
        self._is_local = bool(np.all(self._owners == self._me))
        counts = np.bincount(self._owners, minlength=jax.process_count())
        if not self._is_local and (counts != counts[0]).any():
            raise ValueError(
                "mesh: expected as many devices of every process, got "
                f"{counts.tolist()}"
            )
        # The last tree that calls shared, and its copies: a fit makes hundreds of lists
        # of calls for the same targets.
        self._source: list[Any] = []
        self._copies: dict[jax.Device | None, Any] = {}

    @property
    def num_devices(self) -> int:
        """Of the whole mesh."""
        return len(self._devices)

    def run(self, program: Program, shared: Any, inputs: Sequence[tuple]) -> list[Any]:
        """As `run_each` does; with several processes each device gets as many calls."""
        num, num_devices = len(inputs), len(self._devices)
        if not num:
            return []
        if not self._is_local:
            inputs = [*inputs, *[inputs[-1]] * (-num % num_devices)]
        turns = np.arange(len(inputs)) % num_devices
        owners = self._owners[turns]
        calls = []
        for number in np.flatnonzero(owners == self._me):
            device = self._devices[turns[number]]
            calls.append((device, self._copy(shared, device), *inputs[number]))
        mine = call_each(program.on, calls, shared)
        if self._is_local:
            return mine
        results: list[Any] = [None] * len(inputs)
        for owner, theirs in enumerate(_exchange(mine)):
            for number, value in zip(
                np.flatnonzero(owners == owner), theirs, strict=True
            ):
                results[number] = value
        return results[:num]

    def _copy(self, tree: Any, device: jax.Device | None) -> Any:
        """The tree on a device."""
        if device is None:
            return tree
        leaves, treedef = jax.tree.flatten(tree)
        is_known = len(leaves) == len(self._source) and all(
            new is old for new, old in zip(leaves, self._source, strict=True)
        )
        if not is_known:
            self._source, self._copies = leaves, {}
        if device not in self._copies:
            self._copies[device] = jax.device_put(leaves, device)
        return jax.tree.unflatten(treedef, self._copies[device])


_over: ContextVar[_Over | None] = ContextVar("over", default=None)


def _exchange(mine: list[Any]) -> list[list[Any]]:
    """The results of every process, of the same number and shapes in each."""
    leaves, treedef = jax.tree.flatten(mine)
    arrays = [np.asarray(leaf) for leaf in leaves]
    packed = np.frombuffer(b"".join(array.tobytes() for array in arrays), np.uint8)
    # Few sizes, since each is a program.
    padded = np.zeros(1 << max(len(packed) - 1, 1).bit_length(), np.uint8)
    padded[: len(packed)] = packed
    ends = np.cumsum([array.nbytes for array in arrays])[:-1]
    everyone = []
    for row in np.asarray(multihost_utils.process_allgather(padded)):
        parts = np.split(row[: len(packed)], ends)
        theirs = [
            np.frombuffer(part.tobytes(), array.dtype).reshape(array.shape)
            for part, array in zip(parts, arrays, strict=True)
        ]
        everyone.append(jax.tree.unflatten(treedef, theirs))
    return everyone
