"""Sweeps by Ray: with a module that does what Ray does, and with Ray where it is."""

import pickle
import sys
import types
from pathlib import Path

import jax
import numpy as np
import pytest

from boomdp_jax.inference import SweepError
from boomdp_jax.inference.members import Refusals
from boomdp_jax.inference.sweeps import sweep as sweeps
from boomdp_jax.inference.sweeps.sweep import Sweep, begin_sweep, infer_sweep
from boomdp_jax.interop.ray_sweep import sweep_with_ray
from tests.inference.recordings import box_scene, free_box
from tests.inference.sweeps.test_sweep import assert_same_arrays, cheap_batch

KEY = 11


class LocalRay(types.ModuleType):
    """The calls of Ray that are used: what is sent is pickled, the last is done first.

    What is sent is unpickled in single precision, as in a fresh worker.

    A task is run when it is waited for, in the order of a stack, so that results come
    in another order than they were asked for in.
    """

    def __init__(self):
        super().__init__("ray")
        self.log, self.store, self.connected = [], {}, False

    def is_initialized(self) -> bool:
        return self.connected

    def init(self) -> None:
        self.connected = True

    def put(self, value: object) -> str:
        assert self.connected
        return self._keep(pickle.dumps(value))

    def _keep(self, value: object) -> str:
        name = f"ref{len(self.store)}"
        self.store[name] = value
        return name

    def remote(self, **options):
        self.log.append(options)

        def decorate(function):
            def submit(*arguments):
                return self._keep((function, arguments))

            return types.SimpleNamespace(remote=submit)

        return decorate

    def wait(self, references: list, *, num_returns: int):
        assert num_returns == 1
        return [references[-1]], references[:-1]

    def get(self, reference: str):
        function, arguments = self.store[reference]
        values = [
            pickle.loads(self.store[a]) if isinstance(a, str) and a in self.store else a
            for a in arguments
        ]
        return function(*values)


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> LocalRay:
    module = LocalRay()
    monkeypatch.setitem(sys.modules, "ray", module)
    monkeypatch.setattr(sweeps, "infer_batch", cheap_batch)
    return module


def begin(folder: Path, **options) -> Sweep:
    histories = [free_box(np.random.default_rng(n), 5 + n) for n in range(5)]
    return begin_sweep(
        jax.random.key(KEY), box_scene({}), histories, folder, batch=2, **options
    )


def test_tasks_write_what_a_serial_run_does(
    tmp_path: Path, ray: LocalRay, monkeypatch: pytest.MonkeyPatch
):
    serial = begin(tmp_path / "serial")
    for unit in serial.units():
        serial.run(unit)
    monkeypatch.chdir(tmp_path)
    sweep = begin(Path("ray"))
    sweep.run(1)
    done = []
    files = sweep_with_ray(sweep, num_cpus=2, on_done=done.append)
    assert done == [1, 2, 0]
    assert ray.log == [{"num_cpus": 2, "num_gpus": 0, "max_retries": 3}]
    assert [file.name for file in files] == [f"object-{n:06d}.npz" for n in range(5)]
    assert_same_arrays(tmp_path / "serial", tmp_path / "ray", 5)
    # All there: nothing is asked of Ray again.
    num_kept = len(ray.store)
    sweep_with_ray(sweep)
    assert len(ray.store) == num_kept + 1


def test_what_a_task_raises_is_raised(
    tmp_path: Path, ray: LocalRay, monkeypatch: pytest.MonkeyPatch
):
    sweep = begin(tmp_path)
    monkeypatch.setattr(sweeps, "library_versions", lambda: {"jax": "0"})
    with pytest.raises(ValueError, match=r"sweep\.json: versions\."):
        sweep_with_ray(sweep)


def test_what_inference_refuses_is_raised_when_all_else_is_done(
    tmp_path: Path, ray: LocalRay, monkeypatch: pytest.MonkeyPatch
):
    def refuse(key, specs, histories, **options):
        refusals = Refusals(len(specs))
        for place, history in enumerate(histories):
            # Of object 2.
            with refusals.of(place):
                if int(np.sum(history.mask)) == 7:
                    raise ValueError("too long")
        refusals.check()
        return cheap_batch(key, specs, histories, **options)

    monkeypatch.setattr(sweeps, "infer_batch", refuse)
    sweep, done = begin(tmp_path), []
    with pytest.raises(SweepError) as caught:
        sweep_with_ray(sweep, on_done=done.append)
    assert done == [2, 1, 0]
    assert caught.value.failed == {2: "object 2: too long"}
    assert len(caught.value.paths) == 4
    # A resume finds the same, and asks nothing of Ray.
    num_kept = len(ray.store)
    with pytest.raises(SweepError, match="refused: object 2: too long"):
        sweep_with_ray(sweep)
    assert len(ray.store) == num_kept + 1


def test_without_ray_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install 'boomdp_jax\[ray\]'"):
        sweep_with_ray(begin(tmp_path))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_ray_itself_gives_the_same_bits(tmp_path: Path):
    ray = pytest.importorskip("ray")
    options = {"method": "laplace", "num_chains": 1, "num_samples": 20}
    sweep = begin(tmp_path / "ray", **options)
    # Workers find the package where this process does.
    ray.init(
        num_cpus=1,
        include_dashboard=False,
        runtime_env={"env_vars": {"PYTHONPATH": ":".join(sys.path)}},
    )
    try:
        sweep_with_ray(sweep)
    finally:
        ray.shutdown()
    infer_sweep(
        jax.random.key(KEY),
        box_scene({}),
        sweep.histories,
        tmp_path / "serial",
        batch=2,
        **options,
    )
    assert_same_arrays(tmp_path / "ray", tmp_path / "serial", 5)
