"""Worker process that is started as `marey serve` starts one, and that also knows the job kinds of tests."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tests.support.fake_server import FakeServer

KINDS_OF_TESTS = Path(__file__).parents[1] / "unit" / "worker" / "thirdparty"
"""Distribution with the kinds of job that only tests know."""


def python_path() -> str:
    """Return the PYTHONPATH of a process that knows the job kinds of tests."""
    return os.pathsep.join(filter(None, [str(KINDS_OF_TESTS), os.environ.get("PYTHONPATH")]))


class AttachedWorker:
    """A worker process that reads its token from its standard input, and ends when this input is closed.

    Its log is a file in `folder`. With a `token_file`, the worker reads the token from this file instead, and does not
    end with its standard input.
    """

    LOG = "worker.log"

    def __init__(
        self,
        server: FakeServer,
        folder: Path,
        *options: str,
        env: dict[str, str] | None = None,
        token_file: Path | None = None,
    ) -> None:
        self.log = folder / self.LOG
        credential = ["--attached"] if token_file is None else ["--token-file", str(token_file)]
        command = [sys.executable, "-m", "marey_worker", *credential, "--server", server.url]
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "--cache", str(folder / "cache"), *options],
                stdin=subprocess.PIPE,
                stderr=log,
                env={**os.environ, "PYTHONPATH": python_path(), **(env or {})},
            )
        self.process.stdin.write(b"marey_worker_token\n")
        self.process.stdin.flush()

    def stop(self) -> int:
        """Stop the worker with SIGTERM, and return its exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(60)

    def close(self) -> None:
        """Kill the worker if it is still running."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        self.process.stdin.close()


StartWorker = Callable[..., AttachedWorker]
"""Function that starts a worker with the given options; `env` adds variables to the worker's environment."""
