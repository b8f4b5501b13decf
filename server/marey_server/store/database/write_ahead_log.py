"""Write-ahead log of an SQLite database.

A commit appends pages to the log. From time to time these pages must be copied into the database file, so that the log
can start again from its beginning. By default, SQLite copies the pages at the end of a commit, and all other writes
wait until the copy is complete. Here a thread copies the pages while writes go on. When few pages are left, the thread
that writes to the database copies them and restarts the log.

After a crash, SQLite reads the log when the database is opened. When the last connection to the database closes, SQLite
copies the rest of the log.
"""

from __future__ import annotations

import logging
import sqlite3
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from marey_server import faults

log = logging.getLogger(__name__)

PAGE_BYTES = 4096
"""Size, in bytes, of the pages of new databases; existing databases keep their page size (docs/decisions/0056)."""
HEADER_BYTES = 24
"""Size, in bytes, of the header of a page in the log."""
SHORT_BYTES = 4 * 2**20
"""Length of the log up to which nothing is copied. SQLite shortens the file to this length after restarting the log."""
LITTLE_BYTES = 3 * 2**20
"""Greatest number of bytes that the writing thread copies before it restarts the log."""
LONG_BYTES = 16 * 2**20
"""Length of the log above which uploads wait, so that the copying thread can keep pace."""
TOO_LONG_BYTES = 64 * 2**20
"""Length of the log above which the writing thread waits longer for readers in order to restart the log."""
PATIENCE_MS = 10
LONG_PATIENCE_MS = 250
"""Milliseconds to wait for readers if the log is longer than `TOO_LONG_BYTES`: enough for requests, not for backups."""
PAUSES = 20
"""Pause after readers prevented a restart of the log, as a multiple of the time spent waiting for the readers."""


class WriteAheadLog:
    """Write-ahead log of the database in a file."""

    def __init__(self, file: Path) -> None:
        self.is_long = False
        """Whether the log grows faster than it is copied; then writes of many bytes should wait."""
        self._file = file
        self._log = Path(f"{file}-wal")
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="marey-log")
        self._connection: sqlite3.Connection | None = None
        self._copying = False
        self._copied_bytes = 0
        self._next_try_s = 0.0
        self._failing = False

    def after_commit(self, connection: sqlite3.Connection) -> None:
        """Start a thread that copies a long log into the database; if little is left to copy, restart the log instead.

        `connection` has just committed. Only one thread may call this method at a time.
        """
        length = self._length_bytes()
        self.is_long = self._copying and length > LONG_BYTES
        if length <= SHORT_BYTES:
            self._copied_bytes = 0
        elif self._copying:
            return
        elif length - self._copied_bytes > LITTLE_BYTES:
            self._copying = True
            with suppress(RuntimeError):  # the process ends; the log is copied when the database is closed or opened
                self._thread.submit(self._copy)
        elif time.monotonic() >= self._next_try_s:
            self._restart(connection, LONG_PATIENCE_MS if length > TOO_LONG_BYTES else PATIENCE_MS)

    def close(self) -> None:
        """Wait for the copying thread, and close its connection."""
        self._thread.shutdown(wait=True)
        if self._connection is not None:
            self._connection.close()

    def _length_bytes(self) -> int:
        try:
            return self._log.stat().st_size
        except FileNotFoundError:
            return 0

    def _copy(self) -> None:
        """Copy the log in passes, until a pass copies at most `LITTLE_BYTES`."""
        try:
            copied_before = self._copied_bytes
            self._copied_bytes = self._copy_once()
            while self._copied_bytes - copied_before > LITTLE_BYTES:
                copied_before, self._copied_bytes = self._copied_bytes, self._copy_once()
        finally:
            self._copying = self.is_long = False

    def _copy_once(self) -> int:
        """Copy as much of the log as its readers allow; return how many bytes of the log have been copied so far."""
        try:
            if self._connection is None:
                self._connection = sqlite3.connect(self._file, isolation_level=None, check_same_thread=False)
            faults.point("log.before_copy")
            pages: int = self._connection.execute("PRAGMA wal_checkpoint(PASSIVE)").fetchone()[2]
            (page_bytes,) = self._connection.execute("PRAGMA page_size").fetchone()
            faults.point("log.after_copy")
        except sqlite3.Error as error:
            self._note_failure(error)
            return 0
        self._failing = False
        return max(pages, 0) * (int(page_bytes) + HEADER_BYTES)

    def _restart(self, connection: sqlite3.Connection, patience_ms: int) -> None:
        """Copy the rest of the log into the database, then restart the log.

        The log is not restarted if readers use it for longer than `patience_ms`.
        """
        (usual_ms,) = connection.execute("PRAGMA busy_timeout").fetchone()
        connection.execute(f"PRAGMA busy_timeout = {patience_ms}")
        try:
            in_use, _, _ = connection.execute("PRAGMA wal_checkpoint(RESTART)").fetchone()
        except sqlite3.Error as error:  # not a failure of the write, which is committed
            self._note_failure(error)
            in_use = True
        finally:
            connection.execute(f"PRAGMA busy_timeout = {usual_ms}")
        if in_use:
            self._next_try_s = time.monotonic() + PAUSES * patience_ms / 1000
        else:
            self._copied_bytes = 0

    def _note_failure(self, error: sqlite3.Error) -> None:
        """Warn about an error, but not about its repetitions; the next commit tries again to copy the log."""
        if not self._failing:
            log.warning("the log of the database %s cannot be copied, and grows: %s", self._file, error)
        self._failing = True
