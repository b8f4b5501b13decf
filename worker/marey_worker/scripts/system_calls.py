"""Filter of the system calls of a script; it refuses what Landlock cannot limit.

Landlock does not limit Unix sockets, through which a process can ask other programs to act for it. Nor does it limit
the keys that the kernel stores for a user, or System V shared memory, which counts as the memory of no process.
"""

from __future__ import annotations

import ctypes
import errno
import platform
import struct
from typing import NamedTuple

from marey_worker.scripts.confinement import NotConfinedError

PR_SET_SECCOMP, SECCOMP_MODE_FILTER = 22, 2
_ALLOW, _REFUSE = 0x7FFF0000, 0x00050000 | errno.EACCES
_LOAD, _IF_EQUAL, _IF_AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_NUMBER_AT, _ARCHITECTURE_AT, _FIRST_ARGUMENT_AT = 0, 4, 16
_OTHER_NUMBERS = 0x40000000
"""First number of the second set of system calls of x86_64 (x32)."""
AF_INET, AF_INET6, AF_NETLINK = 2, 10, 16
"""Families of sockets that scripts may open; libraries list the addresses of the machine by netlink."""


class _Machine(NamedTuple):
    """Numbers of a processor architecture for the filter: its own, that of `socket`, and those of refused calls."""

    architecture: int
    socket: int
    refused: tuple[int, ...]


_MACHINES = {  # refused: shmget, add_key, request_key, keyctl, io_uring_setup (which opens sockets, too)
    "x86_64": _Machine(0xC000003E, 41, (29, 248, 249, 250, 425)),
    "aarch64": _Machine(0xC00000B7, 198, (194, 217, 218, 219, 425)),
}


def filter_system_calls() -> None:
    """Refuse certain system calls to this process and its future children; set "no new privileges" before.

    Sockets other than IP and netlink sockets are refused. Pairs of connected Unix sockets remain possible. Raises
    `NotConfinedError` if the system does not support the filter.
    """
    machine = _MACHINES.get(platform.machine())
    if machine is None:
        known = " or ".join(_MACHINES)
        raise NotConfinedError(f"scripts can run only on {known}; this machine is {platform.machine()}")
    code = b"".join(_steps(machine))
    steps = ctypes.create_string_buffer(code, len(code))
    program = struct.pack("@HP", len(code) // 8, ctypes.addressof(steps))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_SECCOMP, SECCOMP_MODE_FILTER, program, 0, 0) != 0:
        raise NotConfinedError(f"system calls cannot be filtered: {errno.errorcode[ctypes.get_errno()]}")


def _steps(machine: _Machine) -> list[bytes]:
    refuse, allow = _step(_RETURN, _REFUSE), _step(_RETURN, _ALLOW)
    steps = [_step(_LOAD, _ARCHITECTURE_AT), _step(_IF_EQUAL, machine.architecture, 1, 0), refuse]
    steps += [_step(_LOAD, _NUMBER_AT), _step(_IF_AT_LEAST, _OTHER_NUMBERS, 0, 1), refuse]
    for number in machine.refused:
        steps += [_step(_IF_EQUAL, number, 0, 1), refuse]
    steps += [_step(_IF_EQUAL, machine.socket, 1, 0), allow, _step(_LOAD, _FIRST_ARGUMENT_AT)]
    for family in (AF_INET, AF_INET6, AF_NETLINK):
        steps += [_step(_IF_EQUAL, family, 0, 1), allow]
    return [*steps, refuse]


def _step(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    return struct.pack("=HBBI", code, if_true, if_false, value)
