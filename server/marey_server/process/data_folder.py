"""Data folder of a server: it is created if it is missing, and other users of the machine have no access to it."""

from __future__ import annotations

import logging
import os
import stat
from pathlib import Path

from marey_schemas.address import ADMIN_TOKEN_FILE, SETTINGS_FILE
from marey_server.process.disk_space import RESERVE_FILE, make_reserve
from marey_server.process.settings import Settings
from marey_server.store.database.opening import sqlite_file

BLOB_FOLDER = "blobs"
WORKER_CACHE = "worker-cache"
WORKER_TOKENS = "worker-tokens"
WORKER_LOGS = "worker-logs"
INDEX_COPIES = "motion-indexes"

log = logging.getLogger(__name__)


def worker_token_file(data: Path, pool: str) -> Path:
    """Return the file below the data folder that contains the token of a pool of workers."""
    return data / WORKER_TOKENS / pool


def prepare_data_folder(settings: Settings) -> None:
    """Create the data folder, and deny other users access to the server's files and folders in this folder.

    Access to the data folder itself is denied as well, unless it contains files that do not belong to the server. An
    SQLite file is created here, because SQLite would let everybody read it; SQLite gives its log files the same rights
    as the database file.
    """
    settings.data.mkdir(parents=True, exist_ok=True, mode=0o700)
    folder = settings.data.resolve()
    make_reserve(folder)
    folders = (BLOB_FOLDER, WORKER_CACHE, WORKER_TOKENS, WORKER_LOGS, INDEX_COPIES)
    own = {folder / name for name in (ADMIN_TOKEN_FILE, *folders, RESERVE_FILE, SETTINGS_FILE)}
    file = sqlite_file(settings.resolved_database_url)
    if file is not None and file.parent.is_dir():
        os.close(os.open(file, os.O_CREAT | os.O_RDWR, 0o600))
        file = file.resolve()
        own |= {file.with_name(file.name + ending) for ending in ("", "-wal", "-shm", "-journal")}
    for path in own:
        _close_to_others(path)
    if own.issuperset(folder.iterdir()):
        _close_to_others(folder)
    elif stat.S_IMODE(folder.stat().st_mode) & 0o077:
        log.warning("%s contains other files, so it stays open to other users; choose a folder for Marey alone", folder)


def _close_to_others(path: Path) -> None:
    try:
        mode = stat.S_IMODE(path.lstat().st_mode)
        if mode & 0o077 and not path.is_symlink():
            path.chmod(mode & ~0o077)
    except FileNotFoundError:  # not every server has every file
        pass
    except OSError as error:
        log.warning("%s stays open to other users: %s", path, error.strerror)
