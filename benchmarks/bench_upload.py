"""Upload of a folder of motion files with the client, compared with pymotion, which only reads the BVH files.

Marey's time is how long a person waits for `marey upload`. For each file, this includes hashing and sending the file,
reading and checking the motion, and storing file and motion. pymotion reads the BVH files in one process and stores
nothing; it has no reader for other formats.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

from benchmarks.local_server import PROJECT, local_server, one_worker
from benchmarks.material import captured_walk, folder_of_takes, real_folder
from benchmarks.pymotion_bvh import load_with_pymotion, loaded_with_pymotion
from benchmarks.timing import Row
from marey_client.imports import LocalFile, find_files
from marey_motion.formats import write_bvh
from marey_schemas.access import ProjectCreate
from marey_schemas.imports import ImportEntry

REPEATS = 3
GOAL_FILES_PER_S, GOAL_POSES_PER_S = 60, 20_000


def run() -> list[Row]:
    """Measure uploads to new servers, each with one worker, and pymotion in turn."""
    with folder_of_takes() as folder:
        files = find_files(folder).files
        frames = loaded_with_pymotion(file.path for file in files if file.name.lower().endswith(".bvh"))
        uploads, readings_s = [], []
        for _ in range(REPEATS):
            uploads.append(_upload(files))
            readings_s.append(_read_with_pymotion(frames))
    ours_s, peer_s = statistics.median(seconds for seconds, _, _ in uploads), statistics.median(readings_s)
    _, server_s, entries = uploads[0]
    poses = sum(entry.frames or 0 for entry in entries)
    clips = sum(entry.frames is not None for entry in entries)
    files_per_s, poses_per_s = len(files) / ours_s, poses / ours_s
    megabytes = sum(file.size_bytes for file in files) / 1e6
    origin = "real" if real_folder() else "generated"
    return [
        Row(
            "folder to clips",
            f"{len(files)} {origin} files, {megabytes:.0f} MB, {clips} clips, {poses:,} frames; "
            f"the server's processor: {server_s:.1f} s",
            f"{files_per_s:.0f} files/s, {poses_per_s:,.0f} poses/s",
            f"pymotion only reads {len(frames)} BVH files, in one process: {len(frames) / peer_s:.0f} files/s, "
            f"{sum(frames.values()) / peer_s:,.0f} poses/s",
            files_per_s * peer_s / len(frames),
            f"≥ {GOAL_FILES_PER_S} files/s, ≥ {GOAL_POSES_PER_S:,} poses/s",
            files_per_s >= GOAL_FILES_PER_S and poses_per_s >= GOAL_POSES_PER_S,
        )
    ]


def _upload(files: tuple[LocalFile, ...]) -> tuple[float, float, list[ImportEntry]]:
    """Upload files to a new server that has read one file before.

    Returns the duration and the processor time of the server, both in seconds, and the entries of the import.
    """
    with local_server() as server, one_worker(server), server.client() as marey:
        marey.create_project(ProjectCreate(name="warm"))
        warm = Path(server.data.parent, "warm-up.bvh")
        warm.write_bytes(write_bvh(captured_walk(60, 31)))
        marey.project("warm").imports.upload(find_files(warm).files)
        project = marey.create_project(ProjectCreate(name=PROJECT))
        before_s, started = server.processor_s(), time.perf_counter()
        entries = project.imports.upload(files)
        return time.perf_counter() - started, server.processor_s() - before_s, entries


def _read_with_pymotion(paths: dict[Path, int]) -> float:
    started = time.perf_counter()
    for path in paths:
        load_with_pymotion(path)
    return time.perf_counter() - started
