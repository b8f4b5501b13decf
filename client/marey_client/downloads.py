"""Downloads of files: written under a temporary name, renamed when complete."""

from __future__ import annotations

import os
import re
import shutil
import threading
import unicodedata
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from email.message import Message
from email.utils import collapse_rfc2231_value
from io import BufferedRandom
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING

from marey_client.transport import Params, Transport

if TYPE_CHECKING:
    import httpx

_NOT_IN_A_NAME = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|]+')
_DEVICE_FOLDERS = (Path("/dev"), Path("/dev/fd"))
"""Folders with links to open files, which a renamed file would replace for all programs of the machine."""
LONGEST_NAME_BYTES = 240
"""Greatest length of a file name in bytes; file systems allow 255, so a number can still be added to the name."""
LONGEST_ENDING = 16


@contextmanager
def saved_atomically(target: str | Path) -> Iterator[BufferedRandom]:
    """Yield a temporary file; rename it to `target` at the end of the `with` block, or delete it if the block fails.

    The temporary file of a pipe or a device, such as /dev/stdout, is copied to `target` instead.
    """
    target = Path(target)
    if target.is_fifo() or target.is_char_device() or target.parent in _DEVICE_FOLDERS:
        with TemporaryFile("w+b") as file, target.open("wb") as stream:
            yield file
            file.seek(0)
            shutil.copyfileobj(file, stream)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name[:32]}.{uuid.uuid4().hex}")
    try:
        with temporary.open("x+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(target)  # a disk that is full does not say where
        raise


def write_whole(target: str | Path, content: bytes | str) -> None:
    """Write a file, and the folders that it needs; if this fails, an earlier file at `target` stays as it was."""
    with saved_atomically(target) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def safe_file_name(name: str, ending: str = "") -> str:
    """Return `name` without characters that file systems refuse or treat as a path, with `ending` added.

    A long name is cut, but keeps its own ending and gets all of `ending`.
    """
    clean, most = _NOT_IN_A_NAME.sub("_", name).strip(". ") or "unnamed", LONGEST_NAME_BYTES - len(ending.encode())
    if len(clean.encode()) <= most:
        return clean + ending
    own = Path(clean).suffix if len(Path(clean).suffix) <= LONGEST_ENDING else ""
    room = most - len(own.encode())
    return clean.removesuffix(own).encode()[:room].decode(errors="ignore") + own + ending


class TakenPaths:
    """Paths of the files of one download; if two files have the same name, a number is added to the later name."""

    def __init__(self) -> None:
        self._taken: set[str] = set()
        self._lock = threading.Lock()

    def take(self, target: Path) -> Path:
        """Return `target`, or `target` with a number added if this path is taken already.

        Upper and lower case count as equal, as on many file systems.
        """
        with self._lock:
            free, number = target, 1
            while (key := unicodedata.normalize("NFC", str(free)).casefold()) in self._taken:
                number += 1
                free = target.with_name(f"{target.stem} ({number}){target.suffix}")
            self._taken.add(key)
            return free


def download(
    transport: Transport,
    path: str,
    folder: str | Path,
    *,
    params: Params | None = None,
    name: str,
    beside: TakenPaths | None = None,
) -> Path:
    """Download a file to `folder` under the name that the server gives it, by default `name`; return its path.

    `beside` contains the paths of files that were written before as part of the same download; if one of these files
    has the same name, a number is added to the new name. Any other existing file of this name is replaced.
    """
    places = TakenPaths() if beside is None else beside
    target: Path | None = None

    def once() -> Path:
        nonlocal target
        with transport.stream(path, params=params) as response:
            if target is None:
                offered = _offered_name(response.headers.get("Content-Disposition"))
                target = places.take(Path(folder) / safe_file_name(offered or name))
            _save(response, target)
        return target

    return transport.repeat(once, repeatable=True, what=f"GET {path}")


def download_to(transport: Transport, path: str, target: Path, *, params: Params | None = None) -> None:
    """Download a file to the path `target`, ignoring the file name that the server sends; replace an existing file."""

    def once() -> None:
        with transport.stream(path, params=params) as response:
            _save(response, target)

    transport.repeat(once, repeatable=True, what=f"GET {path}")


def _save(response: httpx.Response, target: Path) -> None:
    with saved_atomically(target) as file:
        for chunk in response.iter_bytes():
            file.write(chunk)


def _offered_name(disposition: str | None) -> str | None:
    if not disposition:
        return None
    header = Message()
    header["Content-Disposition"] = disposition
    names = [value for key, value in header.get_params([], "content-disposition") if key == "filename"]
    # The one with a character set has all characters, and comes before the plain one (RFC 6266).
    names.sort(key=lambda value: not isinstance(value, tuple))
    return collapse_rfc2231_value(names[0]) if names else None
