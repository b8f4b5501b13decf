"""Demonstration: takes are imported, retargeted to a second skeleton, drawn, exported, versioned, and evaluated.

All steps send requests to a local server, as any other client program does.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from marey_client import embedded
from marey_client.cli.demo.evaluation import evaluate_locomotion
from marey_client.cli.demo.report import DemoReport, print_report
from marey_client.cli.demo.versions import version_results
from marey_client.cli.terminal.output import print_json, print_message
from marey_client.credentials import read_secret
from marey_client.errors import NotFound
from marey_client.extras import import_optional
from marey_client.handles.clips import ClipHandle
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.imports import FoundFiles, LocalFile, find_files
from marey_client.jobs import Jobs
from marey_client.marey import Marey
from marey_client.progress import Advance, progress
from marey_client.project import ProjectHandle
from marey_schemas.access import ProjectCreate
from marey_schemas.address import ADMIN_TOKEN_FILE
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.imports import ImportEntry
from marey_schemas.options.imports import ImportOptions
from marey_schemas.queue.jobs import Job

PROJECT = "demo"
TAKES, RESULTS, SKELETON = "takes", "retargeted", "game"
SHEET_TAKES = 8


def demonstrate(motion: Path | None, *, data: Path, keep_serving: bool, as_json: bool) -> None:
    """Run the demonstration; a second run with the same folder `data` reuses the results of the first run."""
    os.environ.setdefault("MAREY_LOG_LEVEL", "warning")
    with embedded.server_in_thread(data, workers=1) as url, Marey(url, read_secret(data / ADMIN_TOKEN_FILE)) as marey:
        files = find_files([motion]) if motion else _generated_takes(data / "generated")
        with progress() as advance:
            report = Story(_demo_project(marey), files, data, advance).run()
        report.server = url
        if as_json:
            print_json(report.as_dict())
        else:
            print_report(report)
        if keep_serving:
            _serve_on(url, data)


@dataclass
class Story:
    """The demonstration in one project, step by step."""

    project: ProjectHandle
    files: FoundFiles
    data: Path
    advance: Advance
    seconds: dict[str, float] = field(default_factory=dict)

    def run(self) -> DemoReport:
        """Run all steps and return their results."""
        with self._timed("import"):
            entries = self._import()
        with self._timed("retarget"):
            target = self._target()
            sources = self._sources(entries)
            job = self._retarget(list(sources.values()), target)
        tasks = [job, *self.project.jobs(filters={"parent": job.id})] if job else []
        tasks = [task for task in tasks if task.size is None]
        results = self._results(sources)
        with self._timed("files"):
            shown = _evenly(results, SHEET_TAKES)
            exported = [self._export(clip) for clip in shown]
            sheet = self._contact_sheet([(sources[_source_path(clip)], clip) for clip in shown], len(results))
        with self._timed("version"):
            entries_of = {_source_path(clip): clip for clip in results}
            version = version_results(self.project, entries_of, target, self.data) if results else None
        with self._timed("evaluate"):
            root = target.hierarchy().joints[0].name
            evaluation = evaluate_locomotion(self.project, entries_of, version, root, self.data, self.advance)
        return DemoReport(
            entries=entries,
            left_out=len(self.files.left_out),
            job=job,
            sources=[clip.item for clip in sources.values()],
            results=[clip.item for clip in results],
            seconds=self.seconds,
            data=self.data,
            exported=exported,
            tasks=len(tasks),
            shared_tasks=sum(task.cached_from is not None for task in tasks),
            sheet=sheet,
            version=version,
            evaluation=evaluation,
        )

    @contextmanager
    def _timed(self, step: str) -> Iterator[None]:
        started = time.monotonic()
        yield
        self.seconds[step] = time.monotonic() - started

    def _import(self) -> Sequence[ImportEntry]:
        options = ImportOptions(collection=TAKES)
        return self.project.imports.upload(self.files.files, options, notice=self.advance)

    def _sources(self, entries: Sequence[ImportEntry]) -> dict[str, ClipHandle]:
        """Return the clips of this run's files by path, without the clips of earlier runs."""
        imported = {entry.item for entry in entries}
        clips = self.project.clips.list(collection=TAKES)
        return {clip.path: clip for clip in clips if clip.id in imported}

    def _results(self, sources: Mapping[str, ClipHandle]) -> list[ClipHandle]:
        """Return the clips that were retargeted from the given sources, sorted by path."""
        clips = self.project.clips.list(collection=RESULTS)
        return sorted((clip for clip in clips if _source_path(clip) in sources), key=lambda clip: clip.path)

    def _target(self) -> SkeletonHandle:
        """Return the skeleton to which takes are retargeted; it is created on the first run."""
        found = next(self.project.skeletons.list(path=f"{TAKES}/{SKELETON}"), None)
        return found or self.project.skeletons.create(SKELETON, _game_skeleton_parts(), collection=TAKES)

    def _retarget(self, sources: Sequence[ClipHandle], target: SkeletonHandle) -> Job | None:
        """Retarget the takes to the second skeleton; return the job when it has ended, or None if there is no take."""
        if not sources:
            return None
        job = self.project.retarget(sources, target.id, into=RESULTS)
        return Jobs(self.project.transport).wait(job.id, on_progress=self._show)

    def _show(self, job: Job) -> None:
        self.advance("retargeting", job.children.get("succeeded", 0), job.size)

    def _export(self, clip: ClipHandle) -> Path:
        return clip.export(self.data / "files", format="bvh")

    def _contact_sheet(self, pairs: Sequence[tuple[ClipHandle, ClipHandle]], total: int) -> Path | None:
        """Draw pairs of source and result side by side; return the path of the image, or None if there are no pairs.

        `total` is the number of all pairs; `pairs` are a selection from them.
        """
        if not pairs:
            return None
        figures = import_optional("marey_reports.drawing.contact_sheet", "all")
        load = _clip_loader(self.project)
        takes = [figures.TakePair(source.name, load(source), load(result)) for source, result in pairs]
        path = self.data / "contact-sheet.png"
        path.write_bytes(figures.contact_sheet(takes, heading="Takes and their results", total=total, choice=CHOICE))
        return path


