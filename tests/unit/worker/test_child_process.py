"""Messages to a child process that has been killed."""

import os
import signal
import sys
import threading

import psutil
import pytest

from marey_schemas.processes.child_process import ChildProcess

MORE_THAN_THE_PIPE_HOLDS = bytes(8 << 20)


@pytest.fixture
def child() -> ChildProcess:
    return ChildProcess("marey_worker.child", threads=1)


def test_a_message_to_a_killed_child_is_dropped(child: ChildProcess) -> None:
    child.kill(grace_s=0.0)
    child.send(b"late")


def test_killing_a_child_ends_the_sending_of_a_message_that_it_does_not_read(child: ChildProcess) -> None:
    os.kill(child.pid, signal.SIGSTOP)
    sending = threading.Thread(target=child.send, args=[MORE_THAN_THE_PIPE_HOLDS])
    sending.start()
    child.kill(grace_s=0.0)
    sending.join(60)
    assert not sending.is_alive()


@pytest.fixture
def in_use(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """List with one value for each sent signal: whether its process id still belonged to a child process."""
    found: list[bool] = []
    send = os.killpg

    def note(number: int, sent: signal.Signals) -> None:
        found.append(number in {child.pid for child in psutil.Process().children()})
        send(number, sent)

    monkeypatch.setattr(os, "killpg", note)
    return found


def test_a_child_that_was_killed_gets_no_further_signal(child: ChildProcess, in_use: list[bool]) -> None:
    """After the end of the child, its process id may belong to another process."""
    child.kill(grace_s=0.0)
    in_use.clear()
    child.kill(grace_s=0.0)
    child.abort()
    assert in_use == []


def test_a_child_that_ended_by_itself_is_signalled_only_while_its_number_is_its_own(
    child: ChildProcess, in_use: list[bool]
) -> None:
    os.kill(child.pid, signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    assert not child.alive
    child.kill()
    assert in_use == ([True] if sys.platform == "linux" else [])  # there, descendants may still have to be killed
    assert child.wait() == -signal.SIGKILL
