"""Versions in the demonstration: the results are committed, one is edited on a branch, and the merge is tagged."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from marey_client import embedded
from marey_client.errors import Invalid, NotFound
from marey_client.handles.clips import ClipHandle
from marey_client.handles.skeletons import SkeletonHandle
from marey_client.handles.versions import DatasetHandle
from marey_client.jobs import Jobs
from marey_client.project import ProjectHandle
from marey_schemas.datasets.commits import MOST_CHANGES, PutEntry
from marey_schemas.datasets.naming import MAIN, Ref, RefKind
from marey_schemas.editing.commands import Smooth
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.jobs import DatasetInput
from marey_schemas.sizes import batched

DATASET, BRANCH, EDITED = "results", "smoothed", "smoothed"
SHORTEST_FRAMES = 30
"""Least number of frames of a clip that is smoothed."""


@dataclass(frozen=True)
class DemoVersion:
    """Tagged version that contains the results of the demonstration; one of them is smoothed.

    `edited` is the path of the smoothed clip. `picture` is the file that shows what smoothing changed. Both are None if
    all clips are too short.
    """

    tag: str
    commit: str
    entries: int
    edited: str | None
    picture: Path | None

    def as_dict(self) -> dict[str, Any]:
        """Return the version as a dict for JSON."""
        picture = None if self.picture is None else str(self.picture.absolute())
        return {"dataset": DATASET, **asdict(self), "picture": picture}

    def places(self, paths: Sequence[str]) -> list[DatasetInput]:
        """Return the clips at these paths of the version as inputs of jobs."""
        return [DatasetInput(dataset=DATASET, version=self.tag, path=path) for path in paths]


def version_results(
    project: ProjectHandle, results: Mapping[str, ClipHandle], skeleton: SkeletonHandle, folder: Path
) -> DemoVersion:
    """Commit the results, smooth the longest clip on a branch, merge the branch, and tag the merged version.

    `results` maps the paths of entries to the clips that they will contain. If the newest tag already
    names a version with these results, no new tag is set. A picture that shows what smoothing changed is written to
    `folder`.
    """
    dataset = _opened(project)
    smoothed = {clip.path.removeprefix(f"{EDITED}/") for clip in project.clips.list(collection=EDITED)}
    unedited = {path: clip for path, clip in results.items() if path not in smoothed}
    puts = [PutEntry(path=path, item=clip.id, revision=clip.item.revision) for path, clip in unedited.items()]
    for some in batched(puts, MOST_CHANGES):
        _commit(dataset, "Retargeted takes", some)
    tags = sorted((one for one in dataset.refs() if _is_numbered(one)), key=lambda one: int(one.name[1:]))
    path = max(results, key=lambda path: (results[path].item.summary["frames"], path))
    chosen = results[path] if results[path].item.summary["frames"] >= SHORTEST_FRAMES else None
    if not tags or tags[-1].commit != dataset.ref(MAIN).commit:
        if chosen is not None:
            _smooth_on_branch(project, dataset, path)
        _commit(dataset, "Add the skeleton", [PutEntry(path="skeleton", item=skeleton.id)])
        _merge_branch(dataset)
        number = 1 + max((int(one.name[1:]) for one in tags), default=0)
        tags.append(dataset.create_tag(f"v{number}"))
    picture = None if chosen is None else _draw_difference(project, path, chosen, folder)
    made = dataset.at(tags[-1].name)
    return DemoVersion(tags[-1].name, made.digest, made.entries, path if chosen else None, picture)


def _is_numbered(ref: Ref) -> bool:
    """Return whether a ref is a tag named like the tags of the demonstration, such as `v1`; users may set others."""
    return ref.kind is RefKind.TAG and re.fullmatch(r"v[0-9]{1,9}", ref.name) is not None


def _opened(project: ProjectHandle) -> DatasetHandle:
    try:
        dataset = project.datasets.at(DATASET)
        dataset.read()
    except NotFound:
        dataset = project.datasets.create(DATASET, description="Takes on another skeleton")
    return dataset


def _commit(dataset: DatasetHandle, message: str, changes: Sequence[PutEntry]) -> None:
    """Commit changes, unless the newest version has them already."""
    try:
        dataset.commit(message, changes=changes)
    except Invalid as error:
        if error.code != "no-changes":
            raise


def _smooth_on_branch(project: ProjectHandle, dataset: DatasetHandle, path: str) -> None:
    """Start a branch at the newest version, and run a job that smooths a clip and commits the result to this branch."""
    if dataset.find_ref(BRANCH) is None:
        dataset.create_branch(BRANCH)
    else:
        dataset.move_branch(BRANCH, MAIN)
    clip = DatasetInput(dataset=DATASET, version=MAIN, path=path)
    commit = OutputsCommit(dataset=DATASET, branch=BRANCH, folder="", message=f"Smooth {path}")
    job = project.edit(clip, Smooth(), into=EDITED, commit=commit)
    Jobs(project.transport).wait(job.id)


def _merge_branch(dataset: DatasetHandle) -> None:
    """Merge the branch if it has a commit of its own."""
    try:
        dataset.merge(BRANCH)
    except (NotFound, Invalid) as error:
        if error.code not in ("no-version", "already-merged"):
            raise


def _draw_difference(project: ProjectHandle, path: str, clip: ClipHandle, folder: Path) -> Path | None:
    """Draw what smoothing changed; return the path of the picture, or None if there is no smoothed clip."""
    smoothed = next(project.clips.list(path=f"{EDITED}/{path}"), None)
    if smoothed is None:
        return None
    picture = folder / "difference.svg"
    picture.write_bytes(embedded.draw_difference(clip.difference(other=smoothed, plot=True), "svg"))
    return picture
