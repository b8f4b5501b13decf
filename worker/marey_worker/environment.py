"""What a result was computed with, for its lineage."""

from __future__ import annotations

import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version

LIBRARIES = ("marey", "numpy", "scipy", "numba")


@cache
def environment() -> dict[str, str]:
    """Versions of the interpreter and of the libraries that numbers depend on."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            found[library] = "absent"
    return found
