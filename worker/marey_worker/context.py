"""Context of a job: the interface through which the functions of a job kind read inputs and store results."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_schemas.items import Item, PartPlace
from marey_schemas.kinds import Kind
from marey_schemas.queue.facets import ItemFacets
from marey_schemas.queue.jobs import LONGEST_NOTE, Progress
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput, StageRequest
from marey_schemas.studies.conducting import JudgingParticipant
from marey_worker.messages import (
    ChildReply,
    FindItems,
    ProgressMade,
    PutFile,
    ReadBlob,
    ReadItem,
    ReadJudgements,
    ReadParts,
    ReadResults,
    Request,
    Run,
    Stage,
    pack,
    unpack,
)
from marey_worker.texts import storable

T = TypeVar("T")

_numbers = itertools.count(1)
"""Request numbers, unique in the process, so that an answer that arrives after the end of its job is ignored."""

DOCUMENTS_PER_REQUEST = 16
REQUESTS_AHEAD = 2
STAGED_AT_ONCE = 2


class JobRefused(Exception):
    """Error of a job that cannot succeed, even if it is retried. `code` is a stable identifier of the reason."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code = code
        self.detail = detail


class RequestRefused(Exception):
    """Error of a request of the job that the supervisor could not carry out."""


class Unreadable(RequestRefused):
    """Error of an object that cannot be read, even if the job is retried.

    `code` is a stable identifier of the reason.
    """

    def __init__(self, detail: str, code: str) -> None:
        super().__init__(detail)
        self.code = code


class NoSuchThing(Unreadable):
    """Error of an object that does not exist, or that the job may not read.

    `code` names its kind, as in `no-skeleton`.
    """

    def __init__(self, detail: str, code: str = "not-found") -> None:
        super().__init__(detail, code)


class FileTooLarge(Unreadable):
    """Error of a stored file that is too large for the memory limit of the job."""

    def __init__(self, detail: str) -> None:
        super().__init__(
            f"{detail}: a job can read files of up to a quarter of its memory limit, and of up to 1 GiB; submit it "
            "with a greater memory_limit_mb, or split the file",
            "file-too-large",
        )


class Task(NamedTuple):
    """Position of a task among the tasks of its parent job, counted from 0, and the number of these tasks."""

    position: int
    size: int


