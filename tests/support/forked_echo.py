"""Fork server for tests, whose child processes answer messages with process ids, or exit if a message says so."""

from __future__ import annotations

import errno
import os
import sys
import threading
import time
from multiprocessing.connection import Connection

from marey_schemas.processes.child_process import READY, connect_to_parent
from marey_schemas.processes.forking import fork_children

LOADED = os.getpid()
"""Id of the process that loaded this module."""


def answer(pipe: Connection) -> None:
    """Answer each message with four ids, until the pipe closes; the messages `fail` and `exit N` end the process.

    The ids are those of the process that loaded this module, the parent process, this process, and this process's
    session.
    """
    while True:
        try:
            message = pipe.recv_bytes()
        except EOFError:
            return
        if message == b"fail":
            raise ValueError("the message was `fail`")
        if message.startswith(b"exit "):
            os._exit(int(message[5:]))
        pipe.send_bytes(f"{LOADED} {os.getppid()} {os.getpid()} {os.getsid(0)}".encode())


def refuse() -> int:
    """Raise `BlockingIOError`, as `os.fork` does if the system has no memory left."""
    raise BlockingIOError(errno.EAGAIN, "no memory is left")


if __name__ == "__main__":
    control = connect_to_parent()
    if sys.argv[2:] == ["broken"]:
        sys.exit(3)
    if sys.argv[2:] == ["numeric"]:
        import numpy as np

        np.ones((200, 200)) @ np.ones((200, 200))
    if sys.argv[2:] == ["full"]:
        forks = iter([refuse])
        fork = os.fork
        os.fork = lambda: next(forks, fork)()
    if sys.argv[2:] == ["threaded"]:
        threading.Thread(target=threading.Event().wait, daemon=True).start()
    if sys.argv[2:] == ["ending"]:
        threading.Thread(target=time.sleep, args=[0.3], daemon=True).start()
    control.send_bytes(READY)
    fork_children(control, answer)
