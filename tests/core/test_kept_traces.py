"""What one process traced another has from disk, and nothing else."""

import functools
import importlib.util
import json
import os
import pathlib
import subprocess
import sys
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core import kept_traces, make_history, save_history, tree_text
from boomdp_jax.core.kept_traces import are_traces_kept, keep_traces
from boomdp_jax.core.quick_compile import KeptJit, QuickCompile
from boomdp_jax.physics import load_scene, rollout


class Values(NamedTuple):
    sine: jax.Array
    more: dict


class Scaled(eqx.Module):
    x: jax.Array
    power: int = eqx.field(static=True)


traced: list[str] = []


@QuickCompile
def powers(scaled: Scaled, offset):
    traced.append("powers")
    changed = jnp.sin(scaled.x) ** scaled.power + offset
    return Values(changed, {"scaled": Scaled(changed[:1], scaled.power)})


def _times(x, how, *, number=1.0):
    traced.append("times")
    return x * (2.0 if how == "twice" else 3.0) * number


times = QuickCompile(_times, static=("how",))


@QuickCompile
def fails(x):
    if x.shape == (2,):
        raise ValueError("two are too many")
    return x


@QuickCompile
def solved(matrix, key):
    noise = jax.random.normal(key, matrix.shape[:1])
    return jnp.linalg.solve(matrix, noise), tuple(jnp.linalg.eigh(matrix))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    # Functions of tests count as the library's.
    monkeypatch.setattr(tree_text, "_OURS", ("boomdp_jax", "builtins", "tests"))
    start_anew()
    keep_traces(tmp_path)
    yield tmp_path
    keep_traces(None)


def start_anew():
    """As in a process that has not called anything yet."""
    jax.clear_caches()
    traced.clear()


def test_nothing_is_kept_unless_told(tmp_path):
    start_anew()
    assert not are_traces_kept()
    powers(Scaled(jnp.ones(2), 2), 1.0)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_kept_where_it_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    keep_traces(tmp_path)
    assert not are_traces_kept()


def test_the_next_process_does_not_trace(folder):
    x = jnp.linspace(0.0, 1.0, 5)
    first = powers(Scaled(x, 3), 0.5)
    assert traced == ["powers"]
    assert len(list(folder.glob("powers-*.trace"))) == 1
    assert powers(Scaled(x, 3), 0.5).more["scaled"].power == 3
    start_anew()
    second = powers(Scaled(x, 3), 0.5)
    assert traced == []
    assert jax.tree.structure(first) == jax.tree.structure(second)
    assert jax.tree.all(jax.tree.map(np.array_equal, first, second))
    keep_traces(None)
    plain = powers(Scaled(x, 3), 0.5)
    assert traced == ["powers"]
    assert jax.tree.structure(first) == jax.tree.structure(plain)
    assert jax.tree.all(jax.tree.map(np.array_equal, first, plain))


def test_everything_that_a_trace_depends_on_tells(folder):
    x = np.linspace(0.0, 1.0, 5)
    known = [
        (powers, Scaled(x, 3), np.array(0.5)),
        (powers, Scaled(x, 2), np.array(0.5)),
        (powers, Scaled(x[:3], 3), np.array(0.5)),
        (powers, Scaled(x[:3], 3), np.array([0.5, 1.0, 2.0])),
        (powers, Scaled(x.astype(np.float32), 3), 0.5),
        (powers, Scaled(x.astype(np.float32), 3), np.array(0.5)),
        (times, 2.0, "twice"),
        (times, x, "twice"),
        (times, x, "thrice"),
    ]
    results = [call(*arguments) for call, *arguments in known]
    assert len(traced) == len(known)
    start_anew()
    for (call, *arguments), before in zip(known, results, strict=True):
        after = call(*arguments)
        assert jax.tree.all(jax.tree.map(np.array_equal, before, after))
        assert jax.tree.map(jax.typeof, before) == jax.tree.map(jax.typeof, after)
    assert traced == []
    keep_traces(None)
    for (call, *arguments), before in zip(known, results, strict=True):
        plain = call(*arguments)
        assert jax.tree.all(jax.tree.map(np.array_equal, before, plain))
        assert jax.tree.map(jax.typeof, before) == jax.tree.map(jax.typeof, plain)
    assert results[-1][-1] == 3.0
    assert results[-2][-1] == 2.0


