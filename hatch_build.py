"""Build of the browser pages: `python hatch_build.py` (`make web`), and the hook that runs it when a wheel is built.

`web/` is built into the folder `webui` of the server's package, with a stamp that contains a hash of the sources. The
hook builds the pages if the stamp does not match. Without npm, it warns, and the wheel contains no pages; with
MAREY_WEB=require, it fails instead (for releases), and with MAREY_WEB=skip it does nothing.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = Path(__file__).parent
SOURCES = ROOT / "web"
PAGES = ROOT / "server" / "marey_server" / "webui"
STAMP = PAGES / ".sources"
VARIABLE = "MAREY_WEB"
UNBUILT = {"node_modules", "tests", "browser"}
"""Folders in `web/` that do not change the pages."""


class PagesNotBuilt(Exception):
    """The pages could not be built; the text says why."""


def source_digest() -> str:
    """Return a hash of all files from which the pages are built."""
    digest = hashlib.sha256()
    for file in sorted(file for file in SOURCES.rglob("*") if file.is_file()):
        place = file.relative_to(SOURCES)
        if place.parts[0] not in UNBUILT:
            digest.update(f"{place.as_posix()} {file.stat().st_size}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def pages_are_current() -> bool:
    """Return whether the built pages belong to the sources."""
    return STAMP.is_file() and STAMP.read_text() == source_digest()


def build_pages() -> None:
    """Build the pages, unless they are current. Raises `PagesNotBuilt`."""
    if pages_are_current():
        return
    npm = shutil.which("npm")
    if npm is None:
        raise PagesNotBuilt("npm is not installed; install Node 20.19 or newer, and run `make web`")
    installed = SOURCES / "node_modules" / ".package-lock.json"
    lock = SOURCES / "package-lock.json"
    if not installed.is_file() or installed.stat().st_mtime < lock.stat().st_mtime:
        _run(npm, "ci")
    _run(npm, "run", "build")
    STAMP.write_text(source_digest())


def _run(npm: str, *words: str) -> None:
    done = subprocess.run([npm, *words], cwd=SOURCES, check=False)
    if done.returncode != 0:
        raise PagesNotBuilt(f"`npm {' '.join(words)}` failed in {SOURCES}; see its output above")


class PagesHook(BuildHookInterface[Any]):
    """Hook of hatchling that builds the pages before a wheel; editable installations use `make web`."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002 - hatchling's signature
        """Build the pages if they are not current."""
        wish = os.environ.get(VARIABLE, "")
        if version == "editable" or wish == "skip" or not SOURCES.is_dir():
            return
        try:
            build_pages()
        except PagesNotBuilt as error:
            if wish == "require":
                raise
            self.app.display_warning(f"The package will contain no browser pages: {error}.")


if __name__ == "__main__":
    try:
        build_pages()
    except PagesNotBuilt as error:
        sys.exit(f"The browser pages were not built: {error}.")
