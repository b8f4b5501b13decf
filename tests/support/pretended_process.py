"""Program that tests of the parent run instead of a server process; the file `behaviour` selects its behaviour.

It reads its order as a server process does. Then it is ready and waits for SIGTERM or the end of the parent
(`serve`), ends at once (`fail`), or ends soon after it has become ready (`die`). It writes what it receives to a file.
"""

import os
import signal
import socket
import sys
import time
from pathlib import Path

from marey_server.shared_port.orders import READY, StartOrder


def main() -> int:
    """Read the file `behaviour` in the folder that the settings name, and do what it says; return the exit status."""
    control = socket.socket(fileno=os.dup(0))
    order = StartOrder.receive(control)
    folder = Path(order.settings["folder"])
    behaviour = (folder / "behaviour").read_text()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    if behaviour == "fail":
        return 3
    with (folder / "received").open("a") as received:
        received.write(f"started {os.getpid()} first={order.first} notices={'NOTIFY_SOCKET' in os.environ}\n")
        received.flush()
        assert all(socket.socket(fileno=os.dup(one)).getsockname() for one in order.sockets)
        control.sendall(READY)
        if behaviour == "die":
            time.sleep(0.05)
            return 4
        while line := control.recv(100):
            received.write(f"{os.getpid()} {line.decode()}")
            received.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
