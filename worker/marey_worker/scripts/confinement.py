"""Confinement of the processes of a script by Landlock, which limits the files that they can open."""

from __future__ import annotations

import ctypes
import os
import stat
import struct
import sys
from collections.abc import Iterable
from pathlib import Path

PR_SET_CHILD_SUBREAPER, PR_SET_NO_NEW_PRIVS = 36, 38
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same numbers on all architectures
_PATH_BENEATH = 1

EXECUTE, WRITE_FILE, READ_FILE, READ_DIR, TRUNCATE, IOCTL = 1 << 0, 1 << 1, 1 << 2, 1 << 3, 1 << 14, 1 << 15
_OF_FILES = EXECUTE | WRITE_FILE | READ_FILE | TRUNCATE | IOCTL
"""Rights that a rule about a single file may grant."""

PROGRAMS = ("/usr", "/bin", "/lib", "/lib32", "/lib64", "/sbin")
"""Folders of programs and libraries, which scripts may read."""
SYSTEM_FILES = (
    "/etc/ld.so.cache", "/etc/localtime", "/etc/passwd", "/etc/group", "/etc/nsswitch.conf", "/proc/cpuinfo",
    "/proc/meminfo", "/sys/devices/system/cpu",
)  # fmt: skip
"""Further files that programs need, and that contain no secrets."""
NETWORK_FILES = ("/etc/hosts", "/etc/resolv.conf", "/etc/ssl", "/etc/pki")
DEVICES = ("/dev/null", "/dev/zero", "/dev/random", "/dev/urandom")


class NotConfinedError(Exception):
    """Error of a system that cannot confine a script."""


def landlock_version() -> int:
    """Return the version of Landlock that the kernel supports; 0 if it does not support Landlock."""
    if sys.platform != "linux":
        return 0
    return max(0, int(libc().syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), 1)))


def adopt_orphans() -> None:
    """Make this process the parent of those descendants whose own parent has ended, so that it can end them."""
    libc().prctl(PR_SET_CHILD_SUBREAPER, 1)


def confine(writable: Path, *, network: bool) -> None:
    """Limit the files that this process and its future children can open.

    Files can be written only below `writable`. They can be read only there, in the folders of programs, and at a few
    other places of the system. Devices such as /dev/null can be used. Unless `network` is true, TCP is refused as well,
    if the kernel supports it. Raises `NotConfinedError` if the kernel has no Landlock, or refuses the limits.
    """
    version = landlock_version()
    if version == 0:
        raise NotConfinedError("the kernel of this machine has no Landlock (Linux 5.13 or later)")
    everything = _rights_of(version)
    tcp = 0 if network or version < 4 else 3
    scoped = 0 if version < 6 else 3  # abstract sockets and signals
    fields = struct.pack("=QQQ", everything, tcp, scoped)[: 8 if version < 4 else 16 if version < 6 else 24]
    ruleset = check(libc().syscall(_CREATE_RULESET, fields, ctypes.c_size_t(len(fields)), 0))
    reading = EXECUTE | READ_FILE | READ_DIR
    readable = [*PROGRAMS, *SYSTEM_FILES, sys.prefix, sys.base_prefix, *(NETWORK_FILES if network else ())]
    _allow(ruleset, readable, reading & everything)
    _allow(ruleset, DEVICES, (READ_FILE | WRITE_FILE) & everything)
    _allow(ruleset, [str(writable)], everything)
    check(libc().prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0))
    check(libc().syscall(_RESTRICT_SELF, ruleset, 0))
    os.close(ruleset)


def _rights_of(version: int) -> int:
    """Return a bit mask with all rights to files that a version of Landlock knows."""
    newest = {1: 12, 2: 13, 3: 14, 4: 14}.get(version, 15)
    return int((1 << (newest + 1)) - 1)


def _allow(ruleset: int, paths: Iterable[str], rights: int) -> None:
    for path in paths:
        try:
            opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except FileNotFoundError:
            continue
        granted = rights if stat.S_ISDIR(os.fstat(opened).st_mode) else rights & _OF_FILES
        rule = struct.pack("=Qi", granted, opened)
        check(libc().syscall(_ADD_RULE, ruleset, _PATH_BENEATH, rule, 0))
        os.close(opened)


def check(answer: int) -> int:
    """Return the result of a system call. Raises `NotConfinedError` if the result is an error."""
    if answer < 0:
        raise NotConfinedError(f"this system cannot confine the script: {os.strerror(ctypes.get_errno())}")
    return answer


def libc() -> ctypes.CDLL:
    """Return the C library, with which this package makes system calls."""
    return ctypes.CDLL(None, use_errno=True)
