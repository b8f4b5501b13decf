"""Version of the package."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def code_version() -> str:
    """Return the version of the package, as written in results and reports.

    Returns
    -------
    str    "marey@" and the version
    """
    try:
        return f"marey@{version('marey')}"
    except PackageNotFoundError:  # run from a source tree that is not installed
        return "marey@unknown"
