"""Merging of the documents of annotations that both sides of a merge have changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from marey_schemas.kinds import Kind
from marey_schemas.sizes import batched
from marey_server.prepared_documents import PreparedDocument
from marey_server.store import documents, items
from marey_server.store.datasets.contents import Contents, find_contents_of
from marey_server.store.datasets.history import revisions_with
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.transaction import Transaction
from marey_versions.annotations import ADDED_TWICE, AnnotationClash, AnnotationVersion, merge_annotations
from marey_versions.merging import ChangedPart
from marey_versions.records import document_content, local_document, portable_document, references_in

PART = "annotation"
AT_ONCE = 100
"""Greatest number of annotations that are loaded with one set of SQL statements."""
MOST_MERGED = 1_000
"""Greatest number of annotations that one merge combines. This bounds how long other writers wait for the commit."""
MOST_MERGED_BY_JOB = 50
"""Greatest number of annotations that the commit of a job's outputs merges.

It is smaller than `MOST_MERGED`, because the merge may be computed in a write transaction, while other writers wait.
"""
MOST_BYTES = 8 * 1024**2
"""Greatest total size of the documents that one merge loads, in bytes."""

NO_CONTENT = AnnotationClash("The project has no revision with the content of one of the versions.")


class AnnotationMerger:
    """Merges annotations of one project, and keeps the resulting documents until a commit stores them."""

    def __init__(self, tx: Transaction, project_id: str, most: int | None = None) -> None:
        """Create a merger of at most `most` annotations (by default `MOST_MERGED`); further ones become conflicts."""
        self._tx = tx
        self._project_id = project_id
        self._most = MOST_MERGED if most is None else most
        self._too_many = AnnotationClash(
            f"Both sides have changed more than {self._most:,} annotations, or annotations of more than "
            f"{MOST_BYTES // 1024**2} MiB in total, so this one was not merged segment by segment."
        )
        self._loaded = 0
        self._loaded_bytes = 0
        self.documents: dict[str, PreparedDocument] = {}
        """Merged documents by content digest."""

    def merge(self, changed: Sequence[ChangedPart]) -> list[str | AnnotationClash | None]:
        """Merge the annotations among the parts that both sides have changed.

        Returns one value for each part: the content digest of the merged annotation, or the reason why it cannot be
        merged. The value is None if the part is not an annotation.
        """
        outcomes: list[str | AnnotationClash | None] = [None] * len(changed)
        places = [at for at, one in enumerate(changed) if one.ours.kind == Kind.ANNOTATION.value and one.part == PART]
        for some in batched(places, AT_ONCE):
            for at, outcome in zip(some, self._merge_some([changed[at] for at in some]), strict=True):
                outcomes[at] = outcome
        return outcomes

    def _merge_some(self, changed: Sequence[ChangedPart]) -> list[str | AnnotationClash]:
        versions = [_contents_of(one) for one in changed]
        digests = self._find_documents({content for three in versions for content in three})
        sizes = documents.stored_bytes_of(self._tx, digests.values())
        refused = [self._refusal(three, digests, sizes) for three in versions]
        chosen = {
            digests[content]
            for three, refusal in zip(versions, refused, strict=True)
            if refusal is None
            for content in three
        }
        bodies = documents.load_bodies(self._tx, chosen)
        clips = {one for body in bodies.values() for one in references_in(body["clip"])}
        contents = find_contents_of(self._tx, self._project_id, clips)
        return [
            refusal or self._merge_versions([bodies[digests[content]] for content in three], contents)
            for three, refusal in zip(versions, refused, strict=True)
        ]

    def _find_documents(self, wanted: Iterable[str]) -> dict[str, str]:
        """Find the annotation revisions with the content digests `wanted`, and return the digests of their documents.

        The keys of the result are the content digests. Revisions that the project does not have are left out.
        """
        held = revisions_with(self._tx, self._project_id, wanted)
        parts = read_part_digests(self._tx, set(held.values()))
        return {content: parts[key][PART] for content, key in held.items()}

    def _refusal(
        self, three: Sequence[str], digests: Mapping[str, str], sizes: Mapping[str, int]
    ) -> AnnotationClash | None:
        """Return the reason why an annotation is not merged, or None if its three versions can be loaded.

        `three` are the content digests of the base, our version and their version. `digests` maps content digests to
        digests of documents, and `sizes` maps digests of documents to sizes in bytes.
        """
        if not three:
            return ADDED_TWICE
        if any(content not in digests for content in three):
            return NO_CONTENT
        self._loaded += 1
        self._loaded_bytes += sum(sizes[digests[content]] for content in three)
        return self._too_many if self._loaded > self._most or self._loaded_bytes > MOST_BYTES else None

    def _merge_versions(self, bodies: Sequence[Mapping[str, Any]], contents: Contents) -> str | AnnotationClash:
        """Merge the documents of the base, our side and their side; return the new content digest, or a clash."""
        merged = merge_annotations(*(_version(body, contents) for body in bodies))
        if isinstance(merged, AnnotationClash):
            return merged
        clips = {contents.revisions.get(one): one for body in bodies for one in references_in(body["clip"])}
        local = {**merged, "clip": local_document(merged["clip"], clips.get)}
        prepared = items.prepare_part(Kind.ANNOTATION, PART, local)
        digest = document_content(prepared.body, contents.revisions.get)
        self.documents[digest] = prepared
        return digest


def _contents_of(one: ChangedPart) -> tuple[str, ...]:
    """Return the three content digests of the entry to which a part belongs: in the base, on our side, on their side.

    If the entry does not exist in the base, the result is empty.
    """
    return () if one.base is None else (one.base.content, one.ours.content, one.theirs.content)


def _version(body: Mapping[str, Any], contents: Contents) -> AnnotationVersion:
    """Return a version of an annotation, in the form that can be merged, from its stored document.

    The reference to the clip, the only reference in the document, is replaced by the content digest of the clip.
    """
    motion = next((contents.parts.get(one, {}).get("motion") for one in references_in(body["clip"])), None)
    return AnnotationVersion({**body, "clip": portable_document(body["clip"], contents.revisions.get)}, motion)
