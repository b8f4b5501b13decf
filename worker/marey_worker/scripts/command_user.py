"""User of the operating system that runs a script's command if the worker runs as root.

The kernel limits the number of processes (RLIMIT_NPROC) of every user but root. So the command of a script runs as a
user that no other process has. The command keeps one right of root, so that it can open files of root that Landlock
allows, such as a Python environment in the home of root.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path

from marey_worker.scripts.confinement import check, libc

FIRST_USER, USERS = 61184, 4336
"""Ids of users that no account has. systemd assigns ids in this range to services while they run."""
CAP_CHOWN, CAP_DAC_OVERRIDE, CAP_FOWNER, CAP_KILL, CAP_SETUID = 0, 1, 3, 5, 7
NEEDED = (CAP_CHOWN, CAP_DAC_OVERRIDE, CAP_FOWNER, CAP_KILL, CAP_SETUID)
"""Rights that root needs to change the user, to kill the processes of another user, and to remove their files."""
PR_SET_KEEPCAPS, PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE = 8, 47, 2
_THIS_PROCESS = struct.pack("=Ii", 0x20080522, 0)  # version 3 of the rights, process


def free_user() -> int | None:
    """Return the id of a user without processes; None if this process may not run commands as another user."""
    rights = _rights("CapEff")
    if os.geteuid() != 0 or any(not rights >> one & 1 for one in NEEDED):
        return None
    used = set(_users_of_processes())
    ids = (FIRST_USER + (os.getpid() + number) % USERS for number in range(USERS))
    return next((one for one in ids if one not in used and _exists(one)), None)


def give(folder: Path, user: int) -> bool:
    """Make `user` the owner of a folder and its contents; return False if the file system does not support this.

    Links are not followed. Raises `OSError` if the owner of only some of the contents can be changed.
    """
    try:
        os.chown(folder, user, -1)
    except OSError:
        return False
    for path, folders, files in os.walk(folder):
        for name in (*folders, *files):
            os.chown(os.path.join(path, name), user, -1, follow_symlinks=False)
    return True


def become(user: int) -> None:
    """Change the user of this process to `user`, who keeps the right to open files of root.

    Programs that this process starts have the same user and right. Raises `OSError` or `NotConfinedError` if this is
    not possible.
    """
    check(libc().prctl(PR_SET_KEEPCAPS, 1, 0, 0, 0))
    os.setresuid(user, user, user)
    kept = 1 << CAP_DAC_OVERRIDE
    _set_rights(kept, kept, kept)
    check(libc().prctl(PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, CAP_DAC_OVERRIDE, 0, 0))


def look_as(user: int) -> None:
    """Let this process, which runs as root, read data in /proc that the kernel shows only to `user`.

    In some containers, root may not read such data about other users. Raises `NotConfinedError` if the rights cannot be
    set.
    """
    rights = _rights("CapPrm")
    libc().setfsuid(user)  # removes the rights to files, which this process still needs
    _set_rights(rights, rights, _rights("CapInh"))


def _rights(which: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1], 16) for line in lines if line.startswith(f"{which}:"))


def _set_rights(effective: int, permitted: int, inheritable: int) -> None:
    sets = (effective, permitted, inheritable)
    halves = [one >> shift & 0xFFFFFFFF for shift in (0, 32) for one in sets]
    check(libc().capset(_THIS_PROCESS, struct.pack("=6I", *halves)))


def _users_of_processes() -> Iterator[int]:
    for entry in os.scandir("/proc"):
        if entry.name.isdigit():
            try:
                yield entry.stat().st_uid
            except FileNotFoundError:
                continue  # it has ended


def _exists(user: int) -> bool:
    """Return whether the user namespace of this process has the user with this id."""
    extents = (map(int, line.split()) for line in Path("/proc/self/uid_map").read_text().splitlines())
    return any(first <= user < first + length for first, _, length in extents)
