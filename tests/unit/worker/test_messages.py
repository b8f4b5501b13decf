"""Messages between supervisor and child: bytes that are validated, and never pickled."""

import pickle
from concurrent.futures import Future
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import msgpack
import pytest

from marey_schemas.items import Item, PartPlace
from marey_schemas.kinds import Kind
from marey_schemas.processes.child_process import BadMessage, ChildProcess
from marey_schemas.queue.jobs import Progress
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.attempt import send_reply
from marey_worker.messages import ChildReply, Done, ProgressMade, PutFile, ReadParts, ReadResults, Run, pack, unpack

PIN = PinnedInput(item="clip_1", revision=2, kind=Kind.CLIP, name="walk", collection="takes")
RUN = Run("job_1", "align", {"window": 3}, {"clips": (PIN,)}, 7, 1 << 29, Path("/tmp/log"), Path("/tmp/job"), 2)


@pytest.mark.parametrize(
    "message",
    [
        RUN,
        ReadParts(3, (PartPlace(kind=Kind.CLIP, item="clip_1", revision=2, part="motion"),)),
        ReadResults(4),
        PutFile(5, Path("/tmp/job/archive.zip")),
        ProgressMade(Progress(done=1, total=3, note="reading")),
        Done({"clips": 3, "of": [0.5, None, "walk"]}),
        ChildReply(6, [b"\x00document", None]),
        ChildReply(7, refusal="gone", missing=True),
    ],
    ids=lambda message: type(message).__name__,
)
def test_a_message_arrives_as_it_was_sent(message: Any) -> None:
    assert unpack(pack(message)) == message


def test_items_arrive_with_their_times() -> None:
    made = datetime(2026, 11, 23, 1, 19, 30, 402_000, tzinfo=UTC)
    item = Item(
        id="clip_1", kind=Kind.CLIP, name="walk", collection="takes", tags=("left",), revision=2, created_at=made,
        updated_at=made, rev=3,
    )  # fmt: skip
    (found,) = unpack(pack(ChildReply(8, [item]))).value
    assert Item.model_validate(found) == item


class Child:
    """Simulated child process that records the messages it receives."""

    def __init__(self) -> None:
        self.received: list[Any] = []

    def send(self, data: bytes) -> None:
        self.received.append(unpack(data))


def test_an_answer_that_cannot_be_passed_on_is_refused_so_that_the_child_goes_on() -> None:
    child, carried_out = Child(), Future[ChildReply | None]()
    carried_out.set_result(ChildReply(9, value=object()))
    send_reply(cast(ChildProcess, child), carried_out)
    assert [(one.request, one.refusal is not None) for one in child.received] == [(9, True)]


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
    with pytest.raises(BadMessage, match="cannot be read as a message"):
        unpack(data)
