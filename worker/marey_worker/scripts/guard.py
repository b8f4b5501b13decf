"""Guard of a script: a process that starts the confined command, watches its limits and ends all its processes.

The guard is a separate process, because only a process with one thread can create namespaces. It reads a
`GuardedCommand` as JSON from standard input, and copies the output of the command to its own standard output. At the
end, it writes a `CommandEnd` as JSON to the pipe whose descriptor is its first argument.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import selectors
import signal
import stat
import sys
import time
from collections.abc import Collection, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import NoReturn

import psutil

from marey_schemas.processes.limits import PR_SET_PDEATHSIG, die_with_parent
from marey_schemas.sizes import MIB
from marey_worker.scripts.command_user import become, free_user, give, look_as
from marey_worker.scripts.confinement import NotConfinedError, adopt_orphans, confine
from marey_worker.scripts.namespaces import Separation, separate
from marey_worker.scripts.system_calls import filter_system_calls

LOOK_EVERY_S = 0.05
MEASURE_EVERY_S = 0.5
LOG_BYTES = 8 * MIB
TAIL_BYTES = 2000
MOST_FILES = 100_000
"""Greatest number of files and folders below the folder of a run."""
MOST_NESTED = 100
BLOCK_BYTES = 512
OPEN_FILES = 1024
THREADS_PER_PROCESS = 8
NO_PROGRAM_STATUS = 127


@dataclass(frozen=True)
class GuardedCommand:
    """Command of a script, with its folder, environment and limits.

    Parameters
    ----------
    seconds : time limit
    memory_mb : limit on the memory of all processes together, in MiB
    written_mb : limit on the size of all files below the folder, in MiB
    processes : greatest number of processes at the same time
    network : whether the command may use the network
    """

    argv: tuple[str, ...]
    folder: str
    environment: dict[str, str]
    seconds: int
    memory_mb: int
    written_mb: int
    processes: int
    network: bool


@dataclass(frozen=True)
class CommandEnd:
    """End of a command: its exit status (128 plus the number of a signal), or the reason why the guard stopped it.

    `tail` is the last part of the command's output. `isolated` states whether the command had namespaces of its own,
    and `bounded` whether the kernel limited the number of its processes.
    """

    status: int | None
    stopped: str | None
    tail: str
    isolated: bool
    bounded: bool


def main() -> None:
    """Run the command that standard input describes, and write a `CommandEnd` to the pipe."""
    result = int(sys.argv[1])
    os.set_inheritable(result, False)
    given = json.load(sys.stdin)
    order = GuardedCommand(**(given | {"argv": tuple(given["argv"])}))
    die_with_parent()
    _take_precedence()
    adopt_orphans()
    by_root = os.geteuid() == 0
    place = _prepare(order)
    bounded = place.isolated if not by_root else place.user is not None
    die_with_parent()  # again: the kernel forgets this when a process changes its user
    read_end, write_end = os.pipe()
    held = os.fork()
    if held == 0:
        os.close(read_end)
        os.close(result)
        _hold(order, write_end, place.user, bounded=bounded)
    os.close(write_end)
    watch = _Watch(order, held, read_end)
    stopped = watch.run()
    end = CommandEnd(watch.status, stopped, watch.tail.decode("utf-8", "replace"), place.isolated, bounded)
    os.write(result, json.dumps(asdict(end)).encode())


def _prepare(order: GuardedCommand) -> Separation:
    """Create the namespaces of the command, and choose its user.

    If the command gets a user of its own, this user becomes the owner of the command's folder.
    """
    folder = Path(order.folder)
    place = separate(folder, network=order.network, user=free_user())
    if place.user is None:
        return place
    if not give(folder, place.user):
        return replace(place, user=None)
    look_as(place.user)
    return place


def _hold(order: GuardedCommand, output: int, user: int | None, *, bounded: bool) -> NoReturn:
    """Start the confined command, wait until it has ended, and exit with its status.

    If the command has a process namespace, this process is the first one in it: when it ends, the kernel kills all
    others.
    """
    os.setsid()
    null = os.open(os.devnull, os.O_RDONLY)
    for number, end in enumerate((null, output, output)):
        os.dup2(end, number)
    os.chdir(order.folder)
    try:
        if user is not None:
            become(user)
        _die_with_parent()
        _limit(order, bounded=bounded)
        confine(Path(order.folder), network=order.network)
        filter_system_calls()
        command = os.fork()
        if command == 0:
            _die_with_parent()
            os.execvpe(order.argv[0], order.argv, order.environment)  # noqa: S606 - a list without a shell
    except (NotConfinedError, OSError) as error:
        os.write(2, f"the command cannot be started: {error}\n".encode())
        os._exit(NO_PROGRAM_STATUS)
    while True:
        ended, status = os.wait()
        if ended == command:
            code = os.waitstatus_to_exitcode(status)
            os._exit(code if code >= 0 else 128 - code)


def _take_precedence() -> None:
    """Let this process always run before the processes of the command, if the system allows this.

    If the kernel does not limit the number of processes of the command, the guard must count them. It could not count
    in time if it had to share the processors with thousands of these processes.
    """
    if os.geteuid() == 0:
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(1))


def _die_with_parent() -> None:
    """Let the kernel kill this process when its parent ends.

    Unlike `die_with_parent`, this works in a new namespace of processes, in which the parent has no process id.
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _limit(order: GuardedCommand, *, bounded: bool) -> None:
    limits = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_DATA: order.memory_mb * MIB,
        resource.RLIMIT_FSIZE: order.written_mb * MIB,
        resource.RLIMIT_NOFILE: OPEN_FILES,
    }
    if bounded:  # otherwise, all processes of the user would count
        limits[resource.RLIMIT_NPROC] = order.processes * THREADS_PER_PROCESS
    for which, limit in limits.items():
        _, hard = resource.getrlimit(which)
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(which, (limit, limit))


