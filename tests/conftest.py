"""Set-up of every test: 64 bit, ranks that never broadcast silently, checked shapes."""

import gc
from collections.abc import Iterator
from typing import NamedTuple

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
install_import_hook("boomdp_jax", "beartype.beartype")

from boomdp_jax.core import side_by_side  # noqa: E402  After the hook.


@pytest.fixture(autouse=True, scope="module")
def _drop_programs() -> Iterator[None]:
    """Let go of a module's compiled programs when it is done.

    Each holds several memory mappings, of which a process may have 65,530 on Linux;
    all tests together need more, and the compiler then crashes.
    """
    yield
    jax.clear_caches()
    side_by_side.forget_compiled()
    gc.collect()


class Precision(NamedTuple):
    """The float type that a test runs in."""

    bits: int

    def choose(self, *, single: float, double: float) -> float:
        """Pick the tolerance that belongs to this float type."""
        return single if self.bits == 32 else double


@pytest.fixture(
    params=[32, pytest.param(64, marks=pytest.mark.slow)], ids=["float32", "float64"]
)
def precision(request: pytest.FixtureRequest) -> Iterator[Precision]:
    """Run the test once on 32 bit floats and, among slow ones, once on 64 bit ones."""
    with jax.enable_x64(request.param == 64):
        yield Precision(request.param)
