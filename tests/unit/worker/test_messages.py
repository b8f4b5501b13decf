"""Messages between supervisor and child: bytes that are validated, and never pickled."""

import pickle
from pathlib import Path
from typing import Any

import msgpack
import pytest

from marey_schemas.items import PartPlace
from marey_schemas.jobs import Progress
from marey_schemas.kinds import Kind
from marey_schemas.processes.child_process import BadMessage
from marey_schemas.worker_protocol import PinnedInput
from marey_worker.messages import ChildReply, Done, Made, PutFile, ReadParts, ReadResults, Run, pack, unpack

PIN = PinnedInput(item="clip_1", revision=2, kind=Kind.CLIP, name="walk", collection="takes")
RUN = Run("job_1", "align", {"window": 3}, {"clips": (PIN,)}, 7, 1 << 29, Path("/tmp/log"), Path("/tmp/job"), 2)


@pytest.mark.parametrize(
    "message",
    [
        RUN,
        ReadParts(3, (PartPlace(kind=Kind.CLIP, item="clip_1", revision=2, part="motion"),)),
        ReadResults(4),
        PutFile(5, Path("/tmp/job/archive.zip")),
        Made(Progress(done=1, total=3, note="reading")),
        Done({"clips": 3, "of": [0.5, None, "walk"]}),
        ChildReply(6, [b"\x00document", None]),
        ChildReply(7, refusal="gone", missing=True),
    ],
    ids=lambda message: type(message).__name__,
)
def test_a_message_arrives_as_it_was_sent(message: Any) -> None:
    assert unpack(pack(message)) == message


class Hostile:
    """An object that would run a command while it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("/tmp/unpickled"),))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        pickle.dumps(Hostile()),
        msgpack.packb(["Nothing", {}]),
        msgpack.packb(["Done", {"result": "no object"}]),
        msgpack.packb(["ReadBlob", {"request": "first", "digest": 3}]),
        msgpack.packb([["Done"], {}]),
        msgpack.packb({"Done": {}}),
        b"\x91" * 5000 + b"\xc0",
    ],
)
def test_other_bytes_are_no_message(data: bytes) -> None:
    with pytest.raises(BadMessage, match="no message"):
        unpack(data)
