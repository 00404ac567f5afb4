"""Versions of what computes, as result files record them."""

import importlib.metadata
from collections.abc import Iterable

_LIBRARIES = ("boomdp_jax", "jax", "jaxlib", "numpyro", "equinox", "numpy")


def library_versions(names: Iterable[str] = _LIBRARIES) -> dict[str, str]:
    """Look up the versions of installed distributions.

    Args:
        names: of the distributions.

    Returns:
        Version by name; "not installed" where there is none.
    """
    versions = {}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
