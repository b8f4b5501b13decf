"""Git repositories on this machine, whose commits tests run as scripts."""

from __future__ import annotations

import subprocess
from pathlib import Path


def committed(folder: Path, files: dict[str, str]) -> tuple[str, str]:
    """Commit files to a new repository; return its address and the name of the commit."""
    folder.mkdir()
    for name, text in files.items():
        (folder / name).write_text(text)
    who = ["-c", "user.name=tester", "-c", "user.email=tester@example.org"]
    for words in (["init", "-q"], ["add", "."], [*who, "commit", "-q", "-m", "files"]):
        subprocess.run(["git", "-C", str(folder), *words], check=True)
    found = subprocess.run(["git", "-C", str(folder), "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    return f"file://{folder}", found.stdout.strip()