# -- material --


def _generated_takes(folder: Path) -> FoundFiles:
    """Return generated walks, runs and turns as BVH files; they are the same on every machine."""
    folder.mkdir(parents=True, exist_ok=True)
    write_bvh = import_optional("marey_motion.formats", "all").write_bvh
    files = []
    for take in import_optional("marey_motion.gait", "all").generate_dataset():
        path = folder / f"{take.name}.bvh"
        path.write_bytes(write_bvh(take.clip))
        files.append(LocalFile(path.name, path, path.stat().st_size))
    return FoundFiles(tuple(files), ())


def _game_skeleton_parts() -> dict[str, Any]:
    """Return a skeleton whose joint names, proportions, rest pose and axes differ from those of the takes' skeleton."""
    documents = import_optional("marey_motion.documents", "all")
    rigs = import_optional("marey_motion.rigs", "all")
    skeleton = import_optional("marey_motion.gait", "all").game_skeleton()
    mapping = rigs.map_joints(skeleton)
    parts = {
        "hierarchy": documents.skeleton_to_document(skeleton),
        "mapping": documents.mapping_to_document(mapping, rigs.guess_axes(skeleton, mapping)),
    }
    return {name: part.model_dump(by_alias=True, exclude_none=True) for name, part in parts.items()}


def _clip_loader(project: ProjectHandle) -> Callable[[ClipHandle], Any]:
    """Return a function that loads clips of the server as clips of `marey_motion`; it loads each skeleton only once."""
    documents = import_optional("marey_motion.documents", "all")
    skeletons: dict[tuple[str, int], Any] = {}

    def load(clip: ClipHandle) -> Any:
        motion = clip.motion()
        ref = motion.skeleton.model_dump()
        key = (ref["item"], ref["revision"])
        if key not in skeletons:
            hierarchy = project.skeletons.get(ref["item"]).part("hierarchy", revision=ref["revision"])
            skeletons[key] = documents.skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
        return documents.clip_from_document(motion, skeletons[key])

    return load


def _demo_project(marey: Marey) -> ProjectHandle:
    try:
        marey.project(PROJECT).read()
    except NotFound:
        return marey.create_project(ProjectCreate(name=PROJECT, title="Demonstration"))
    return marey.project(PROJECT)


def _source_path(result: ClipHandle) -> str:
    """Return the path of the take that was retargeted: the path of the result without the first folder."""
    return result.path.removeprefix(f"{RESULTS}/")


CHOICE = "evenly spaced in the order of their paths"
"""Order in which `_evenly` chooses clips, in words."""


def _evenly(clips: Sequence[ClipHandle], most: int) -> list[ClipHandle]:
    """Return up to `most` clips, evenly spaced over all of them."""
    if len(clips) <= most:
        return list(clips)
    return [clips[index * (len(clips) - 1) // (most - 1)] for index in range(most)]


def _serve_on(url: str, data: Path) -> None:
    print_message(f"serving at {url}; the administrator's token is in {data / ADMIN_TOKEN_FILE}; stop with Ctrl-C")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        print_message("stopping")
