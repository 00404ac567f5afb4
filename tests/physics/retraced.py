"""Programs in which something of the engine is other than usual."""

import importlib
from collections.abc import Callable
from typing import Any

import jax
import pytest

from boomdp_jax.core import lanes, one_loop

_Patch = tuple[str, str, Any]


class Retraced:
    """A function that is compiled while names of modules have other values.

    Whatever was traced before is forgotten first: JAX keeps traces of parts, and so
    does the package, which do not know that anything has changed.
    """

    def __init__(self, function: Callable, *patches: _Patch):
        """Compile nothing yet.

        Args:
            function: to be called, not compiled.
            patches: module of the package, name in it, value.
        """
        self._function, self._patches = function, patches
        self._programs: dict[Any, Callable] = {}

    def __call__(self, *arguments: Any) -> Any:
        """Call it, compiled once for each form of arguments."""
        leaves, treedef = jax.tree.flatten(arguments)
        key = treedef, tuple((x.shape, x.dtype) for x in map(jax.numpy.asarray, leaves))
        if key not in self._programs:
            self._programs[key] = self._compiled(arguments)
        return self._programs[key](*arguments)

    def _compiled(self, arguments: tuple) -> Callable:
        _forget()
        with pytest.MonkeyPatch.context() as patch:
            for module, name, value in self._patches:
                # By its name a module may be a function of the same name.
                module = importlib.import_module(f"boomdp_jax.{module}")
                patch.setattr(module, name, value)
            program = jax.jit(self._function).lower(*arguments).compile()
        _forget()
        return program


def _forget() -> None:
    jax.clear_caches()
    for module in (lanes, one_loop):
        for value in vars(module).values():
            if hasattr(value, "cache_clear"):
                value.cache_clear()


class OnGeneralPath(Retraced):
    """The same with nothing taken for a lone body."""

    def __init__(self, function: Callable, **search: Any):
        """Compile nothing yet.

        Args:
            function: to be called, not compiled.
            search: what names of `physics.velocity_search` are to be meanwhile.
        """
        self._num_asked = 0
        patches = [("physics.velocity_search", *item) for item in search.items()]
        super().__init__(function, ("physics.step", "is_lone", self._is_none), *patches)

    def _is_none(self, *_: Any) -> bool:
        self._num_asked += 1
        return False

    def _compiled(self, arguments: tuple) -> Callable:
        self._num_asked = 0
        program = super()._compiled(arguments)
        assert self._num_asked > 0, "nobody asked whether the body is a lone one"
        return program