class Context:
    """Running job: its inputs, and methods that read documents, report progress and stage results.

    All methods send requests to the supervisor. While the job computes, parts are read in advance and results are
    staged.

    `shareable` says whether identical jobs may share the result. It becomes false when an object cannot be read: the
    object may be restored, or an identical job may have a greater memory limit. The functions of a job kind set it to
    false if the result depends on anything else besides the kind, parameters, seed and inputs of the job.
    """

    shareable = True

    def __init__(self, run: Run, pipe: Connection) -> None:
        self.inputs: Mapping[str, tuple[PinnedInput, ...]] = run.inputs
        self.into = run.into
        self.seed = run.seed
        self.task = Task(0, 1) if run.position is None else Task(run.position, run.size or 1)
        self.threads = run.threads
        self.scratch: Path = run.scratch
        self._pipe = pipe
        self._replies: dict[int, ChildReply] = {}
        self._staging: deque[int] = deque()

    # -- reading --

    def document(self, kind: Kind, item: str, revision: int, part: str, *, required: bool = True) -> Any:
        """Return the document of a part of a revision, with its arrays as numpy arrays.

        If the part does not exist, return None if `required` is false; otherwise, raise `NoSuchThing`.
        """
        ((_, document),) = self._read_ahead([(None, PartPlace(kind=kind, item=item, revision=revision, part=part))])
        if document is None and required:
            detail = f"The {kind} {item!r} has no part {part!r} at revision {revision}."
            raise self._unreadable(NoSuchThing(detail, f"no-{kind}"))
        return document

    def documents(
        self, pins: Iterable[PinnedInput], part: str, *, required: bool = True
    ) -> Iterator[tuple[PinnedInput, Any]]:
        """Yield each input together with its part named `part`.

        If the part does not exist, yield None in place of the part if `required` is false; otherwise, raise
        `NoSuchThing`. While the caller uses one input, the parts of the next inputs are read.
        """
        for pin, (document,) in self.documents_of_each(pins, part):
            if document is None and required:
                detail = f"There is no part {part!r} of {pin.kind} {pin.item!r} at revision {pin.revision}."
                raise self._unreadable(NoSuchThing(detail, f"no-{pin.kind}"))
            yield pin, document

    def documents_of_each(
        self, pins: Iterable[PinnedInput], *parts: str
    ) -> Iterator[tuple[PinnedInput, tuple[Any, ...]]]:
        """Yield each input together with several of its parts, and with None for each part that does not exist.

        While the caller uses one input, the parts of the next inputs are read.
        """
        wanted = (
            (pin, PartPlace(kind=pin.kind, item=pin.item, revision=pin.revision, part=part))
            for pin in pins
            for part in parts
        )
        found = self._read_ahead(wanted)
        while documents := tuple(islice(found, len(parts))):
            yield documents[0][0], tuple(document for _, document in documents)

    def item(self, kind: Kind, item: str) -> Item:
        """Return an item at its newest revision. Raises `NoSuchThing` if it does not exist."""
        asked = self._send(lambda request: ReadItem(request, kind, item))
        return Item.model_validate(self._value(asked, f"no-{kind}"))

    def find_items(self, kind: Kind, name: str, collection: str | None) -> list[Item]:
        """Return the items with this name in one folder, or in the whole project if `collection` is None."""
        found = self._ask(lambda request: FindItems(request, kind, name, collection))
        return [Item.model_validate(item) for item in found]

    def judgements(self, study: PinnedInput) -> list[JudgingParticipant]:
        """Return the answers of the participants who saw a revision of a study; participants have pseudonyms.

        Raises `Unreadable` if the user who submitted the job may not read the answers.
        """
        asked = self._send(lambda request: ReadJudgements(request, study.item, study.revision))
        return [JudgingParticipant.model_validate(one) for one in self._value(asked, "no-study")]

    def task_results(self) -> list[dict[str, Any]]:
        """Return the results of the tasks that this job gathers, in order."""
        results: list[dict[str, Any]] = self._ask(ReadResults)
        return results

    def blob(self, digest: str) -> bytes:
        """Return the bytes of a blob.

        Raises `NoSuchThing` if the blob does not exist, and `FileTooLarge` if it does not fit into the memory of the
        job.
        """
        data: bytes = self._value(self._send(lambda request: ReadBlob(request, digest)), "no-blob")
        return data

    # -- writing --

    def stage(self, outputs: Sequence[StagedOutput]) -> None:
        """Stage results, all of which become visible together when the job completes.

        The method does not wait until the results are stored. Raises `RequestRefused` if earlier results could not be
        stored. The supervisor waits for the last results of a job while this process runs the next job.
        """
        self._stage(encode_outputs(outputs))

    def publish_facets(self, facets: Sequence[ItemFacets]) -> None:
        """Stage facets: named numbers about revisions of inputs, which are published when the job completes.

        They replace the facets of an earlier call. If an input is an evaluation, facets of its clips are allowed, too.
        Raises `RequestRefused` if earlier results could not be stored.
        """
        if facets:
            request = StageRequest(facets=tuple(facets))
            self._stage(encode_tree(request.model_dump(mode="json"), MSGPACK))

    def _stage(self, body: bytes) -> None:
        while len(self._staging) >= STAGED_AT_ONCE:
            self._value(self._staging.popleft())
        self._staging.append(self._send(lambda request: Stage(request, body)))

    def put_file(self, path: Path) -> str:
        """Send a file to the server; return its digest, with which a result can refer to the file."""
        digest: str = self._ask(lambda request: PutFile(request, path))
        return digest

    def progress(self, done: float, total: float | None = None, note: str = "") -> None:
        """Report that `done` of `total` units of work are finished, for example clips; may be called often.

        `total` is greater than 0, or None if it is unknown; then users see no percentage. `note` names the current
        step; a note of more than 500 characters is shortened.
        """
        self._pipe.send_bytes(pack(ProgressMade(Progress(done=done, total=total, note=storable(note, LONGEST_NOTE)))))

    def log(self, text: str) -> None:
        """Write a line to the job's log, as `print` does."""
        print(text, flush=True)  # noqa: T201 - the log is this process's output

    # -- the pipe --

    def _read_ahead(self, wanted: Iterable[tuple[T, PartPlace]]) -> Iterator[tuple[T, Any]]:
        """Yield each object with the document of its part, or with None if the document does not exist.

        Several requests are sent before the first answer arrives.
        """
        rest = iter(wanted)
        waiting: deque[tuple[int, list[tuple[T, PartPlace]]]] = deque()
        while True:
            while len(waiting) < REQUESTS_AHEAD and (batch := list(islice(rest, DOCUMENTS_PER_REQUEST))):
                waiting.append((self._request_parts(batch), batch))
            if not waiting:
                return
            request, batch = waiting.popleft()
            answered: list[bytes | None] = self._value(request)
            if left_out := batch[len(answered) :]:
                waiting.appendleft((self._request_parts(left_out), left_out))
            for (thing, _), data in zip(batch, answered, strict=False):
                yield thing, None if data is None else _decoded(data)

    def _request_parts(self, wanted: Sequence[tuple[Any, PartPlace]]) -> int:
        places = tuple(place for _, place in wanted)
        return self._send(lambda request: ReadParts(request, places))

    def _ask(self, make: Callable[[int], Request]) -> Any:
        return self._value(self._send(make))

    def _send(self, make: Callable[[int], Request]) -> int:
        request = next(_numbers)
        self._pipe.send_bytes(pack(make(request)))
        return request

    def _value(self, request: int, missing: str = "not-found") -> Any:
        """Wait for the answer to the request with this number, and return its value.

        Raises `NoSuchThing` with the code `missing` if the requested object does not exist. Raises `FileTooLarge` if
        the object is too large for the job. Raises `RequestRefused` if the request failed for another reason.
        """
        while request not in self._replies:
            reply: ChildReply = unpack(self._pipe.recv_bytes())
            self._replies[reply.request] = reply
        reply = self._replies.pop(request)
        if reply.refusal is not None:
            if reply.too_large:
                raise self._unreadable(FileTooLarge(reply.refusal))
            if reply.missing:
                raise self._unreadable(NoSuchThing(reply.refusal, missing))
            raise RequestRefused(reply.refusal)
        return reply.value

    def _unreadable(self, error: Unreadable) -> Unreadable:
        """Mark the result as not shareable, because an object cannot be read; return `error`, to be raised."""
        self.shareable = False
        return error


def encode_outputs(outputs: Sequence[StagedOutput]) -> bytes:
    """Encode a `StageRequest` with the outputs as MessagePack; arrays that are already encoded are copied unchanged."""
    request = StageRequest(outputs=tuple(outputs))
    fields = request.model_dump(by_alias=True, exclude={"outputs": {"__all__": {"parts"}}})["outputs"]
    whole = [{**each, "parts": output.parts} for each, output in zip(fields, outputs, strict=True)]
    return encode_tree({"outputs": whole}, MSGPACK, arrays="blocks")


def _decoded(data: bytes) -> Any:
    return decode_tree(data, MSGPACK)
