"""Command line, run as a user in a separate folder."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from tests.support.server_process import ServerProcess

from marey_client.cli import main

WIDTH = "80"
"""Width in columns to which help texts are wrapped, independent of the terminal in which tests run."""


@dataclass(frozen=True)
class CommandLine:
    """The command `marey`, run in `folder`; an environment variable contains the address of `server`."""

    server: ServerProcess
    folder: Path

    def __call__(
        self, *arguments: object, status: int = 0, stdin: str = "", **environment: str
    ) -> subprocess.CompletedProcess[str]:
        """Run a command in this process and return its output; fail if its exit status is not `status`."""
        words = list(map(str, arguments))
        with mock.patch.dict(os.environ, self._environment(environment), clear=True), contextlib.chdir(self.folder):
            done = run_here(words, stdin)
        assert done.returncode == status, done.stdout + done.stderr
        return done

    def execute(self, code: str, names: dict[str, Any], origin: str) -> str:
        """Run Python code as a script that shares `names`; return what it prints. `origin` names its file."""
        told = io.StringIO()
        surroundings = mock.patch.dict(os.environ, self._environment({}), clear=True)
        with surroundings, contextlib.chdir(self.folder), contextlib.redirect_stdout(told):
            exec(compile(code, origin, "exec"), names)
        return told.getvalue()

    def start(self, *arguments: object) -> subprocess.Popen[str]:
        """Start a command in a separate process, and return the process, whose output can be read."""
        return subprocess.Popen(
            [sys.executable, "-m", "marey_client.cli", *map(str, arguments)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=self.folder, env=self._environment({}),
            preexec_fn=_hear_interrupts,
        )  # fmt: skip

    def _environment(self, more: dict[str, str]) -> dict[str, str]:
        others = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
        known = {"MAREY_SERVER": self.server.url, "MAREY_DATA": str(self.server.data), "COLUMNS": WIDTH}
        return {**others, **known, "HOME": str(self.folder), "XDG_CONFIG_HOME": str(self.folder), **more}


def run_here(arguments: list[str], stdin: str = "") -> subprocess.CompletedProcess[str]:
    """Run `marey` in this process and return its result; its output streams are no terminal, like a pipe."""
    given, out, err = (io.TextIOWrapper(io.BytesIO(text), encoding="utf-8") for text in (stdin.encode(), b"", b""))
    streams = mock.patch.multiple(sys, argv=["marey", *arguments], stdin=given, stdout=out, stderr=err)
    status: object = 0
    with streams, _logging_restored():
        try:
            main()
        except SystemExit as ended:
            status = ended.code or 0
    assert isinstance(status, int), status
    return subprocess.CompletedProcess(arguments, status, _written(out), _written(err))


def _written(stream: io.TextIOWrapper) -> str:
    stream.flush()
    buffer = stream.buffer
    assert isinstance(buffer, io.BytesIO)
    return buffer.getvalue().decode()


@contextlib.contextmanager
def _logging_restored() -> Iterator[None]:
    """Restore the handlers and the level of the log after the `with` block, since `--verbose` changes them."""
    root = logging.getLogger()
    handlers, level = list(root.handlers), root.level
    try:
        yield
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)


def _hear_interrupts() -> None:
    """Let Ctrl-C end this process, which otherwise ignores it if the parent process ignores it."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
