"""Functions that tests run in child processes of the server."""

import os
import signal
import time
from pathlib import Path
from typing import NoReturn

from marey_server.errors import InvalidProblem


def echo(payload: bytes) -> bytes:
    """Return the payload and the id of the process."""
    return payload + f" {os.getpid()}".encode()


def environment(_payload: bytes) -> bytes:
    """Return all environment variables of the process."""
    return "\n".join(f"{name}={text}" for name, text in os.environ.items()).encode()


def refuse(_payload: bytes) -> bytes:
    """Raise `InvalidProblem`, as a function that refuses its input does."""
    raise InvalidProblem("no walk", code="no-walk")


def fail(_payload: bytes) -> bytes:
    """Raise `KeyError`, as a function with a defect may do."""
    raise KeyError("walk")


def eat(_payload: bytes) -> bytes:
    """Try to allocate more memory than the process may use."""
    return b"x" * (1 << 40)


def burn(_payload: bytes) -> NoReturn:
    """Use the processor without end."""
    while True:
        pass


def note_and_call(payload: bytes) -> bytes:
    """Write the process id to a file, and call a function of this module; `payload` is "<path> <function>"."""
    path, name = payload.decode().rsplit(" ", 1)
    Path(path).write_text(str(os.getpid()))
    answer: bytes = globals()[name](b"")
    return answer


def wait_for(payload: bytes) -> bytes:
    """Write the process id to the file named by `payload`; wait until a file with the same stem and `.go` exists."""
    noted = Path(payload.decode())
    noted.with_suffix(".part").write_text(str(os.getpid()))
    noted.with_suffix(".part").rename(noted)
    while not noted.with_suffix(".go").exists():
        time.sleep(0.01)
    return b"waited"


def wait_in_import(order: bytes) -> bytes:
    """Read an imported file that contains a path, and do what `wait_for` does with this path."""
    from marey_server.motions.reading import FileOrder  # which loads far more than the other functions need

    return wait_for(FileOrder.unpack(order).content)


def stop(payload: bytes) -> bytes:
    """Write the process id to the file named by `payload`; then suspend the process, so that it never answers."""
    Path(payload.decode()).write_text(str(os.getpid()))
    os.kill(os.getpid(), signal.SIGSTOP)
    return b""


def crash(_payload: bytes) -> bytes:
    """End the process by a segmentation fault."""
    os.kill(os.getpid(), signal.SIGSEGV)
    return b""
