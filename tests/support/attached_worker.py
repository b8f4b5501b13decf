"""Worker process that is started as `marey serve` starts one, and that also knows the job kinds of tests."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from tests.support.fake_server import FakeServer
from tests.support.forked_programs import ForkedProgram, nursery
from tests.support.patience import PATIENCE_S

KINDS_OF_TESTS = Path(__file__).parents[1] / "unit" / "worker" / "thirdparty"
"""Distribution with the kinds of job that only tests know."""
NAMES_OF_KINDS = ("add", "misbehave", "tally", "make")
"""Names of these kinds. Their modules take less time to load than the modules of the built-in kinds."""


def python_path() -> str:
    """Return the PYTHONPATH of a process that knows the job kinds of tests."""
    return os.pathsep.join(filter(None, [str(KINDS_OF_TESTS), os.environ.get("PYTHONPATH")]))


class AttachedWorker:
    """A worker process that reads its token from its standard input, and ends when this input is closed.

    Its log is a file in `folder`. With a `token_file`, the worker reads the token from there, and does not end with
    its standard input. Unless `options` name kinds of job, the worker runs only the kinds of tests. The
    process is forked by the nursery; with `forked=False` it is new, so that `/proc` shows its own arguments.
    """

    LOG = "worker.log"

    def __init__(
        self,
        server: FakeServer,
        folder: Path,
        *options: str,
        env: dict[str, str] | None = None,
        token_file: Path | None = None,
        forked: bool = True,
    ) -> None:
        self.log = folder / self.LOG
        credential = ["--attached"] if token_file is None else ["--token-file", str(token_file)]
        kinds = [] if "--kind" in options else [word for name in NAMES_OF_KINDS for word in ("--kind", name)]
        arguments = ["marey_worker", *credential, "--server", server.url, "--cache", str(folder / "cache"), *kinds]
        environment = {**os.environ, "PYTHONPATH": python_path(), **(env or {})}
        with self.log.open("ab") as log:
            self.process: ForkedProgram | subprocess.Popen[bytes]
            if forked:
                self.process = nursery().start(
                    [*arguments, *options], environment, output=log.fileno(), with_stdin=True
                )
            else:
                command = [sys.executable, "-m", *arguments, *options]
                self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log, env=environment)
        assert self.process.stdin is not None
        self.process.stdin.write(b"marey_worker_token\n")
        self.process.stdin.flush()

    def stop(self) -> int:
        """Stop the worker with SIGTERM, and return its exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(PATIENCE_S)

    def close(self) -> None:
        """Kill the worker if it is still running."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        assert self.process.stdin is not None
        self.process.stdin.close()


StartWorker = Callable[..., AttachedWorker]
"""Function that starts a worker with the given options; `env` adds variables to the worker's environment."""
