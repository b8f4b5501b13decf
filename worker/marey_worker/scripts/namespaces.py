"""Namespaces of the processes of a script, which hide other processes and the network, and make files read-only."""

from __future__ import annotations

import ctypes
import os
import struct
from dataclasses import dataclass
from pathlib import Path

from marey_worker.scripts.confinement import NotConfinedError, check, libc

CLONE_NEWNS, CLONE_NEWIPC, CLONE_NEWUSER = 0x00020000, 0x08000000, 0x10000000
CLONE_NEWPID, CLONE_NEWNET = 0x20000000, 0x40000000
MS_BIND, MS_REC, MS_PRIVATE = 1 << 12, 1 << 14, 1 << 18
_MOUNT_SETATTR = 442
_AT_FDCWD, _AT_RECURSIVE, _MOUNT_READ_ONLY = -100, 0x8000, 1
SEEN_USER, SEEN_ROOT = 1000, 1001
"""Ids of the user of the command, and of root, in a namespace."""


@dataclass(frozen=True)
class Separation:
    """Result of `separate`: whether all namespaces were created, and the id of the command's user in them, or None."""

    isolated: bool
    user: int | None


def separate(writable: Path, *, network: bool, user: int | None = None) -> Separation:
    """Give the next child of this process namespaces of its own, as far as the system allows it.

    This process must have only one thread. Its next child sees no other processes and, unless `network` is true, no
    network. For this process and the child, all files outside `writable` are read-only. With `user`, this process must
    be root, and the child can become `user`.
    """
    flags = CLONE_NEWUSER | CLONE_NEWNS | CLONE_NEWPID | CLONE_NEWIPC | (0 if network else CLONE_NEWNET)
    this, group = os.geteuid(), os.getegid()
    outside = None if user is None else _Outside(user)
    created = libc().unshare(flags) == 0
    mapped = outside is not None and outside.finish(write=created)
    if not created:
        return Separation(isolated=False, user=user)
    if not mapped:
        _write_maps("self", {"setgroups": "deny", "uid_map": f"{SEEN_USER} {this} 1", "gid_map": f"1000 {group} 1"})
    try:
        _make_read_only(writable)
    except NotConfinedError:  # some containers allow namespaces, but no mounts
        return Separation(isolated=False, user=SEEN_USER if mapped else None)
    return Separation(isolated=True, user=SEEN_USER if mapped else None)


class _Outside:
    """Helper process that stays outside the new namespaces, because only such a process may map two users into them."""

    def __init__(self, user: int) -> None:
        waiting, self._order = os.pipe()
        this = os.getpid()
        self._id = os.fork()
        if self._id == 0:
            os.close(self._order)
            os._exit(0 if os.read(waiting, 1) and _map_both(this, user) else 1)
        os.close(waiting)

    def finish(self, *, write: bool) -> bool:
        """Let the helper map the users if `write` is true, and let it end; return whether the users were mapped."""
        if write:
            os.write(self._order, b"w")
        os.close(self._order)
        _, status = os.waitpid(self._id, 0)
        return status == 0


def _map_both(process: int, user: int) -> bool:
    """Map `user`, root and all groups into the user namespace of a process; return whether this was possible.

    Because all groups are mapped, root may open files of any group.
    """
    groups = (line.split() for line in Path("/proc/self/gid_map").read_text().splitlines())
    maps = {
        "uid_map": f"{SEEN_USER} {user} 1\n{SEEN_ROOT} 0 1\n",
        "gid_map": "".join(f"{first} {first} {length}\n" for first, _, length in groups),
    }
    try:
        _write_maps(str(process), maps)
    except OSError:
        return False
    return True


def _write_maps(process: str, maps: dict[str, str]) -> None:
    for file, text in maps.items():
        Path(f"/proc/{process}/{file}").write_text(text)


def _make_read_only(writable: Path) -> None:
    """Make all files outside `writable` read-only in the mount namespace of this process.

    Landlock does not limit changes of the modes, owners and times of files, so read-only mounts prevent them. Raises
    `NotConfinedError` if the system does not allow mounts.
    """
    folder = os.fsencode(writable)
    check(libc().mount(None, b"/", None, ctypes.c_ulong(MS_REC | MS_PRIVATE), None))
    _set_read_only(b"/", read_only=True, flags=_AT_RECURSIVE)
    check(libc().mount(folder, folder, None, ctypes.c_ulong(MS_BIND), None))
    _set_read_only(folder, read_only=False, flags=0)


def _set_read_only(path: bytes, *, read_only: bool, flags: int) -> None:
    attributes = struct.pack("=QQQQ", _MOUNT_READ_ONLY * read_only, _MOUNT_READ_ONLY * (not read_only), 0, 0)
    size = ctypes.c_size_t(len(attributes))
    check(libc().syscall(_MOUNT_SETATTR, _AT_FDCWD, path, ctypes.c_uint(flags), attributes, size))
