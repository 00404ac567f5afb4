"""Trees are described so that all but their arrays can be made again."""

import enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from boomdp_jax.core import tree_text as module
from boomdp_jax.core.tree_text import (
    UnwritableError,
    static_text,
    tree_of_text,
    tree_text,
)


@pytest.fixture(autouse=True)
def _types_of_tests_are_ours(monkeypatch):
    monkeypatch.setattr(module, "_OURS", ("boomdp_jax", "builtins", "tests"))


class Pair(NamedTuple):
    first: object
    second: object


class Module(eqx.Module):
    array: jax.Array
    more: object = None
    size: object = eqx.field(static=True, default=3)


class Wrapping(eqx.Module):
    inner: Module


class Color(enum.Enum):
    RED = 1


TREES = {
    "leaf": np.ones(3),
    "none": None,
    "tuple": (1.0, (), [2, None], [np.ones(2)]),
    "dict": {"b": 1.0, "a": {"c": np.ones(2)}, "d": {}},
    "dict of numbers": {2: 1.0, 1: np.ones(2)},
    "named": Pair(Pair(1.0, None), {"x": np.zeros(1)}),
    "module": Module(jnp.ones(2), (1.0, Pair(jnp.ones(1), 2.0))),
    "static fields": Module(
        jnp.ones(1), None, (1, 0.1, "a", True, None, Pair(1, (2.5,)), [float])
    ),
    "modules": [Wrapping(Module(jnp.ones(1))), Wrapping(Module(jnp.ones(1), size=4))],
}


@pytest.mark.parametrize("tree", TREES.values(), ids=TREES)
def test_a_tree_is_made_again(tree):
    made = tree_of_text(tree_text(tree))
    assert jax.tree.structure(made) == jax.tree.structure(tree)
    leaves = jax.tree.leaves(tree)
    again = jax.tree.unflatten(jax.tree.structure(made), leaves)
    for one, other in zip(jax.tree.leaves(again), leaves, strict=True):
        assert one is other


def test_trees_that_differ_are_described_differently():
    texts = [tree_text(tree) for tree in TREES.values()]
    texts += [
        tree_text(Module(jnp.ones(1), None, size))
        for size in (1, 1.0, True, "1", None, (1,), [1], Pair(1, 1), int)
    ]
    assert len(set(texts)) == len(texts)


class Local(NamedTuple):
    value: object


def test_what_cannot_be_made_again_is_refused():
    class Local(NamedTuple):  # Another one has its name.
        value: object

    unwritable = (
        Local(1.0),
        Module(jnp.ones(1), None, Color.RED),
        Module(jnp.ones(1), None, lambda: 0),
        Module(jnp.ones(1), None, Local(1)),
        Module(jnp.ones(1), jax.tree_util.Partial(jnp.sin)),
        {"a": jax.tree_util.Partial(jnp.sin)},
    )
    for tree in unwritable:
        with pytest.raises(UnwritableError):
            tree_text(tree)
    with pytest.raises(UnwritableError, match="Color"):
        static_text(Color.RED)


def test_types_of_others_are_refused(monkeypatch):
    monkeypatch.setattr(module, "_OURS", ("boomdp_jax", "builtins"))
    with pytest.raises(UnwritableError, match="test_tree_text:Pair, which is not ours"):
        tree_text(Pair(1.0, 2.0))


@pytest.mark.parametrize(
    "text",
    ['["other"]', '["named","tests:Nothing",[]]', "[]", '["named","no_such:X",[]]'],
)
def test_what_describes_no_tree_is_refused(text):
    with pytest.raises(UnwritableError):
        tree_of_text(text)
