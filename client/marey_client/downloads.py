"""Files that arrive: written under a temporary name, renamed when they are whole."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from email.message import Message
from io import BufferedRandom
from pathlib import Path

from marey_client.transport import Params, Transport

_NOT_IN_A_NAME = re.compile(r'[\x00-\x1f\x7f/\\:*?"<>|]+')


@contextmanager
def saved_atomically(target: str | Path) -> Iterator[BufferedRandom]:
    """A file to write and read that becomes `target` at the end, and vanishes if the block fails."""
    target = Path(target)
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


def safe_file_name(name: str) -> str:
    """`name` without anything that a file system could take for a path or refuse."""
    return _NOT_IN_A_NAME.sub("_", name).strip(". ")[:200] or "unnamed"


def download(transport: Transport, path: str, folder: str | Path, *, params: Params | None = None, name: str) -> Path:
    """Fetch a file into `folder` under the name the server gives it, or `name`; answer where it is."""

    def once() -> Path:
        with transport.stream(path, params=params) as response:
            target = Path(folder) / safe_file_name(_offered_name(response.headers.get("Content-Disposition")) or name)
            with saved_atomically(target) as file:
                for chunk in response.iter_bytes():
                    file.write(chunk)
        return target

    return transport.repeat(once, repeatable=True, what=f"GET {path}")


def _offered_name(disposition: str | None) -> str | None:
    if not disposition:
        return None
    header = Message()
    header["Content-Disposition"] = disposition
    return header.get_filename()
