"""Jobs of the kind `index` whose earlier index cannot be read."""

from __future__ import annotations

from typing import Any, cast

import pytest

from marey_motion.similarity.shards import FULL_SHARD_ROWS
from marey_schemas.documents.motion_indexes import IndexShard, MotionIndexDocument, ShardClips
from marey_schemas.documents.reports import StoredFile
from marey_schemas.kinds import Kind
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context, JobRefused
from marey_worker.kinds.index import _earlier_shards, _is_worth_keeping, _needed, _places

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


def test_a_shard_is_kept_if_half_of_a_full_one_is_still_needed() -> None:
    half = FULL_SHARD_ROWS // 2 + 1
    clips = ShardClips(
        items=("clip_a", "clip_b", "clip_c"), revisions=(1, 2, 1), rows=(half, half, 5), joints=(1, 1, 1),
        frames=(9, 9, 9), rates_hz=(30.0, 30.0, 30.0),
    )  # fmt: skip
    file = StoredFile(blob=DIGEST, size_bytes=1)
    shard = IndexShard(clips=file, poses=file, rows=2 * half + 5, dropped=(2,))
    pin = PinnedInput(item="clip", revision=1, kind=Kind.CLIP, name="walk", collection="")
    wanted = {("clip_a", 1): pin, ("clip_b", 1): pin, ("clip_c", 1): pin}
    needed = _needed(shard, clips, wanted)
    assert needed == [0], "clip_b has changed, and clip_c was dropped before"
    assert list(_places(clips, needed)) == [("clip_a", 1)]
    assert _is_worth_keeping(clips, needed)
    assert not _is_worth_keeping(clips, [2])
