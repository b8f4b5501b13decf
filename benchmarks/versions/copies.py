"""Copies of versions from one server to another: of one relabelled clip, and of clips with edited frames.

A client reads from the first server and writes to the second one, as `marey dataset push` does. Both connections pass
through proxies that count bytes. So the times include these proxies.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from unittest import mock

import numpy as np

from benchmarks.local_server import PROJECT, clip_parts, local_server
from benchmarks.material import captured_walk
from benchmarks.seeding import fill
from benchmarks.timing import Row
from benchmarks.versions.counting import CountingProxy
from marey_client import Marey
from marey_client.handles.versions import DatasetHandle
from marey_client.project import ProjectHandle
from marey_motion.clip import Clip
from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_schemas.access import ProjectCreate
from marey_schemas.documents.references import RevisionRef

LABELLED, LABELS = 500, 5
"""Number of clips of a dataset in which one clip is relabelled at a time, and number of repetitions."""
FOLDER = "day 0"
CLIPS, FRAMES, JOINTS = 100, 900, 77
"""Numbers of clips, of frames of each clip, and of joints of the dataset with edited frames; the clips have 60 Hz."""
GOAL_LABEL_BYTES, GOAL_SHARE = 20_000, 0.02


@dataclass(frozen=True)
class Copy:
    """Duration of a copy, and the bytes between the client and each server, in both directions together."""

    seconds: float
    source_bytes: int
    target_bytes: int


@dataclass(frozen=True)
class TwoServers:
    """Clients of two servers, and the proxies before these servers."""

    source: Marey
    target: Marey
    at_source: CountingProxy
    at_target: CountingProxy

    def copy(self, dataset: DatasetHandle, into: ProjectHandle) -> Copy:
        """Copy the newest version of a dataset, with the versions before it, into a project of the second server."""
        self.at_source.take_count(), self.at_target.take_count()
        begun = time.perf_counter()
        made = into.datasets.pull(dataset, dataset.name)
        seconds = time.perf_counter() - begun
        if not made.moved:
            raise RuntimeError(f"the copy of {dataset.name} has not moved the branch")
        return Copy(seconds, self.at_source.take_count(), self.at_target.take_count())


def measure_copies() -> list[Row]:
    """Measure copies between two new servers."""
    with _two_servers() as servers:
        return [_relabelled(servers), *_edited(servers)]


@contextmanager
def _two_servers() -> Iterator[TwoServers]:
    with (
        tempfile.TemporaryDirectory(prefix="marey-bench-") as cache,
        mock.patch.dict(os.environ, XDG_CACHE_HOME=cache),  # the folder of archives of running copies is below it
        local_server(partial(fill, clips=LABELLED)) as first,
        local_server() as second,
        CountingProxy(first.port) as at_source,
        CountingProxy(second.port) as at_target,
        Marey(at_source.url, first.token) as source,
        Marey(at_target.url, second.token) as target,
    ):
        yield TwoServers(source, target, at_source, at_target)


# -- one relabelled clip ----------------------------------------------------------------------------------------------


def _relabelled(servers: TwoServers) -> Row:
    project, into = servers.source.project(PROJECT), servers.target.create_project(ProjectCreate(name=PROJECT))
    labelled = project.datasets.create("labelled", collection=FOLDER)
    labelled.commit("first")
    servers.copy(labelled, into)
    clips = iter(list(project.clips.list(collection=FOLDER)))
    copies = []
    for number in range(LABELS):
        clip = next(clips)
        clip.put_info(clip.info().model_copy(update={"action": f"walk {number}"}))
        labelled.commit("relabel a clip")
        copies.append(servers.copy(labelled, into))
    sent = statistics.median(one.target_bytes for one in copies)
    read = statistics.median(one.source_bytes for one in copies)
    taken_ms = statistics.median(one.seconds for one in copies) * 1e3
    return Row(
        "push of one relabelled clip", f"{LABELLED:,} entries",
        f"{sent / 1e3:.1f} kB to and from the second server, {read / 1e3:.1f} kB the first; {taken_ms:.0f} ms",
        goal=f"< {GOAL_LABEL_BYTES / 1e3:.0f} kB on the wire", met=sent + read < GOAL_LABEL_BYTES,
    )  # fmt: skip


# -- edited frames ----------------------------------------------------------------------------------------------------


def _edited(servers: TwoServers) -> Iterator[Row]:
    """Measure a second copy after 1 % of the frames were edited: a run of frames in each clip, or all of one clip."""
    project = servers.source.create_project(ProjectCreate(name="edited"))
    into = servers.target.create_project(ProjectCreate(name="edited"))
    hierarchy = skeleton_to_document(_take(0).skeleton).model_dump(by_alias=True)
    skeleton = RevisionRef(item=project.skeletons.create("rig", {"hierarchy": hierarchy}).id, revision=1)
    takes = [_take(number) for number in range(CLIPS)]
    for number, take in enumerate(takes):
        project.clips.create(f"take {number:03d}", clip_parts(take, skeleton), collection="takes")
    edited = project.datasets.create("takes", collection="takes")
    edited.commit("first")
    first = servers.copy(edited, into)
    clips = sorted(project.clips.list(collection="takes"), key=lambda clip: clip.name)
    run = FRAMES // 100
    for number, clip in enumerate(clips):
        clip.put_motion(clip_to_document(_with_other_frames(takes[number], number, number * 7, run), skeleton))
    edited.commit("edit some frames of each clip")
    yield _share(f"{run} frames in a row of each clip", first, servers.copy(edited, into))
    clips[0].put_motion(clip_to_document(_with_other_frames(takes[0], 0, 0, FRAMES), skeleton))
    edited.commit("edit all frames of a clip")
    yield _share("all frames of one clip", first, servers.copy(edited, into))


def _take(number: int) -> Clip:
    return captured_walk(FRAMES, JOINTS, number, frame_rate_hz=60.0)


def _with_other_frames(take: Clip, number: int, start: int, count: int) -> Clip:
    """Return the take with `count` frames from `start` on replaced by the same frames of a take with other noise."""
    other = _take(CLIPS + number)
    poses = np.array(take.poses)
    poses[start : start + count] = other.poses[start : start + count]
    return Clip(take.skeleton, take.frame_rate_hz, poses)


def _share(what: str, first: Copy, second: Copy) -> Row:
    """Return the row for a second copy: the bytes to and from each server, as a share of those of the first copy."""
    read, sent = second.source_bytes / first.source_bytes, second.target_bytes / first.target_bytes
    return Row(
        "second copy with 1 % edited frames", f"{CLIPS} clips of {FRAMES} frames, {JOINTS} joints; {what}",
        f"{sent * 100:.1f} % to and from the second server, {second.target_bytes / 1e6:.2f} of "
        f"{first.target_bytes / 1e6:.1f} MB; {read * 100:.1f} % the first; "
        f"{second.seconds:.1f} of {first.seconds:.1f} s",
        goal=f"≤ {GOAL_SHARE * 100:.0f} % transferred", met=max(read, sent) <= GOAL_SHARE,
    )  # fmt: skip