def test_static_arguments_may_come_by_name(folder):
    assert times(2.0, "twice", number=10.0) == 40.0
    start_anew()
    assert times(x=2.0, how="twice", number=20.0) == 80.0
    assert traced == []


def test_arguments_may_be_given_beforehand(folder):
    for _ in range(2):
        for how, expected in (("twice", 40.0), ("thrice", 60.0)):
            given = KeptJit(functools.partial(_times, how=how))
            assert given(2.0, number=10.0) == expected
            assert given._cache_size() == 1
        assert traced == ["times", "times"]
        jax.clear_caches()
    given = KeptJit(functools.partial(_times, how=frozenset({1})))
    assert given(2.0) == 6.0
    assert len(list(folder.iterdir())) == 2


def test_settings_of_jax_tell(folder):
    for _ in range(2):
        with jax.enable_x64(False):
            single = powers(Scaled(jnp.ones(2), 2), 0.0)
        double = powers(Scaled(jnp.ones(2), 2), 0.0)
        assert single.sine.dtype == np.float32
        assert double.sine.dtype == np.float64
        with jax.threefry_partitionable(False):
            one = solved(jnp.eye(3), jax.random.key(1))[0]
        other = solved(jnp.eye(3), jax.random.key(1))[0]
        assert not np.array_equal(one, other)
        start_anew()
    assert len(list(folder.glob("solved-*"))) == 2


def test_another_version_is_another_trace(folder, monkeypatch):
    x = jnp.ones(2)
    powers(Scaled(x, 2), 0.5)
    start_anew()
    monkeypatch.setattr(kept_traces, "_versions", lambda: ("another",))
    powers(Scaled(x, 2), 0.5)
    assert traced == ["powers"]
    assert len(list(folder.iterdir())) == 2


def test_keys_and_linear_algebra_are_kept(folder):
    first = solved(jnp.eye(3) + 0.1, jax.random.key(1))
    start_anew()
    second = solved(jnp.eye(3) + 0.1, jax.random.key(1))
    assert len(list(folder.glob("solved-*"))) == 1
    assert jax.tree.all(jax.tree.map(np.array_equal, first, second))


def test_functions_that_hold_something_are_not_kept(folder):
    for factor in (2.0, 3.0):

        @QuickCompile
        def scaled(x, factor=factor):
            return factor * x

        assert scaled(1.0) == factor
    assert list(folder.iterdir()) == []


def test_errors_are_those_of_the_function(folder):
    with pytest.raises(ValueError, match="two are too many"):
        fails(jnp.ones(2))
    assert list(folder.iterdir()) == []
    assert fails(jnp.ones(3)).shape == (3,)


def test_transformations_go_through(folder):
    x = jnp.linspace(0.0, 1.0, 5)
    batch = jax.vmap(lambda x: powers(Scaled(x, 2), 0.0).sine)(x[:, None])
    np.testing.assert_allclose(batch[:, 0], np.sin(x) ** 2, rtol=1e-14)
    slope = jax.grad(lambda x: powers(Scaled(x[None], 2), 0.0).sine[0])(0.3)
    np.testing.assert_allclose(slope, 2 * np.sin(0.3) * np.cos(0.3), rtol=1e-14)
    inner = jax.jit(lambda x: powers(Scaled(x, 2), 0.0).sine)(x)
    np.testing.assert_allclose(inner, np.sin(x) ** 2, rtol=1e-14)


@QuickCompile
def rotated(x):
    return x[1:] * 2.0, x[:1]


def test_results_are_called_with_without_another_compilation(folder):
    for _ in range(2):
        first, _ = rotated(jnp.ones(3))
        assert not first.committed
        size = rotated._cache_size()
        x = jnp.ones(3)
        for _ in range(3):
            x = jnp.concatenate(rotated(x))
        assert rotated._cache_size() == size
        start_anew()


def test_what_is_not_of_this_library_is_not_kept(folder, monkeypatch):
    monkeypatch.setattr(tree_text, "_OURS", ("boomdp_jax", "builtins"))
    assert times(2.0, "twice") == 4.0
    assert list(folder.iterdir()) == []


def test_nothing_is_kept_once_a_source_has_changed(folder, monkeypatch):
    times(2.0, "twice")
    start_anew()
    monkeypatch.setattr(kept_traces, "_BEGUN", 0.0)
    times(2.0, "twice")
    assert traced == ["times"]
    assert len(list(folder.iterdir())) == 1