class _Watch:
    """Watch over a running command: copies its output, and checks its limits."""

    def __init__(self, order: GuardedCommand, held: int, output: int) -> None:
        self.status: int | None = None
        self.tail = b""
        self._order = order
        self._held = held
        self._output = output
        self._printed = 0
        self._deadline = time.monotonic() + order.seconds
        self._measure_at = 0.0

    def run(self) -> str | None:
        """Wait until the command has ended, and return None; if it exceeds a limit, stop it and return the reason."""
        os.set_blocking(self._output, False)
        with selectors.DefaultSelector() as waiting:
            waiting.register(self._output, selectors.EVENT_READ)
            stopped = None
            while stopped is None and not self._has_ended():
                if waiting.select(LOOK_EVERY_S) and not self._copy():
                    time.sleep(LOOK_EVERY_S)  # the command has closed its output
                stopped = self._exceeded()
        self._end_all()
        while stopped is None and self._copy():
            stopped = self._too_much_output()
        return stopped

    def _has_ended(self) -> bool:
        ended, status = os.waitpid(self._held, os.WNOHANG)
        if ended:
            self.status = os.waitstatus_to_exitcode(status)
            if self.status < 0:
                self.status = 128 - self.status
        return bool(ended)

    def _copy(self) -> bool:
        """Copy the next piece of output; return whether there was any output."""
        try:
            piece = os.read(self._output, 64 << 10)
        except BlockingIOError:
            return False
        self._printed += len(piece)
        sys.stdout.buffer.write(piece)
        sys.stdout.buffer.flush()
        self.tail = (self.tail + piece)[-TAIL_BYTES:]
        return bool(piece)

    def _too_much_output(self) -> str | None:
        if self._printed > LOG_BYTES:
            return f"it printed more than {LOG_BYTES // MIB} MiB"
        return None

    def _exceeded(self) -> str | None:
        order = self._order
        if time.monotonic() > self._deadline:
            return f"it ran longer than its limit of {order.seconds} s"
        family = list(islice(_descendants(), order.processes + 2))
        if len(family) > order.processes + 1:  # one process waits for the command
            return f"it had more than {order.processes} processes at the same time"
        if sum(map(_resident, family)) > order.memory_mb * MIB:
            return f"it used more than {order.memory_mb} MiB of memory"
        if time.monotonic() > self._measure_at:
            fault = fault_of_files(Path(order.folder), nameless_bytes(family), order.written_mb)
            self._measure_at = time.monotonic() + MEASURE_EVERY_S
            if fault is not None:
                return fault
        return self._too_much_output()

    def _end_all(self) -> None:
        """Kill all processes of the command, until none is left.

        The first process of the command is killed first. If this process has its own namespace, the kernel then kills
        all other processes of the command at once, even those that fork faster than they can be listed.
        """
        if self.status is None:
            os.kill(self._held, signal.SIGKILL)
        while family := list(_descendants()):
            for one in family:
                try:
                    one.kill()
                except psutil.NoSuchProcess:
                    continue
            self._reap()
            time.sleep(LOOK_EVERY_S / 10)

    def _reap(self) -> None:
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                continue
        except ChildProcessError:
            return


