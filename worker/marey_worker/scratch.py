"""Folders for the files of attempts, in the folder for temporary files; those of killed workers are removed."""

from __future__ import annotations

import fcntl
import logging
import os
import secrets
import stat
import tempfile
import time
from pathlib import Path

log = logging.getLogger(__name__)

PREFIX = "marey-job-"
YOUNG_S = 60.0
"""Seconds for which an unlocked folder is kept, because another worker may be about to lock it."""


class ScratchFolder:
    """Folder for the files of one attempt.

    The folder is locked until the attempt ends. If the worker is killed, the operating system releases the lock, and
    the next worker on this machine removes the folder (`remove_abandoned`).
    """

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
        self._lock = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
        fcntl.flock(self._lock, fcntl.LOCK_EX)

    def remove(self) -> None:
        """Remove the folder with its content. Raises `OSError` if something cannot be removed."""
        try:
            remove_folder(self.path)
        finally:
            os.close(self._lock)


def remove_abandoned() -> None:
    """Remove the folders of this user's attempts that no process has locked."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        try:
            if _is_abandoned(folder):
                remove_folder(folder)
                log.info("%s is removed, because the worker that used it was killed", folder)
        except FileNotFoundError:
            continue  # another worker has removed it
        except OSError as error:
            log.warning("%s was left by a worker that was killed, and cannot be removed: %s", folder, error)


def _is_abandoned(folder: Path) -> bool:
    """Return whether a folder belongs to this user, has not changed for `YOUNG_S` seconds, and is not locked.

    Links are never followed, and other users' folders are left: their owner could put a link in the place of the
    folder while it is being removed.
    """
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid() or time.time() - found.st_mtime < YOUNG_S:
        return False
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(lock)
    return True


def remove_folder(folder: Path) -> None:
    """Remove a folder with its content, if it exists; links are removed, not followed.

    No process may write to the folder any more. Before a subfolder is emptied, it is moved to the top, because a script
    can nest folders deeper than a path can be long. Raises `OSError` if something cannot be removed.
    """
    prefix = secrets.token_hex(8)
    waiting, count = [folder] if folder.is_dir() else [], 0
    while waiting:
        emptied = waiting.pop()
        emptied.chmod(0o700)
        with os.scandir(emptied) as entries:
            for entry in list(entries):
                if not entry.is_dir(follow_symlinks=False):
                    os.unlink(entry.path)
                    continue
                os.chmod(entry.path, 0o700)
                count += 1
                waiting.append(folder / f"{prefix}-{count}")
                os.rename(entry.path, waiting[-1])
        if emptied != folder:
            emptied.rmdir()
    if folder.is_dir():
        folder.rmdir()
