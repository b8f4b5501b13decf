"""Search for poses of clips in indexes of motions, which contain copies of them."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from pydantic import ValidationError
from sqlalchemy import select

from marey_schemas.documents.motion_indexes import MotionIndexDocument, ShardClips
from marey_schemas.documents.reports import StoredFile
from marey_schemas.kinds import Kind
from marey_schemas.sizes import MIB
from marey_server.store import documents
from marey_server.store.tables import blob, item, revision_part
from marey_server.store.transaction import Transaction, in_lists

_MOST_LIST_BYTES = 64 * MIB
"""Greatest size of a list of clips that is read; the list of a full shard has about 40 KB."""


class IndexSearch:
    """Search for clips in all revisions of the indexes of motions of a project.

    An index consists of shards, each with a list of its clips; a clip that the index no longer uses may still be in a
    shard. Each list is read once, although many revisions share it. A second `update`, in a later transaction, reads
    only the lists that were added in the meantime.
    """

    def __init__(self, project_id: str, clips: Iterable[str]) -> None:
        self._project_id, self._clips = project_id, frozenset(clips)
        self._lists: dict[str, tuple[StoredFile, ...]] = {}
        """Lists of clips that an index document names, by the digest of the document."""
        self._found: dict[str, frozenset[str]] = {}
        """Clips of the constructor's `clips` in each list, by the digest of the list."""

    def update(self, tx: Transaction) -> dict[str, frozenset[str]]:
        """Read the lists of clips that were added since the last call, and return what all lists contain.

        The result maps the id of an index to those clips of the constructor's `clips` whose poses are in some revision
        of this index; an index without such clips is left out. If a list cannot be read, for example because somebody
        has written the index by hand, the list is assumed to contain all of `clips`.
        """
        if not self._clips:
            return {}
        statement = (
            select(revision_part.c.item_id, revision_part.c.document_digest)
            .join(item, item.c.id == revision_part.c.item_id)
            .where(item.c.project_id == self._project_id, item.c.kind == Kind.INDEX.value)
        )
        rows = tx.execute(statement).all()
        self._read_documents(tx, {row.document_digest for row in rows} - self._lists.keys())
        found: dict[str, set[str]] = {}
        for row in rows:
            for file in self._lists[row.document_digest]:
                found.setdefault(row.item_id, set()).update(self._found[file.blob])
        return {index: frozenset(clips) for index, clips in found.items() if clips}

    def _read_documents(self, tx: Transaction, digests: Collection[str]) -> None:
        for digest, body in documents.load_bodies(tx, sorted(digests)).items():
            index = MotionIndexDocument.model_validate(body)
            self._lists[digest] = tuple(shard.clips for shard in index.shards)
        named = {file.blob for digest in digests for file in self._lists[digest]}
        for some in in_lists(sorted(named - self._found.keys())):
            sizes = select(blob.c.digest, blob.c.size_bytes).where(blob.c.digest.in_(some))
            for row in tx.execute(sizes).all():
                self._found[row.digest] = self._clips_in(tx, row.digest, row.size_bytes)

    def _clips_in(self, tx: Transaction, digest: str, size_bytes: int) -> frozenset[str]:
        if size_bytes > _MOST_LIST_BYTES:
            return self._clips
        content = b"".join(tx.blobs.read(tx.connection, digest, 0, size_bytes))
        try:
            return self._clips.intersection(ShardClips.model_validate_json(content).items)
        except ValidationError:
            return self._clips
