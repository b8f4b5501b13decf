"""New folders that appear under their names only when all files are written, and file names that all systems accept."""

from __future__ import annotations

import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from marey_client.downloads import TakenPaths, safe_file_name
from marey_client.errors import CannotExport, FolderNotEmpty

_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{digit}" for port in ("com", "lpt") for digit in "123456789")}
"""Names that Windows reserves for devices, with any ending."""


@contextmanager
def new_folder(target: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `target`; rename it to `target` at the end of the `with` block.

    If the block fails or is interrupted, the temporary folder is deleted. Raises `FolderNotEmpty` if `target` exists
    and is not an empty folder.
    """
    target = target.resolve()
    require_free(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name[:32]}.{uuid.uuid4().hex}")
    temporary.mkdir()
    try:
        yield temporary
        if target.exists():
            target.rmdir()
        temporary.rename(target)
    except BaseException:
        shutil.rmtree(temporary)
        raise


def require_free(target: Path) -> None:
    """Raise `FolderNotEmpty` if `target` exists and is not an empty folder."""
    if not target.exists():
        return
    if not target.is_dir():
        raise FolderNotEmpty(f"{target} is a file; name a new folder")
    if any(target.iterdir()):
        raise FolderNotEmpty(f"{target} is not empty; name a new folder, or move its content away first")


def file_names(paths: Sequence[str], ending: str, *, reserved: Sequence[str] = ()) -> list[str]:
    """Return a file path for each entry path, in order: the path with `ending`, changed where a system refuses it.

    Characters that Windows refuses become `_`, and names of devices in Windows, such as `con`, get a `_` after them.
    If two files would have the same name, where upper and lower case count as equal, the later one gets a number.
    `reserved` are names of other files in the folder. Raises `CannotExport` if a path contains an empty name, `.` or
    `..`, which would lead to other folders.
    """
    steps = [_steps(path) for path in paths]
    taken = TakenPaths()
    folders = {PurePosixPath(*names[:end]) for names in steps for end in range(1, len(names))}
    for place in (*reserved, *sorted(map(str, folders))):
        taken.take(Path(place))
    return [taken.take(Path(*names[:-1], names[-1] + ending)).as_posix() for names in steps]


def _steps(path: str) -> list[str]:
    names = path.split("/")
    if any(name.strip() in ("", ".", "..") for name in names):
        raise CannotExport(
            f"the entry {path!r} cannot be a file, because its path has a name that is empty, '.' or '..'; move the "
            "entry to another path, and export the new version"
        )
    return [_safe_name(name) for name in names]


def _safe_name(name: str) -> str:
    safe = safe_file_name(name)
    stem, dot, ending = safe.partition(".")
    return f"{stem}_{dot}{ending}" if stem.strip().casefold() in _DEVICES else safe
