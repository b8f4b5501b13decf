"""Creation of revisions for dataset entries, if no item of the project has the content of the entry.

Such content was sent by another server, or combined by a merge. For each such entry, a new hidden item is created, so
that no folder changes; a checkout later shows the item at the path of the entry.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from marey_schemas.kinds import Kind
from marey_schemas.lineage import MERGED
from marey_schemas.wording import counted
from marey_server.access.folder_rights import FolderRights
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.prepared_documents import PreparedDocument
from marey_server.store import items
from marey_server.store.datasets.contents import find_contents_of, store_contents
from marey_server.store.datasets.history import revisions_with
from marey_server.store.items import Draft, StoredDocument
from marey_server.store.items.drafts import PartContent
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.projects import ProjectRow
from marey_server.store.transaction import Transaction
from marey_versions.merging import CombinedEntry
from marey_versions.records import RevisionKey

MISSING_CONTENTS = "missing-contents"
"""Code of the error for revisions that the project does not have; `context.contents` lists their digests."""
MOST_COMBINED = 10_000
"""Greatest number of entries for which one merge combines changes of both branches.

Each combined entry is stored as a new revision. The limit also holds for the outputs of a job, which are merged with
the changes that others have made meanwhile.
"""
LONGEST_NAME = 200
"""Greatest number of characters that the name of a new item takes from the last component of a path."""


def require_contents(missing: Iterable[str]) -> None:
    """Raise `ConflictProblem` if there are content digests in `missing`, which the project lacks."""
    if lacking := sorted(missing):
        raise ConflictProblem(
            f"The project lacks {counted(len(lacking), 'revision')} that the request refers to; send them first.",
            code=MISSING_CONTENTS,
            context={"contents": lacking[:1000]},
        )


def item_name(shown: str, content: str) -> str:
    """Return a name for a new item: the last component of the path `shown`, and 12 digits of the content digest."""
    return f"{shown.rpartition('/')[2][:LONGEST_NAME]} {content.removeprefix('sha256:')[:12]}"


def publish_contents(
    tx: Transaction,
    project_row: ProjectRow,
    drafts: Mapping[str, Draft],
    *,
    author_id: str | None,
    rights: FolderRights | None = None,
    job_id: str | None = None,
) -> int:
    """Publish those drafts whose content the project does not have; return their number.

    `drafts` maps the content digest of each revision to its draft. As in `publish`, `rights` may be None only if all
    drafts are hidden. Raises `InvalidProblem` if the content digest of a published revision is not its key in `drafts`.
    """
    held = revisions_with(tx, project_row.id, drafts)
    lacking = [draft for content, draft in drafts.items() if content not in held]
    made = items.publish(
        tx, project_row, lacking, author_id=author_id, rights=rights, job_id=job_id, refer_to_deleted=True
    )  # fmt: skip
    keys = {one.name: RevisionKey(one.item, one.revision) for one in made}
    contents = find_contents_of(tx, project_row.id, keys.values())
    for content, key in keys.items():
        if contents.revisions[key] != content:
            raise InvalidProblem(
                f"According to the request, a revision has the content digest {content}, but the documents of this "
                f"revision have the content digest {contents.revisions[key]}.",
                code="other-content",
            )
    store_contents(tx, contents)
    return len(made)


def store_combined(
    tx: Transaction,
    project_row: ProjectRow,
    folder: str | None,
    combined: Sequence[CombinedEntry],
    merged: Mapping[str, PreparedDocument],
    message: str,
    *,
    author_id: str | None,
    job_id: str | None = None,
) -> None:
    """Store a revision for each entry of a merge that combines changes of both sides, unless the project has it.

    `merged` maps the content digests of merged parts to the documents of these parts. Raises `ConflictProblem` if the
    project lacks a revision from which an entry takes a part.
    """
    sides = {side.content for one in combined for part in one.entry.parts if (side := one.source_of(part)) is not None}
    of_sides = {side.content for one in combined for side in one.sides}
    held = {content: RevisionKey(*key) for content, key in revisions_with(tx, project_row.id, of_sides).items()}
    require_contents(sides - held.keys())
    stored = read_part_digests(tx, {held[content] for content in sides})
    drafts: dict[str, Draft] = {}
    for one in combined:
        entry, parts = one.entry, dict[str, PartContent]()
        for part, digest in entry.parts.items():
            side = one.source_of(part)
            parts[part] = merged[digest] if side is None else StoredDocument(stored[held[side.content]][part])
        drafts[entry.content] = Draft(
            name_in_batch=entry.content, kind=Kind(entry.kind), parts=parts, reuse="new", message=message,
            item_name=item_name(entry.path, entry.content), collection=folder or "", hidden=True,
            sources={MERGED: _sources(one, held)},
        )  # fmt: skip
    publish_contents(tx, project_row, drafts, author_id=author_id, job_id=job_id)


def _sources(one: CombinedEntry, held: Mapping[str, RevisionKey]) -> list[RevisionKey]:
    """Return the revisions of which an entry has parts; for parts that were merged, those of both sides."""
    found: dict[RevisionKey, None] = {}
    for part in one.entry.parts:
        side = one.source_of(part)
        for source in one.sides[:2] if side is None else (side,):
            if source.content in held:
                found[held[source.content]] = None
    return list(found)