def test_settings_that_forbid_much_forbid_nothing_more(folder):
    with jax.debug_key_reuse(True), jax.numpy_dtype_promotion("strict"):
        assert rotated(jnp.ones(3))[1] == 1.0


def test_without_compilation_the_function_itself_runs(folder):
    times(2.0, "twice")
    with jax.disable_jit():
        assert times(3.0, "twice") == 6.0
    assert traced == ["times", "times"]


def test_wrong_arguments_are_refused_as_ever(folder):
    with pytest.raises(TypeError, match="multiple values for argument 'how'"):
        times(1.0, "twice", how="thrice")
    with pytest.raises(TypeError, match=r"too many positional arguments|takes 2 pos"):
        times(1.0, "twice", 5.0)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[\n",
        b"\xff\xff\n",
        b'["no tree",[false]]\n',
        b'["[\\"leaf\\"]",[false]]\n\0\0\0\0\0\0\0\0',
        b'["[\\"none\\"]",[]]\nREST',
    ],
)
def test_broken_files_are_written_again(folder, content):
    expected = times(2.0, "twice")
    (path,) = folder.iterdir()
    whole = path.read_bytes()
    rest = whole.partition(b"\n")[2]
    path.write_bytes(content.replace(b"REST", rest))
    start_anew()
    assert times(2.0, "twice") == expected
    assert traced == ["times"]
    assert path.read_bytes() == whole


def test_a_file_that_cannot_be_touched_is_read(folder, monkeypatch):
    times(2.0, "twice")
    start_anew()

    def refuse(*_, **__):
        raise PermissionError

    monkeypatch.setattr(pathlib.Path, "touch", refuse)
    assert times(2.0, "twice") == 4.0
    assert traced == []


def test_a_folder_that_is_gone_is_done_without(folder):
    folder.rmdir()
    assert times(2.0, "twice") == 4.0


_INFERS = """
import hashlib, json, sys, jax, numpy as np
from boomdp_jax import infer, keep_programs, load_history, load_scene
from boomdp_jax.inference.likelihoods.filtered_likelihood import FilteredLikelihood
traced, whitened = [], FilteredLikelihood.whitened
def counted(*arguments):
    traced.append(1)
    return whitened(*arguments)
FilteredLikelihood.whitened = counted
if "keep" in sys.argv:
    keep_programs()
spec = load_scene("scene.json")
history = load_history("history.npz", spec=spec)
posterior = infer(jax.random.key(0), spec, history, num_samples=64)
leaves = jax.tree.leaves(posterior.params)
bits = b"".join(np.asarray(leaf).tobytes() for leaf in leaves)
print(json.dumps([hashlib.sha256(bits).hexdigest(), len(traced)]))
"""


@pytest.mark.slow
def test_an_inference_does_not_trace_its_likelihood_again(tmp_path):
    """And gives the same bits with what was kept and without."""
    shape = {"type": "box", "half_extents": [0.3, 0.2]}
    scene = {"schema": "planar-scene-1", "dt": 0.02, "unknown": {"revolute": 1}}
    scene["bodies"] = [{"name": "box", "shape": shape, "density": 5, "pose": [0, 0, 0]}]
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    action = np.random.default_rng(0).normal(size=(20, 1, 3))
    spec = load_scene(tmp_path / "scene.json")
    start = spec.initial_state()
    run, _ = rollout(spec.scene, spec.params(), start, jnp.asarray(action))
    states = np.concatenate([np.asarray(start.array)[None], np.asarray(run.array)])
    history = make_history(states[:-1], action, states[1:], dt=0.02)
    save_history(tmp_path / "history.npz", history)
    outcomes = []
    for arguments in ((), ("keep",), ("keep",)):
        done = subprocess.run(
            [sys.executable, "-c", _INFERS, *arguments],
            cwd=tmp_path,
            env=os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "kept")},
            check=True,
            stdout=subprocess.PIPE,
            text=True,
        )
        outcomes.append(json.loads(done.stdout))
    (bits, plain), (first_bits, first), (second_bits, second) = outcomes
    assert bits == first_bits == second_bits
    assert plain > 0
    assert first > 0
    assert second == 0
