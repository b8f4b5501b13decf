"""Rule: the subject of a commit is `area: imperative`, at most 72 characters, without a full stop.

As a hook: `python -m lint.commit_subject .git/COMMIT_EDITMSG`. Without a file, the newest commit is checked.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

MOST_CHARACTERS = 72
_SUBJECT = re.compile(r"[a-z][a-z0-9_./-]*(?:, [a-z][a-z0-9_./-]*)*: (\S+)(?: .*)?")
_MADE_BY_GIT = ("Merge ", 'Revert "', "fixup! ", "squash! ", "amend! ")


def faults_of(subject: str) -> list[str]:
    """Return a description of each fault of a subject; an empty list if the subject has no fault."""
    if subject.startswith(_MADE_BY_GIT):
        return []
    faults = []
    match = _SUBJECT.fullmatch(subject)
    if match is None:
        faults.append('write "area: what to do", as in "store: omit the password from Database.shown"')
    elif match[1].endswith(("ed", "ing")) and match[1] not in ("embed", "feed", "need", "speed", "string"):
        faults.append(f"write what to do, in the imperative: {match[1]!r} is none")
    if len(subject) > MOST_CHARACTERS:
        faults.append(f"{len(subject)} characters, more than {MOST_CHARACTERS}; the body has room")
    if subject.endswith("."):
        faults.append("no full stop at the end")
    return faults


def main(arguments: list[str]) -> int:
    """Check the subject in the named file, or the subject of the newest commit; return the exit status."""
    if arguments:
        message = Path(arguments[0]).read_text("utf-8")
    else:
        message = subprocess.run(["git", "log", "-1", "--format=%s"], capture_output=True, text=True, check=True).stdout
    subject = next((line for line in message.splitlines() if line and not line.startswith("#")), "")
    faults = faults_of(subject)
    for fault in faults:
        sys.stderr.write(f"{subject!r}: {fault}\n")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
