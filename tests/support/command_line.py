"""The command line, as somebody in a folder of their own runs it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.support.server_process import ServerProcess

TIME_S = 300.0


@dataclass(frozen=True)
class CommandLine:
    """`marey` in `folder`, where somebody has told it of `server`."""

    server: ServerProcess
    folder: Path

    def __call__(
        self, *arguments: object, status: int = 0, stdin: str = "", **environment: str
    ) -> subprocess.CompletedProcess[str]:
        """Run a command to its end, which must have this exit status."""
        done = subprocess.run(
            self._words(arguments),
            capture_output=True, text=True, input=stdin, cwd=self.folder, timeout=TIME_S,
            env=self._surroundings(environment),
        )  # fmt: skip
        assert done.returncode == status, done.stdout + done.stderr
        return done

    def start(self, *arguments: object) -> subprocess.Popen[str]:
        """Start a command and go on; what it prints can be read, and it can be interrupted."""
        return subprocess.Popen(
            self._words(arguments),
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=self.folder, env=self._surroundings({}),
            preexec_fn=_hear_interrupts,
        )  # fmt: skip

    def _words(self, arguments: tuple[object, ...]) -> list[str]:
        return [sys.executable, "-m", "marey_client.cli", *map(str, arguments)]

    def _surroundings(self, more: dict[str, str]) -> dict[str, str]:
        others = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
        known = {"MAREY_URL": self.server.url, "MAREY_DATA": str(self.server.data)}
        return {**others, **known, "HOME": str(self.folder), "XDG_CONFIG_HOME": str(self.folder), **more}


def _hear_interrupts() -> None:
    """Whoever runs the tests in the background may have them ignore interrupts, which processes pass on."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
