"""Kind `index`: builds or updates an index of the poses of clips, for searches by example.

An index consists of shards, each of which has the poses of several clips. If an earlier index is given, the poses of
clips at the same revision are used again. A shard stays as it is if much of it is still needed; the needed poses of
other shards are copied to new shards. So an update writes little.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.matching.body import MatchingBody
from marey_motion.motion import Motion
from marey_motion.similarity.features import Rows, clip_features
from marey_motion.similarity.shards import FULL_SHARD_ROWS, Runs, Shard, presence, write_shard
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.motion_indexes import (
    INDEX_VERSION,
    MOST_SHARDS,
    IndexShard,
    MotionIndexDocument,
    ShardClips,
)
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.reports import StoredFile
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import IndexParams
from marey_schemas.queue.jobs import ItemInput
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.skeleton_cache import Rig, read_mapped

KEPT_SHARE = 0.5
"""Least number of needed poses with which an earlier shard stays as it is, as a share of the poses of a full shard.

The needed poses of all other shards are copied to new shards.
"""
LEFT_OUT_NAMED = 100
"""Greatest number of clips named in the log because they cannot be compared."""


def run(context: Context, params: IndexParams) -> dict[str, Any]:
    """Build the index of the input clips, from an earlier index if one is given, and stage it.

    Raises `JobRefused` if the earlier index is damaged, or if the new index would have too many shards.
    """
    started = time.monotonic()
    pins = {(pin.item, pin.revision): pin for pin in context.inputs["clips"]}
    earlier = context.inputs.get("index", ())
    shards = [shard for pin in earlier for shard in _earlier_shards(context, pin)]
    kept = [(shard, clips, _needed(shard, clips, pins)) for shard, clips in shards]
    whole = [(shard, clips, runs) for shard, clips, runs in kept if _is_worth_keeping(clips, runs)]
    copied = [(shard, clips, runs) for shard, clips, runs in kept if not _is_worth_keeping(clips, runs)]
    known = {place for _, clips, runs in kept for place in _places(clips, runs)}
    new = [pin for place, pin in pins.items() if place not in known]

    writer = _Writer(context)
    for shard, clips, runs in copied:
        _copy(context, writer, shard, clips, runs)
    left_out = _add_clips(context, writer, new)
    entries = [
        shard.model_copy(update={"dropped": tuple(sorted(set(range(len(clips.items))) - set(runs)))})
        for shard, clips, runs in whole
    ] + writer.finish()
    if len(entries) > MOST_SHARDS:
        raise JobRefused(
            "index-too-large",
            f"the clips need {len(entries):,} shards, and an index has at most {MOST_SHARDS:,}; index fewer clips",
        )
    document = MotionIndexDocument(
        clips=len(pins) - left_out,
        rows=writer.rows + sum(clips.rows[run] for _, clips, runs in whole for run in runs),
        left_out=left_out,
        shards=tuple(entries),
    )
    _stage(context, params, document)
    return {
        "clips": document.clips,
        "new_clips": len(new) - left_out,
        "left_out": left_out,
        "shards": len(entries),
        "written_shards": len(entries) - len(whole),
        "seconds": round(time.monotonic() - started, 4),
    }


def _stage(context: Context, params: IndexParams, document: MotionIndexDocument) -> None:
    sources = {
        name: tuple(ItemInput(item=pin.item, revision=pin.revision) for pin in pins)
        for name, pins in context.inputs.items()
    }
    parts = {"index": document.model_dump(by_alias=True)}
    context.stage([StagedOutput(name="index", kind=Kind.INDEX, item_name=params.name, parts=parts, sources=sources)])


# -- the earlier index -------------------------------------------------------------------------------------------------


def _earlier_shards(context: Context, pin: PinnedInput) -> list[tuple[IndexShard, ShardClips]]:
    """Return the shards of an earlier index, each with the list of its clips; empty if the index has another version.

    Raises `JobRefused` if the index is damaged, for example because somebody wrote it by hand.
    """
    document = MotionIndexDocument.model_validate(context.document(Kind.INDEX, pin.item, pin.revision, "index"))
    if document.version != INDEX_VERSION:
        return []
    try:
        return [(shard, ShardClips.model_validate_json(context.blob(shard.clips.blob))) for shard in document.shards]
    except ValidationError as error:
        raise _damaged(pin) from error


def _damaged(pin: PinnedInput) -> JobRefused:
    return JobRefused(
        "index-damaged", f"the index {pin.name} is damaged and cannot be updated; delete it, and index the clips again"
    )


def _needed(shard: IndexShard, clips: ShardClips, pins: Mapping[tuple[str, int], PinnedInput]) -> list[int]:
    """Return the positions, in a shard's list of clips, of the clips that the new index needs."""
    places = zip(clips.items, clips.revisions, strict=True)
    return [run for run, place in enumerate(places) if place in pins and run not in shard.dropped]


