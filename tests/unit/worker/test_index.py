"""Jobs of the kind `index`: what happens to an earlier index that cannot be read."""

from __future__ import annotations

from typing import Any, cast

import pytest

from marey_schemas.documents.motion_indexes import IndexShard, MotionIndexDocument
from marey_schemas.documents.reports import StoredFile
from marey_schemas.kinds import Kind
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context, JobRefused
from marey_worker.kinds.index import _earlier_shards

DIGEST = f"sha256:{'0' * 64}"


class StoredIndex:
    """Context of a job whose earlier index has one shard with this list of clips."""

    def __init__(self, clips: bytes) -> None:
        self._clips = clips

    def document(self, *_: object) -> Any:
        file = StoredFile(blob=DIGEST, size_bytes=1)
        shard = IndexShard(clips=file, poses=file, rows=1)
        return MotionIndexDocument(clips=1, rows=1, shards=(shard,)).model_dump(mode="json", by_alias=True)

    def blob(self, _: str) -> bytes:
        return self._clips


@pytest.mark.parametrize("clips", [b"{", b"[]", b"\xff\xfe", b'{"items": ["clip_x"]}'])
def test_a_damaged_earlier_index_refuses_the_job_and_names_the_remedy(clips: bytes) -> None:
    pin = PinnedInput(item="index_x", revision=1, kind=Kind.INDEX, name="motion", collection="")
    with pytest.raises(JobRefused, match="the index motion is damaged and cannot be updated; delete it") as caught:
        _earlier_shards(cast(Context, StoredIndex(clips)), pin)
    assert caught.value.code == "index-damaged"
