"""Access to packages that only some functions need: other packages of Marey, and libraries for tables and pictures.

The packages are imported only when such a function is called, so that the client can be installed alone.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from marey_client.errors import MissingPackage


def import_optional(module: str, extra: str) -> ModuleType:
    """Import a module. Raises `MissingPackage`, which names the pip extra to install, if a package is missing."""
    with needing(extra):
        return importlib.import_module(module)


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Raise `MissingPackage`, which names the pip extra to install, if the `with` block misses a package."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingPackage(
            f"this function needs the package {error.name}, which is not installed; run: pip install 'marey[{extra}]'"
        ) from error
