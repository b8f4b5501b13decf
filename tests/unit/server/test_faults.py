"""Fault points: they do nothing unless the environment requests a fault, and then exactly this fault."""

import errno
import subprocess
import sys
from subprocess import CompletedProcess

import pytest

from marey_server import faults


def passing(fault: str, passes: int = 3, name: str = "here") -> CompletedProcess[bytes]:
    loop = f"for n in range({passes}):\n    print(n, flush=True)\n    faults.point({name!r})"
    code = f"from marey_server import faults\n{loop}"
    return subprocess.run([sys.executable, "-c", code], env={"MAREY_FAULT": fault}, capture_output=True, timeout=30)


def test_nothing_happens_unless_asked() -> None:
    faults.point("anything")
    assert passing("").stdout.split() == [b"0", b"1", b"2"]
    assert passing("elsewhere:kill").returncode == 0


def test_the_process_dies_at_the_pass_asked_for() -> None:
    first, third = passing("here:kill"), passing("elsewhere:kill,here@3:kill", passes=5)
    assert (first.returncode, first.stdout.split()) == (-9, [b"0"])
    assert (third.returncode, third.stdout.split()) == (-9, [b"0", b"1", b"2"])


def test_a_full_disk_is_played(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(faults, "_faults", [faults._Fault("here:error")])
    with pytest.raises(OSError, match="here") as error:
        faults.point("here")
    assert error.value.errno == errno.ENOSPC


def test_an_unknown_action_is_refused_at_once() -> None:
    assert b"kill, stop or error" in passing("here:explode").stderr
