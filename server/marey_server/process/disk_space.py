"""Free space on the disk of the data folder: a minimum below which nothing is stored, and a reserve for starting.

On a full disk, a server can neither start nor delete data, because SQLite needs space for its log. So a reserve file
occupies some space. The file is deleted when the disk is full, and created again at the next start with enough free
space.
"""

from __future__ import annotations

import logging
import os
import shutil
import time
from pathlib import Path

from marey_schemas.sizes import MIB
from marey_server.errors import StorageFullProblem

RESERVE_FILE = "reserve"
RESERVE_BYTES = 16 * MIB
LOOK_AGAIN_S = 1.0

log = logging.getLogger(__name__)


class DiskSpace:
    """Free space of the disk that holds a folder; below `floor_bytes`, `require` allows nothing to be stored."""

    def __init__(self, folder: Path, floor_bytes: int) -> None:
        self._folder = folder
        self._floor_bytes = floor_bytes
        self._low = False
        self._looked_s = -LOOK_AGAIN_S

    def fault(self) -> str | None:
        """Return the reason why nothing can be stored, as a text for operators, or None if there is enough space."""
        if not self._is_low():
            return None
        floor = self._floor_bytes // MIB
        return f"the disk of {self._folder} has less than {floor} MiB free (min_free_bytes); purge or move data"

    def require(self) -> None:
        """Raise `StorageFullProblem` if the disk has too little free space to store anything."""
        if self._is_low():
            raise StorageFullProblem(
                "The disk of the server is full, so nothing was written. Requests that delete data are still accepted."
            )

    def _is_low(self) -> bool:
        now_s = time.monotonic()
        if now_s - self._looked_s >= LOOK_AGAIN_S:
            self._looked_s = now_s
            self._low = self._folder.exists() and free_bytes(self._folder) < self._floor_bytes
        return self._low


def free_bytes(folder: Path) -> int:
    """Return the free bytes of a folder's disk.

    If fewer than `RESERVE_BYTES` are free, first delete the reserve file.
    """
    free, file = shutil.disk_usage(folder).free, folder / RESERVE_FILE
    if free >= RESERVE_BYTES or not file.exists():
        return free
    log.warning("the disk of %s is full; removing its reserve file %s", folder, file.name)
    file.unlink(missing_ok=True)
    return shutil.disk_usage(folder).free


def make_reserve(folder: Path) -> None:
    """Write the reserve file if it does not exist and at least 8 times `RESERVE_BYTES` are free.

    If the disk is full, an existing reserve file is deleted (`free_bytes`).
    """
    file = folder / RESERVE_FILE
    free = free_bytes(folder)
    if file.exists() or free < 8 * RESERVE_BYTES:
        return
    with open(os.open(file, os.O_WRONLY | os.O_CREAT, 0o600), "wb") as reserve:
        for _ in range(RESERVE_BYTES // MIB):
            reserve.write(bytes(MIB))