def _is_worth_keeping(clips: ShardClips, runs: Sequence[int]) -> bool:
    return sum(clips.rows[run] for run in runs) >= KEPT_SHARE * FULL_SHARD_ROWS


def _places(clips: ShardClips, runs: Sequence[int]) -> Iterator[tuple[str, int]]:
    return ((clips.items[run], clips.revisions[run]) for run in runs)


def _copy(context: Context, writer: _Writer, shard: IndexShard, clips: ShardClips, runs: Sequence[int]) -> None:
    """Copy the poses of some clips of an earlier shard to a new shard. Raises `JobRefused` if the shard is damaged."""
    if not runs:
        return
    file = context.scratch / "earlier"
    file.write_bytes(context.blob(shard.poses.blob))
    try:
        opened = Shard.open(file, Runs.of(np.array(clips.rows)), np.array(clips.joints))
    except MotionError as error:
        raise _damaged(context.inputs["index"][0]) from error
    for run in runs:
        first, last = opened.runs.starts[run : run + 2]
        facts = {name: getattr(clips, name)[run] for name in ShardClips.model_fields}
        writer.add(opened.rows[first:last].copy(), facts)
    del opened
    file.unlink()


# -- new clips ---------------------------------------------------------------------------------------------------------


def _add_clips(context: Context, writer: _Writer, pins: Sequence[PinnedInput]) -> int:
    """Add the poses of new clips; return the number of clips that cannot be compared.

    The log names the first of them.
    """
    left_out = 0
    for done, (pin, tree) in enumerate(context.documents(pins, "motion")):
        context.progress(done, len(pins), f"clip {done + 1} of {len(pins)}, {pin.name}")
        motion = MotionDocument.model_validate(tree)
        try:
            mapped = read_mapped(context, Rig.as_stored(RevisionRef.model_validate(motion.skeleton.model_dump())))
            body = MatchingBody.from_mapping(mapped.skeleton, mapped.mapping)
            clip = documents.clip_from_document(motion, body.skeleton)
            features = clip_features(Motion.of(clip), body, clip.frame_rate_hz)
        except MotionError as error:
            left_out += 1
            if left_out <= LEFT_OUT_NAMED:
                context.log(f"{pin.path} is left out: {error}")
            continue
        facts = {
            "items": pin.item, "revisions": pin.revision, "rows": len(features.rows), "joints": presence(features),
            "frames": clip.frame_count, "rates_hz": clip.frame_rate_hz,
        }  # fmt: skip
        writer.add(features.rows, facts)
    return left_out


@dataclass
class _Writer:
    """Writer of new shards, which are sent to the server as soon as they are full."""

    context: Context
    rows: int = 0
    _entries: list[IndexShard] = field(default_factory=list)
    _runs: list[Rows] = field(default_factory=list)
    _facts: list[Mapping[str, Any]] = field(default_factory=list)

    def add(self, rows: Rows, facts: Mapping[str, Any]) -> None:
        """Add the poses of a clip.

        `facts` contains one element for each list of `ShardClips`, by the name of the list.
        """
        self._runs.append(rows)
        self._facts.append(facts)
        self.rows += len(rows)
        if sum(map(len, self._runs)) >= FULL_SHARD_ROWS:
            self._write()

    def finish(self) -> list[IndexShard]:
        """Write the last shard, and return all shards."""
        if self._runs:
            self._write()
        return self._entries

    def _write(self) -> None:
        names = ShardClips.model_fields
        clips = ShardClips.model_validate({name: [facts[name] for facts in self._facts] for name in names})
        listed, poses = self.context.scratch / "clips", self.context.scratch / "poses"
        listed.write_text(clips.model_dump_json(), "utf-8")
        write_shard(poses, self._runs)
        self._entries.append(
            IndexShard(clips=self._sent(listed), poses=self._sent(poses), rows=int(sum(clips.rows)))
        )  # fmt: skip
        self._runs, self._facts = [], []

    def _sent(self, file: Path) -> StoredFile:
        size_bytes = file.stat().st_size
        stored = StoredFile(blob=self.context.put_file(file), size_bytes=size_bytes)
        file.unlink()
        return stored
