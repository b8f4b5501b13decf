"""Which code computes."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def code_version() -> str:
    """The version of the package, as results and reports say it."""
    try:
        return f"marey@{version('marey')}"
    except PackageNotFoundError:  # run from a source tree that is not installed
        return "marey@unknown"
