"""Version of a dataset in memory, for tests of exports that need no server."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

from marey_client.bridges.version import DescribedClip, VersionToExport
from marey_client.handles.versions import DatasetHandle
from marey_motion import documents
from marey_motion.clip import Clip
from marey_schemas.datasets.commits import Commit, Entry
from marey_schemas.datasets.exports import ExportedClip, ExportedRecord
from marey_schemas.encoding.canonical import document_digest
from marey_schemas.kinds import Kind
from marey_versions.records import revision_content

GROUP = 3
"""Number of clips in a group, so that tests have several groups."""


def digest(text: str) -> str:
    return f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


@dataclass(frozen=True)
class VersionInMemory(VersionToExport):
    """Version whose clips are in memory."""

    motions: Mapping[str, Clip] = field(default_factory=dict)
    records: Mapping[str, ExportedRecord] = field(default_factory=dict)

    @classmethod
    def of(cls, motions: Mapping[str, Clip], records: Mapping[str, ExportedRecord] | None = None) -> VersionInMemory:
        """Return the version `v1` of the dataset `gaits` with clips at paths."""
        commit = Commit(
            digest=digest("commit"), tree=digest("tree"), parents=(), author="ada", message="First takes",
            at=datetime(2026, 11, 23, 10, tzinfo=UTC), entries=len(motions),
        )  # fmt: skip
        clips = tuple(
            Entry(path=path, kind=Kind.CLIP, parts={"motion": digest(path)}, tags=(), item=f"clip{place}", revision=1)
            for place, path in enumerate(sorted(motions))
        )
        dataset = DatasetHandle(cast(Any, None), "/projects/lab/datasets/gaits")
        return cls(dataset, commit, "v1", "", clips, {}, motions=motions, records=records or {})

    def described(self, pool: ThreadPoolExecutor) -> Iterator[list[DescribedClip]]:
        for start in range(0, len(self.clips), GROUP):
            yield [DescribedClip(one, self.clip(one)) for one in self.clips[start : start + GROUP]]

    def clip(self, entry: Entry) -> ExportedClip:
        content = revision_content("clip", entry.parts)
        return ExportedClip(path=entry.path, content=content, record=self.records.get(entry.path, ExportedRecord()))

    def documents(self, entries: Sequence[Entry], part: str) -> Iterator[dict[str, Any]]:
        assert part == "motion"
        for one in entries:
            motion = self.motions[one.path]
            yield documents.clip_to_tree(motion, {"content": self.skeleton_of(motion)})

    def skeleton_of(self, motion: Clip) -> str:
        return digest(f"skeleton {document_digest(self.hierarchy_of(motion))}")

    def hierarchy_of(self, motion: Clip) -> dict[str, Any]:
        return documents.skeleton_to_document(motion.skeleton).model_dump(mode="json", by_alias=True)

    def parts_of(self, content: str) -> Mapping[str, str]:
        for motion in self.motions.values():
            if self.skeleton_of(motion) == content:
                return {"hierarchy": document_digest(self.hierarchy_of(motion))}
        raise AssertionError(content)


def tree(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files in a folder and its subfolders, by path."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
