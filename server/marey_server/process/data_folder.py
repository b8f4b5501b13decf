"""Data folder of a server: created if it is missing, and closed to other users of the machine."""

from __future__ import annotations

import logging
import os
import stat
from pathlib import Path

from marey_server.process.settings import Settings
from marey_server.store.database.opening import sqlite_file

log = logging.getLogger(__name__)


def prepare_data_folder(settings: Settings) -> None:
    """Create the data folder, and take all rights of other users to it and to the files directly in it.

    An SQLite file is created here, because SQLite would let everybody read it; its log files get the rights that it
    has. Rights of a folder that belongs to somebody else stay as they are, with a warning.
    """
    settings.data.mkdir(parents=True, exist_ok=True, mode=0o700)
    for path in (settings.data, *settings.data.iterdir()):
        _close_to_others(path)
    if (file := sqlite_file(settings.resolved_database_url)) is not None and file.parent.is_dir():
        os.close(os.open(file, os.O_CREAT | os.O_RDWR, 0o600))


def _close_to_others(path: Path) -> None:
    try:
        mode = stat.S_IMODE(path.lstat().st_mode)
        if mode & 0o077 and not path.is_symlink():
            path.chmod(mode & 0o700)
    except FileNotFoundError:  # a file of SQLite that another process has just removed
        pass
    except PermissionError:
        log.warning("%s can be used by others, and belongs to another user, who alone can change that", path)
