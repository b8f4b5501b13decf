"""The command line, as somebody in a folder of their own runs it."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from server_process import ServerProcess


@pytest.fixture
def run(server: ServerProcess, tmp_path: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the command line against the server, in a folder of its own."""

    def run(*arguments: object, status: int = 0, stdin: str = "") -> subprocess.CompletedProcess[str]:
        surroundings = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
        known = {"MAREY_URL": server.url, "MAREY_DATA": str(server.data), "HOME": str(tmp_path)}
        done = subprocess.run(
            [sys.executable, "-m", "marey_client.cli", *map(str, arguments)],
            env={**surroundings, **known, "XDG_CONFIG_HOME": str(tmp_path)},
            capture_output=True, text=True, input=stdin, cwd=tmp_path, timeout=240,
        )  # fmt: skip
        assert done.returncode == status, done.stdout + done.stderr
        return done

    return run
