"""Reading of a version that is exported: its clips, with their take records and their lineage."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypedDict

from marey_client.archives.contents import read_documents, request_contents
from marey_client.archives.writing import DatasetReader, check_consents
from marey_client.asynchronous.interruption import CallPool
from marey_client.errors import CannotExport
from marey_schemas.datasets.commits import TIME_OF_COMMIT, Commit, Entry
from marey_schemas.datasets.contents import MOST_CONTENTS, ContentsRequest, RequestedDocument
from marey_schemas.datasets.exports import (
    ExportedClip,
    ExportedIdentity,
    ExportedInput,
    ExportedJob,
    ExportedRecord,
    ExportedSource,
)
from marey_schemas.datasets.naming import Ref, RefKind
from marey_schemas.documents.clips import ClipInfo
from marey_schemas.kinds import Kind
from marey_schemas.lineage import LineageGraph
from marey_schemas.sizes import batched
from marey_versions.records import revision_content

if TYPE_CHECKING:
    from marey_client.transport import Params

EXPORTS_AT_ONCE = 4
"""Number of requests that an export sends at the same time."""


class DatasetToExport(DatasetReader, Protocol):
    """Methods of `DatasetHandle` that are needed to export a version."""

    def entries(self, version: str, *, path: str = "") -> Iterator[Entry]:
        """List all entries of a version, or only the entries below a folder."""

    def find_ref(self, name: str) -> Ref | None:
        """Return the branch or the tag with this name; None if there is none."""


class ExportOptions(TypedDict, total=False):
    """Keyword arguments that every export of a version accepts."""

    path: str
    """Folder of entries to which the export is limited; default: all entries."""
    allow_expired_consent: str | None
    """Reason to export clips whose consent has ended; None: such clips are refused."""


class DescribedClip(NamedTuple):
    """Clip of a version: its entry, and its description for the sidecar."""

    entry: Entry
    clip: ExportedClip


class _Located(NamedTuple):
    """Entry of a clip, and an item of the project with the number of a revision that has the same content."""

    entry: Entry
    item: str
    revision: int

    @property
    def content(self) -> str:
        """The content digest of the revision."""
        return revision_content(self.entry.kind.value, self.entry.parts)


@dataclass(frozen=True)
class VersionToExport:
    """Version of a dataset that may be exported: its clips, and facts that the files of an export state."""

    dataset: DatasetToExport
    commit: Commit
    tag: str | None
    folder: str
    clips: tuple[Entry, ...]
    left_out: Mapping[str, int]
    """Number of entries that are not clips, by kind."""
    ended: frozenset[str] = frozenset()
    """Ids of the clips whose consent has ended, and whose export the server has allowed."""

    @property
    def identity(self) -> ExportedIdentity:
        """The fields that identify the version, independent of the server."""
        return ExportedIdentity(
            dataset=self.dataset.name,
            commit=self.commit.digest,
            tag=self.tag,
            folder=self.folder,
            author=self.commit.author,
            at=self.commit.at.strftime(TIME_OF_COMMIT),
            message=self.commit.message,
        )

    def described(self, pool: CallPool) -> Iterator[list[DescribedClip]]:
        """Yield the clips in the order of their paths, with take records and lineage, in groups of limited size."""
        for some in batched(self.clips, MOST_CONTENTS):
            group = [_located(one) for one in some]
            infos = self._infos(group)
            jobs = pool.map(self._job_of, group)
            yield [
                DescribedClip(one.entry, _exported(one, info, job))
                for one, info, job in zip(group, infos, jobs, strict=True)
            ]

    def documents(self, entries: Sequence[Entry], part: str) -> Iterator[dict[str, Any]]:
        """Yield the document of the given part of each entry; the documents refer to revisions by content digest."""
        places = [RequestedDocument(content=_located(one).content, part=part) for one in entries]
        return read_documents(self.dataset.transport, self.dataset.project_url, places)

    def parts_of(self, content: str) -> Mapping[str, str]:
        """Return the content digest of each part, by name, of the revision that has the content digest `content`."""
        request = ContentsRequest(revisions=(content,))
        (found,) = request_contents(self.dataset.transport, self.dataset.project_url, request)["revisions"]
        if found is None:
            raise CannotExport(
                f"the project no longer has the revision with the content digest {content}; restore its item"
            )
        parts: Mapping[str, str] = found["parts"]
        return parts

    def _infos(self, group: Sequence[_Located]) -> list[ClipInfo]:
        described = [one.entry for one in group if "info" in one.entry.parts]
        found = {id(entry): tree for entry, tree in zip(described, self.documents(described, "info"), strict=True)}
        return [ClipInfo.model_validate(found.get(id(one.entry), {})) for one in group]

    def _job_of(self, clip: _Located) -> ExportedJob | None:
        """Return the job that made a revision, or None if a user made it."""
        url = f"{self.dataset.project_url}/{clip.entry.kind.plural}/{clip.item}/lineage-graph"
        query: Params = {"revision": clip.revision, "direction": "inputs", "depth": 1}
        graph = self.dataset.transport.get(LineageGraph, url, query)
        made = graph.revisions[0].job
        job = next((one for one in graph.jobs if one.id == made), None)
        if job is None:
            return None
        used = ((link.role, graph.revisions[link.source]) for link in graph.links if link.result == 0)
        inputs = [
            ExportedInput(role=role, kind=one.kind.value, item=one.item, revision=one.revision) for role, one in used
        ]
        inputs.sort(key=lambda one: (one.role, one.item, one.revision))
        return ExportedJob(
            id=job.id,
            kind=job.kind,
            seed=job.seed,
            code_versions=tuple(sorted(job.code_versions)),
            commits=tuple(sorted(job.commits)),
            inputs=tuple(inputs),
        )


def version_to_export(
    dataset: DatasetToExport, version: str, folder: str = "", *, allow_expired_consent: str | None = None
) -> VersionToExport:
    """Read all entries of a version, or only the entries below a folder; check that the clips may be exported.

    Raises `CannotExport` if there is no clip. Raises `Conflict` if the consent for a clip has ended, unless
    `allow_expired_consent` gives a reason to export the clip.
    """
    commit, named = dataset.at(version), dataset.find_ref(version)
    folder = folder.strip("/")
    entries = list(dataset.entries(commit.digest, path=folder))
    clips = tuple(one for one in entries if one.kind is Kind.CLIP)
    if not clips:
        place = f"below {folder!r}" if folder else "in any folder"
        raise CannotExport(
            f"the version {version} of {dataset.name} has no clips {place}; `marey dataset entries` lists its entries"
        )
    contents = dict.fromkeys(_located(one).content for one in clips)
    ended = check_consents(dataset, allow_expired_consent, list(contents))
    return VersionToExport(
        dataset,
        commit,
        tag=version if named is not None and named.kind is RefKind.TAG else None,
        folder=folder,
        clips=clips,
        left_out=Counter(one.kind.value for one in entries if one.kind is not Kind.CLIP),
        ended=ended,
    )


def _located(entry: Entry) -> _Located:
    if entry.item is None or entry.revision is None:
        raise CannotExport(
            f"{entry.path}: the project no longer has the revision of this clip; restore the clip, or "
            "export a version without it"
        )
    return _Located(entry, entry.item, entry.revision)


def _exported(one: _Located, info: ClipInfo, job: ExportedJob | None) -> ExportedClip:
    record = {name: getattr(info, name) for name in ExportedRecord.model_fields}
    file = None if info.source is None else info.source.file
    source = (
        None
        if info.source is None or file is None
        else ExportedSource(name=info.source.file_name, digest=file, format=info.source.format)
    )
    return ExportedClip(
        path=one.entry.path,
        content=one.content,
        tags=tuple(sorted(one.entry.tags)),
        record=ExportedRecord(**record),
        source=source,
        job=job,
    )
