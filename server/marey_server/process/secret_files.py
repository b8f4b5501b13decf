"""Files that contain one secret and nothing else."""

from __future__ import annotations

from pathlib import Path


def read_secret(file: Path) -> str:
    """Return the secret that a file contains. Raises `ValueError`, with the reason, if the file cannot be read."""
    try:
        return file.read_text(encoding="utf-8").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise ValueError(
            f"{file} cannot be read: {reason}; this setting must name a UTF-8 text file that the server may read"
        ) from None
