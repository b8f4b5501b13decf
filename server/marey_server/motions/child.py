"""Child process of the server that reads untrusted files and computes.

It carries out one order after another, each within limits of memory and time. An order is a message that names a
function and its argument.

Messages between server and child are MessagePack that the receiver validates; nothing is pickled.

The first arguments of the command are the pipe's file descriptor, and the memory in bytes that orders may use. Then
follows `FORK_SERVER` if the process forks children that carry out the orders, or `SINGLE` if it carries them out
itself. The other arguments name what to load at the start: a module, or `module:function` with a function to call. The
parent kills a child if an order takes too long, or if the client that waits for its result has closed the connection.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from functools import partial
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any, Self

import msgpack
from pydantic import BaseModel, ConfigDict

from marey_schemas.encoding.codecs import MSGPACK, ArrayForm, CodecError, decode_tree, encode_tree
from marey_schemas.problems import FieldError
from marey_schemas.processes.child_process import READY, BadMessage, connect_to_parent
from marey_schemas.processes.forking import fork_children
from marey_schemas.processes.limits import OUT_OF_MEMORY, allow_memory, allow_processor_time
from marey_schemas.processes.memory import keep_freed_memory, loading_modules
from marey_server.errors import ApiProblem, TooLargeProblem

FORK_SERVER, SINGLE = "fork-server", "single"
"""Values of the third argument: `FORK_SERVER` forks children for the orders, `SINGLE` carries out the orders itself."""


class Message(BaseModel):
    """Base of messages between processes, whose named fields are packed as MessagePack."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    def pack(self) -> bytes:
        """Return the message as bytes."""
        packed: bytes = msgpack.packb(self.model_dump(by_alias=True))
        return packed

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Return the message that the bytes contain.

        Raises `BadMessage` if they contain no valid message of this class.
        """
        try:
            fields: Any = msgpack.unpackb(data)
            return cls.model_validate(fields)
        except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
            raise BadMessage(
                f"{len(data)} bytes from another process cannot be read as a {cls.__name__}: {error}"
            ) from error


class AnswerEncoding(Message):
    """Media type of a document that a child computes for a client, and the form of its arrays."""

    media_type: str
    arrays: ArrayForm

    def encode(self, tree: Any) -> bytes:
        """Return a document as bytes of the media type that the client has requested."""
        return encode_tree(tree, self.media_type, arrays=self.arrays)


class ComputedFile(Message):
    """File that a child writes for a client: its name, media type, and content."""

    name: str
    media_type: str
    data: bytes


def pack_tree(tree: Any) -> bytes:
    """Return a document as bytes for a message; arrays that are encoded already are copied as they are."""
    return encode_tree(tree, MSGPACK, arrays="blocks")


def unpack_tree(packed: bytes) -> Any:
    """Decode a document that `pack_tree` has encoded, with its arrays.

    Raises `TooLargeProblem` if the document is too large.
    """
    try:
        return decode_tree(packed, MSGPACK)
    except CodecError as error:
        raise TooLargeProblem(
            f"A document is too large for an immediate answer: {error}; submit a job instead."
        ) from error


class ChildOrder(Message):
    """Message that asks a child process to call `function`, written `module:function`, with `payload`.

    The function returns bytes. It may use `processor_s` seconds of processor time.
    """

    function: str
    payload: bytes
    processor_s: float


class ChildRefusal(Message):
    """Message about an `ApiProblem` that the called function raised: its status, code, text and field errors."""

    status: int
    code: str
    detail: str
    errors: tuple[FieldError, ...] = ()


class ChildAnswer(Message):
    """Answer to a `ChildOrder`: `payload` is the result of the function.

    If there is no result, `refusal`, `out_of_memory` or `traceback` gives the reason.
    """

    payload: bytes = b""
    refusal: ChildRefusal | None = None
    out_of_memory: bool = False
    traceback: str = ""


def main() -> None:
    """Load modules; then carry out orders from the pipe until it closes, or fork children that carry out orders."""
    pipe = connect_to_parent()
    memory_bytes, forks, loaded_first = int(sys.argv[2]), sys.argv[3] == FORK_SERVER, sys.argv[4:]
    keep_freed_memory()
    with loading_modules():
        for name in loaded_first:
            _load(name)
    try:
        pipe.send_bytes(READY)
    except BrokenPipeError:  # the server ended while this loaded
        return
    if forks:
        fork_children(pipe, partial(carry_out_orders, memory_bytes=memory_bytes))
    else:
        carry_out_orders(pipe, memory_bytes=memory_bytes)


def carry_out_orders(pipe: Connection, *, memory_bytes: int) -> None:
    """For each received `ChildOrder`, call the function and send the result or the error, until the pipe closes.

    The functions may use `memory_bytes` more than this process uses now. If even a message needs more, this process
    ends with the status `OUT_OF_MEMORY`.
    """
    allow_memory(memory_bytes)
    try:
        while True:
            order = ChildOrder.unpack(pipe.recv_bytes())
            allow_processor_time(order.processor_s)
            pipe.send_bytes(run(order))
    except EOFError:
        return
    except MemoryError:
        os._exit(OUT_OF_MEMORY)


def run(order: ChildOrder) -> bytes:
    """Call the function of a `ChildOrder`, and return the packed answer."""
    try:
        return _answer(order).pack()
    except MemoryError:
        return ChildAnswer(out_of_memory=True).pack()


def _answer(order: ChildOrder) -> ChildAnswer:
    try:
        return ChildAnswer(payload=_function(order.function)(order.payload))
    except MemoryError:
        raise
    except ApiProblem as error:
        refusal = ChildRefusal(status=error.status, code=error.error_code, detail=error.detail, errors=error.errors)
        return ChildAnswer(refusal=refusal)
    except Exception as error:  # noqa: BLE001 - whatever a file causes ends its order, not the process
        return ChildAnswer(traceback="".join(traceback.format_exception(error)))


def _load(name: str) -> None:
    """Import `name`, which is a module or `module:function`; in the second case, call the function."""
    module, _, function = name.partition(":")
    loaded = import_module(module)
    if function:
        getattr(loaded, function)()


def _function(name: str) -> Callable[..., bytes]:
    module, _, function = name.partition(":")
    found: Callable[..., bytes] = getattr(import_module(module), function)
    return found


if __name__ == "__main__":
    main()
