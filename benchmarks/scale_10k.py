"""Measurement of a server with ten thousand uploaded clips: `python -m benchmarks.scale_10k`.

It uploads clips of 300 frames with the client, several at a time, into one project of a new server on SQLite.
Meanwhile, it samples the memory of the server. Then it measures pages of lists, and checks every digest and reference
of the database. All of this takes minutes and leaves no data behind. The exit status is 1 if a goal was missed.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import psutil
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.local_server import PROJECT, LocalServer, clean_environment, clip_parts, local_server
from benchmarks.wire import Connection
from marey_motion.clip import Clip
from marey_motion.documents import skeleton_to_document
from marey_motion.gait import generate_gait
from marey_schemas.access import ProjectCreate
from marey_schemas.documents.references import RevisionRef

CLIPS, FRAMES, FRAME_RATE_HZ = 10_000, 300, 60.0
UPLOADERS = 4
SAMPLE_EVERY_S = 0.1
GOAL_RSS_MIB, GOAL_PAGE_MS = 400, 5.0


@dataclass
class MemoryWatch:
    """Samples of the resident memory of a process, in MiB."""

    samples_mib: list[float] = field(default_factory=list)

    @contextmanager
    def over(self, pid: int) -> Iterator[None]:
        """Sample the memory of the process `pid` while the `with` block runs."""
        process, stop = psutil.Process(pid), threading.Event()

        def sample() -> None:
            while not stop.wait(SAMPLE_EVERY_S):
                self.samples_mib.append(process.memory_info().rss / 2**20)

        thread = threading.Thread(target=sample)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()


def main() -> int:
    """Run the measurement and print a table; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale_10k", description=__doc__)
    parser.add_argument("--clips", type=int, default=CLIPS, help="number of clips (default: %(default)s)")
    clips: int = parser.parse_args().clips
    console, watch = Console(width=110), MemoryWatch()
    with local_server() as server:
        idle_mib = psutil.Process(server.pid).memory_info().rss / 2**20
        with watch.over(server.pid):
            begun = time.perf_counter()
            _upload(server, clips, console)
            upload_s = time.perf_counter() - begun
            pages_ms = list(_page_times_ms(server))
            findings = _check(server)
    page_ms, peak_mib = statistics.median(pages_ms), max(watch.samples_mib)
    rows = [
        (
            "uploaded",
            f"{clips:,} clips of {FRAMES} frames in {upload_s:.0f} s, {clips / upload_s:.0f} a second",
            "",
            True,
        ),
        ("server at start", f"{idle_mib:.0f} MiB", "", True),
        ("server at its largest", f"{peak_mib:.0f} MiB", f"< {GOAL_RSS_MIB} MiB", peak_mib < GOAL_RSS_MIB),
        ("server at the end", f"{watch.samples_mib[-1]:.0f} MiB", "", True),
        ("first page of 50", f"{page_ms:.1f} ms", f"< {GOAL_PAGE_MS:.0f} ms", page_ms < GOAL_PAGE_MS),
        ("marey db fsck", findings[1] or "nothing", "finds nothing", findings[0]),
    ]
    table = Table("what", "measured", "goal", "", title=f"{clips:,} clips in one project", title_justify="left")
    for what, measured, goal, met in rows:
        table.add_row(what, measured, goal, ("met" if met else "[bold]missed[/bold]") if goal else "")
    console.print(table)
    return int(not all(row[3] for row in rows))


def _upload(server: LocalServer, clips: int, console: Console) -> None:
    walk = generate_gait(1.3, 0.2, FRAMES / FRAME_RATE_HZ, FRAME_RATE_HZ)
    with server.client() as marey, ThreadPoolExecutor(UPLOADERS) as uploaders:
        project = marey.create_project(ProjectCreate(name=PROJECT))
        hierarchy = skeleton_to_document(walk.skeleton).model_dump(by_alias=True)
        skeleton = RevisionRef(item=project.skeletons.create("rig", {"hierarchy": hierarchy}).id, revision=1)

        def upload(number: int) -> None:
            parts = clip_parts(_shaken(walk, number), skeleton)
            project.clips.create(f"take {number:05d}", parts, collection=f"day {number // 1000}", tags=("walk",))

        for _ in track(uploaders.map(upload, range(clips)), "uploading", clips, console=console, transient=True):
            pass


def _shaken(walk: Clip, seed: int) -> Clip:
    """Return the walk with capture noise added."""
    noise = np.random.default_rng(seed).normal(scale=1e-4, size=walk.poses.shape)
    return replace(walk, poses=(walk.poses + noise).astype(np.float32))


def _page_times_ms(server: LocalServer) -> Iterator[float]:
    with Connection(server.port, server.token) as connection:
        request = connection.head("GET", f"/projects/{PROJECT}/clips?limit=50")
        for _ in range(200):
            begun = time.perf_counter()
            connection.exchange(request)
            yield (time.perf_counter() - begun) * 1e3


def _check(server: LocalServer) -> tuple[bool, str]:
    """Run `marey db fsck`; return whether the command succeeds, and its output."""
    run = subprocess.run(
        [sys.executable, "-m", "marey_client.cli", "db", "fsck"],
        env=clean_environment() | {"MAREY_DATA": str(server.data)},
        capture_output=True,
        text=True,
        check=False,
    )
    return run.returncode == 0, (run.stdout + run.stderr).strip()


if __name__ == "__main__":
    sys.exit(main())
