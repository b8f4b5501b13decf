"""Partial arrays in received documents: their bases are read from the project, and the whole arrays are restored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from sqlalchemy import func, select

from marey_schemas.datasets.contents import ReceivedRevision
from marey_schemas.documents.blob_references import members_of
from marey_schemas.encoding import blocks
from marey_schemas.encoding.arrays import MAX_ARRAY_BYTES, EncodedArray
from marey_schemas.encoding.arrayspec import ArrayError, ArraySpec
from marey_schemas.encoding.partial_arrays import completed, is_partial
from marey_schemas.sizes import MIB
from marey_server.errors import InvalidProblem
from marey_server.store import documents
from marey_server.store.tables import document
from marey_server.store.transaction import Transaction, in_lists


class BasePlace(NamedTuple):
    """Place of an array in the project: content digest of a revision, part, and JSON Pointer."""

    content: str
    part: str
    pointer: str


Bases = Mapping[BasePlace, Sequence[bytes]]
"""Tiles of the bases of partial arrays."""


def bases_named_in(received: Sequence[ReceivedRevision], take_bytes: Callable[[int], None]) -> set[BasePlace]:
    """Return the places of the bases of all partial arrays in received documents.

    `take_bytes` is called with the size of the whole arrays, before they take memory. Raises `InvalidProblem` if a
    partial array is malformed, or if the arrays together are too large.
    """
    found: set[BasePlace] = set()
    size_bytes = 0
    for place, partial in _partial_arrays(received):
        if not all(isinstance(one, str) for one in place):
            raise _bad_array("the members `base` and `pointer` of a partial array must be texts")
        try:
            size_bytes += ArraySpec.parse(partial["dtype"], partial["shape"]).nbytes
        except ArrayError as error:
            raise _bad_array(str(error)) from error
        found.add(place)
    _require_size(size_bytes)
    take_bytes(size_bytes)
    return found


def load_bases(
    tx: Transaction,
    places: set[BasePlace],
    stored: Mapping[str, Mapping[str, str]],
    take_bytes: Callable[[int], None],
) -> dict[BasePlace, list[bytes]]:
    """Load the tiles of the bases of partial arrays.

    `stored` maps content digests and parts to the digests of documents. `take_bytes` is called with the size of these
    documents before they are loaded.

    Raises `InvalidProblem` if a document has no array at a place, or if the bases together are too large.
    """
    digests = {place: stored[place.content].get(place.part) for place in places}
    wanted = sorted({digest for digest in digests.values() if digest is not None})
    total = select(func.coalesce(func.sum(document.c.size_bytes), 0))
    size_bytes = sum(tx.execute(total.where(document.c.digest.in_(some))).scalar_one() for some in in_lists(wanted))
    _require_size(size_bytes)
    take_bytes(size_bytes)
    trees = documents.load_documents(tx, wanted)
    named = {(digest, place.pointer) for place, digest in digests.items()}
    tiles = {
        (digest, pointer): blocks.split(value.data)
        for digest, tree in trees.items()
        for pointer, value in members_of(tree)
        if isinstance(value, EncodedArray) and (digest, pointer) in named
    }
    found: dict[BasePlace, list[bytes]] = {}
    for place, digest in digests.items():
        base = None if digest is None else tiles.get((digest, place.pointer))
        if base is None:
            raise _bad_array(f"the revision {place.content} has no array at {place.pointer!r} of {place.part!r}")
        found[place] = base
    return found


def restored(value: Any, part: str, bases: Bases) -> Any:
    """Return the document of a part with a whole array in place of each partial array."""
    if not bases:
        return value
    if is_partial(value):
        try:
            return completed(value, bases[_place(value, part)])
        except ArrayError as error:
            raise _bad_array(str(error)) from error
    if isinstance(value, dict):
        return {key: restored(member, part, bases) for key, member in value.items()}
    return [restored(member, part, bases) for member in value] if isinstance(value, list) else value


def _partial_arrays(received: Sequence[ReceivedRevision]) -> Iterator[tuple[BasePlace, Mapping[str, Any]]]:
    for one in received:
        for part, tree in one.parts.items():
            for _, value in members_of(tree):
                if is_partial(value):
                    yield _place(value, part), value


def _place(partial: Mapping[str, Any], part: str) -> BasePlace:
    return BasePlace(partial["base"], part, partial["pointer"])


def _require_size(size_bytes: int) -> None:
    if size_bytes > MAX_ARRAY_BYTES:
        most = MAX_ARRAY_BYTES // MIB
        raise _bad_array(f"the partial arrays of a request, and their bases, may have at most {most} MiB each in total")


def _bad_array(detail: str) -> InvalidProblem:
    return InvalidProblem(f"A partial array cannot be restored: {detail}.", code="bad-array")
