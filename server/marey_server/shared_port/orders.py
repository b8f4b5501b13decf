"""Messages between the parent and a server process, over a pair of sockets.

One of the sockets is the process's standard input. Each side also notices by the pair of sockets that the other side
has ended. Nothing is passed in arguments or variables, because settings may contain a password.
"""

from __future__ import annotations

import json
import socket
from dataclasses import asdict, dataclass
from typing import Any, Self

PROGRAM = "marey_server.process_program"
"""Module that the parent runs as a server process."""
READY = b"ready\n"
"""Line that a process sends when it accepts connections."""
KEEP_WORKERS = b"keep-workers\n"
"""Line that the parent sends to the process that must run the workers from now on."""
MOST_LINE_BYTES = 1 << 20


@dataclass(frozen=True)
class StartOrder:
    """First message that a server process receives from its parent.

    `settings` are those that were given as options; the process reads variables and `marey.toml` itself. `sockets` are
    the descriptors of the listening sockets, and `metrics_sockets` those of the process's own port for metrics.
    """

    settings: dict[str, Any]
    sockets: tuple[int, ...]
    metrics_sockets: tuple[int, ...]
    first: bool
    """True if this is the first process of a server that starts: it prints the greeting and runs the workers."""

    def to_line(self) -> bytes:
        """Return the order as one line of JSON."""
        return json.dumps(asdict(self), default=str).encode() + b"\n"

    @classmethod
    def receive(cls, control: socket.socket) -> Self:
        """Wait for the first message and return it.

        Raises `EOFError` if the parent ends before it has sent the message.
        """
        line = bytearray()
        while not line.endswith(b"\n"):
            received = control.recv(1)  # so that nothing that follows the line is taken
            if not received or len(line) > MOST_LINE_BYTES:
                raise EOFError("the parent process has sent no complete order")
            line += received
        read = json.loads(line)
        return cls(read["settings"], tuple(read["sockets"]), tuple(read["metrics_sockets"]), read["first"])