def _descendants() -> Iterator[psutil.Process]:
    for one in psutil.Process().children(recursive=True):
        try:
            if one.status() != psutil.STATUS_ZOMBIE or one.ppid() == os.getpid():
                yield one
        except psutil.NoSuchProcess:
            continue


def _resident(one: psutil.Process) -> int:
    try:
        return int(one.memory_info().rss)
    except psutil.NoSuchProcess:
        return 0


def nameless_bytes(family: Collection[psutil.Process]) -> int:
    """Return the total size in bytes of the files without a name that processes of the command have opened or mapped.

    These are deleted files that are still in use, and files in memory. A mapped file exists even if its descriptor is
    closed. Only root may ask for the size of such a file; for other users, it counts up to the end of its mapped part.
    """
    sizes: dict[tuple[int, int], int] = {}
    for one in family:
        for file, size in _mapped_files(one.pid):
            sizes[file] = max(size, sizes.get(file, 0))
    for one in family:
        try:
            descriptors = os.listdir(f"/proc/{one.pid}/fd")
        except OSError:
            continue  # it has ended
        for number in descriptors:
            try:
                found = os.stat(f"/proc/{one.pid}/fd/{number}")
            except OSError:
                continue  # it is closed
            if stat.S_ISREG(found.st_mode) and found.st_nlink == 0:
                sizes[found.st_dev, found.st_ino] = found.st_blocks * BLOCK_BYTES
    return sum(sizes.values())


def _mapped_files(pid: int) -> Iterator[tuple[tuple[int, int], int]]:
    """Yield, for each mapped file of a process that has no name, its device and inode, and its size in bytes."""
    try:
        lines = Path(f"/proc/{pid}/maps").read_text(errors="replace").splitlines()
    except OSError:
        return  # it has ended
    for line in lines:
        addresses, _, offset, device, inode, *path = line.split(maxsplit=5)
        if inode == "0" or not (path and path[0].endswith(" (deleted)")):
            continue
        first, last = (int(one, 16) for one in addresses.split("-"))
        major, minor = (int(one, 16) for one in device.split(":"))
        try:
            size = os.stat(f"/proc/{pid}/map_files/{first:x}-{last:x}").st_blocks * BLOCK_BYTES
        except OSError:
            size = int(offset, 16) + last - first
        yield (os.makedev(major, minor), int(inode)), size


def fault_of_files(folder: Path, nameless: int, written_mb: int) -> str | None:
    """Return why the files below a folder are not allowed, or None if they are allowed.

    The reason is that they are too large, too many, too deep or unreadable. Links are not followed. `nameless` is the
    total size in bytes of files without a name, which is added to the size of these files.
    """
    total, count, waiting = nameless, 0, [(str(folder), 0)]
    while waiting:
        path, depth = waiting.pop()
        try:
            entries = list(os.scandir(path))
        except PermissionError:
            return "it has made a folder unreadable"
        except OSError:
            continue  # it has been removed or moved
        for entry in entries:
            count += 1
            try:
                found = entry.stat(follow_symlinks=False)
            except OSError:
                continue
            total += found.st_blocks * BLOCK_BYTES if stat.S_ISREG(found.st_mode) else 0
            if stat.S_ISDIR(found.st_mode):
                waiting.append((entry.path, depth + 1))
        if depth > MOST_NESTED:
            return f"its folders were nested deeper than {MOST_NESTED}"
        if total > written_mb * MIB or count > MOST_FILES:
            return f"its files took more than {written_mb} MiB, or there were more than {MOST_FILES:,}"
    return None


if __name__ == "__main__":
    main()
