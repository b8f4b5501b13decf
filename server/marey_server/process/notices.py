"""Notices to systemd about the state of a service of the type `notify`; without systemd, they have no effect."""

from __future__ import annotations

import logging
import os
import socket
import time

NOTIFY_VARIABLE = "NOTIFY_SOCKET"
"""Variable in which systemd names the socket for notices; child processes do not get it."""

log = logging.getLogger(__name__)


def note_ready() -> None:
    """Report that the server accepts connections."""
    _notify("READY=1")


def note_reloading() -> None:
    """Report that the processes of the server are being replaced; `note_ready` ends this state."""
    _notify(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")


def note_stopping() -> None:
    """Report that the server has begun to stop."""
    _notify("STOPPING=1")


def _notify(state: str) -> None:
    """Send a notice to the socket that systemd has named; a failure is logged, because the server works without."""
    address = os.environ.get(NOTIFY_VARIABLE)
    if not address:
        return
    if address.startswith("@"):  # a name in the abstract namespace
        address = f"\0{address[1:]}"
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notices:
            notices.connect(address)
            notices.sendall(state.encode())
    except OSError as error:
        log.warning("systemd cannot be notified: %s", error)
