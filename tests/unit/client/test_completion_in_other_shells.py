"""Completion in real shells other than bash: each runs its script, and the script runs `marey`."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.support.patience import PATIENCE_S

PATH = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
"""Folders of programs, first that of `marey`."""


def environment(folder: Path) -> dict[str, str]:
    """Return the variables of a shell whose user has no logins and no server."""
    others = {name: text for name, text in os.environ.items() if not name.startswith("MAREY_")}
    return {**others, "PATH": PATH, "HOME": str(folder), "XDG_CONFIG_HOME": str(folder), "TERM": "dumb"}


@pytest.mark.fish
def test_fish_completes_words_that_are_typed_in_part(tmp_path: Path) -> None:
    (tmp_path / "walk.bvh").touch()
    lines = ("marey ls lab --ki", "marey dataset chec", "marey upload wal")
    script = "marey --show-completion fish | source\n" + "".join(f"complete -C '{line}'\n" for line in lines)
    done = subprocess.run(
        ["fish", "--no-config"], input=script, capture_output=True, text=True, env=environment(tmp_path), cwd=tmp_path
    )
    found = [line.partition("\t")[0] for line in done.stdout.splitlines()]
    assert (found, done.stderr) == (["--kind", "checkout", "walk.bvh"], "")


@pytest.mark.zsh
def test_zsh_completes_words_that_are_typed_in_part(tmp_path: Path) -> None:
    (tmp_path / "walk.bvh").touch()
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(tmp_path)
        os.execvpe("zsh", ["zsh", "-f", "-i"], environment(tmp_path))
    try:
        start = 'autoload -U compinit; compinit -u -D; eval "$(marey --show-completion zsh)"; echo re""ady\n'
        os.write(terminal, start.encode())
        assert "ready" in read_until(terminal, "ready\r\n")
        for typed, completed in (
            ("marey ls lab --ki", "--kind "),
            ("marey dataset chec", "checkout "),
            ("marey upload wal", "walk.bvh "),
        ):
            os.write(terminal, f"\x15{typed}\t".encode())  # the first key deletes the line
            assert completed in read_until(terminal, completed)
    finally:
        os.write(terminal, b"\x15exit\n")
        os.close(terminal)
        os.waitpid(process, 0)


def read_until(terminal: int, text: str) -> str:
    """Return what a terminal shows until it shows a text, or until nobody would wait any longer."""
    shown, deadline = b"", time.monotonic() + PATIENCE_S
    while text.encode() not in shown and time.monotonic() < deadline:
        if select.select([terminal], [], [], 1.0)[0]:
            shown += os.read(terminal, 4096)
    return shown.decode(errors="replace")
