"""Runs of the TypeScript tests in `web/`, which get what they need from Python by environment variables."""

from __future__ import annotations

import os
import subprocess

from hatch_build import SOURCES

LONGEST_S = 840.0
"""Longest duration of a run, in seconds; tests that start one have a higher limit, so that its output is shown."""


def run_vitest(project: str, *files: str, **variables: str) -> None:
    """Run test files of a project of vitest with further environment variables; print the times that they measure."""
    command = ["node", "node_modules/vitest/vitest.mjs", "run", "--project", project, *files]
    done = subprocess.run(
        command, cwd=SOURCES, env=os.environ | variables | {"NO_COLOR": "1"}, check=False, capture_output=True,
        text=True, timeout=LONGEST_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    print(*(line for line in done.stdout.splitlines() if line.startswith("time: ")), sep="\n")  # pytest -s shows them
