"""Messages to a child process that has been killed."""

import os
import signal
import threading

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
