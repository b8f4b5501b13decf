"""Processor time and memory of a process and its children, from /proc."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

_TICK_S = 1 / os.sysconf("SC_CLK_TCK")
_QUIET_S = 0.0005
"""A process is idle if it uses less processor time than this within 0.02 s."""


class ProcessCost:
    """Processor time and memory of a process and its children; the peak is measured since the last `reset_peak`."""

    def __init__(self, pid: int) -> None:
        self.pid = pid

    def processor_s(self) -> float:
        """Return the processor time used so far in seconds, including the time used by children that have ended."""
        total = self._ended_children_s()
        for pid in self._family():
            for task in Path(f"/proc/{pid}/task").glob("*/schedstat"):
                with contextlib.suppress(OSError, IndexError):
                    total += int(task.read_text().split()[0]) / 1e9
        return total

    def peak_mb(self) -> float:
        """Return the sum of the greatest resident memory of each running process since `reset_peak`, in MB."""
        return sum(self._status_kb(pid, "VmHWM") for pid in self._family()) / 1e3

    def resident_mb(self) -> float:
        """Return the resident memory of the process and its children in MB."""
        return sum(self._status_kb(pid, "VmRSS") for pid in self._family()) / 1e3

    def proportional_mb(self) -> float:
        """Return the memory of the process and its children in MB; of a page that n processes share, each counts 1/n.

        Children of a fork server share some 300 MB with it, which `resident_mb` counts again for every child.
        """
        return sum(_listed_kb(Path(f"/proc/{pid}/smaps_rollup"), "Pss") for pid in self._family()) / 1e3

    def own_resident_mb(self) -> float:
        """Return the resident memory of the process without its children in MB."""
        return self._status_kb(self.pid, "VmRSS") / 1e3

    def own_peak_mb(self) -> float:
        """Return the greatest resident memory of the process without its children since `reset_peak`, in MB."""
        return self._status_kb(self.pid, "VmHWM") / 1e3

    def reset_peak(self) -> None:
        """Set the measured peak of the memory to the present value."""
        for pid in self._family():
            with contextlib.suppress(OSError):
                Path(f"/proc/{pid}/clear_refs").write_text("5")

    def wait_until_idle(self, longest_s: float = 1.0) -> None:
        """Wait until the process is idle, so that work that the server does after its answer is measured, too."""
        deadline = time.monotonic() + longest_s
        before = self.processor_s()
        while time.monotonic() < deadline:
            time.sleep(0.02)
            now = self.processor_s()
            if now - before < _QUIET_S:
                return
            before = now

    def _family(self) -> list[int]:
        children: dict[int, list[int]] = {}
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                children.setdefault(int(_fields(stat)[1]), []).append(int(stat.parent.name))
        family = [self.pid]
        for pid in family:  # grows while it is read
            family += children.get(pid, [])
        return family

    def _ended_children_s(self) -> float:
        fields = _fields(Path(f"/proc/{self.pid}/stat"))
        return (int(fields[13]) + int(fields[14])) * _TICK_S

    @staticmethod
    def _status_kb(pid: int, name: str) -> int:
        return _listed_kb(Path(f"/proc/{pid}/status"), name)


def _listed_kb(table: Path, name: str) -> int:
    """Return an amount from a table such as `/proc/<pid>/status`, and 0 if the process has ended."""
    with contextlib.suppress(OSError):
        for line in table.read_text().splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1])
    return 0


def _fields(stat: Path) -> list[str]:
    """Return the fields of a `/proc/<pid>/stat` file that follow the name of the process."""
    return stat.read_text().rpartition(")")[2].split()
