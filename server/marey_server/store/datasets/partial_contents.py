"""Arrays that documents describe by means of another array of the project, their base.

In received documents, these are partial arrays and array differences, from which the whole arrays are restored. In
documents that are read, arrays are replaced by array differences if the reader has the bases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

from sqlalchemy import func, select

from marey_schemas.datasets.contents import ReceivedRevision
from marey_schemas.documents.blob_references import members_of, pointer_to
from marey_schemas.encoding import blocks
from marey_schemas.encoding.array_differences import ArrayDifference
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


@dataclass(frozen=True)
class Base:
    """Array of the project from which other arrays are restored."""

    array: EncodedArray

    @cached_property
    def tiles(self) -> list[bytes]:
        """The tiles of the array, computed once, because many partial arrays can have the same base."""
        return blocks.split(self.array.data)


Bases = Mapping[BasePlace, Base]


def bases_named_in(received: Sequence[ReceivedRevision], take_bytes: Callable[[int], None]) -> set[BasePlace]:
    """Return the places of the bases that the partial arrays and array differences in received documents need.

    `take_bytes` is called with the total size of the restored arrays, before they take memory. Raises `InvalidProblem`
    if a partial array or a difference is malformed, or if the restored arrays together are too large.
    """
    found: set[BasePlace] = set()
    size_bytes = 0
    for one in received:
        for part, tree in one.parts.items():
            for _, value in members_of(tree):
                if (described := _described(value, part)) is not None:
                    found.add(described.place)
                    size_bytes += described.size_bytes
    _require_size(size_bytes)
    take_bytes(size_bytes)
    return found


def load_bases(
    tx: Transaction,
    places: set[BasePlace],
    stored: Mapping[str, Mapping[str, str]],
    take_bytes: Callable[[int], None],
) -> dict[BasePlace, Base]:
    """Load the bases of partial arrays and array differences from their places.

    `stored` maps content digests of revisions, then names of parts, to digests of documents. `take_bytes` is called
    with the total size of the needed documents before they are loaded.

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
    arrays = {
        (digest, pointer): Base(value)
        for digest, tree in trees.items()
        for pointer, value in members_of(tree)
        if isinstance(value, EncodedArray) and (digest, pointer) in named
    }
    found: dict[BasePlace, Base] = {}
    for place, digest in digests.items():
        base = None if digest is None else arrays.get((digest, place.pointer))
        if base is None:
            raise _bad_array(f"the revision {place.content} has no array at {place.pointer!r} of {place.part!r}")
        found[place] = base
    return found


def restored(value: Any, part: str, bases: Bases) -> Any:
    """Return `value`, the document of a part, with whole arrays in place of partial arrays and array differences."""
    if not bases:
        return value
    if (described := _described(value, part)) is not None:
        base = bases[described.place]
        try:
            if described.difference is not None:
                return described.difference.applied_to(base.array)
            return completed(value, base.tiles)
        except ArrayError as error:
            raise _bad_array(str(error)) from error
    if isinstance(value, dict):
        return {key: restored(member, part, bases) for key, member in value.items()}
    return [restored(member, part, bases) for member in value] if isinstance(value, list) else value


class _Described(NamedTuple):
    """Array of a received document that is described by means of a base."""

    place: BasePlace
    size_bytes: int
    """Size of the whole array in bytes."""
    difference: ArrayDifference | None
    """Difference between the array and its base; None for a partial array."""


def _described(value: Any, part: str) -> _Described | None:
    """Return the base and the size of the array that `value`, a partial array or an array difference, describes.

    Returns None for other values of a document. Raises `InvalidProblem` if `value` is malformed.
    """
    try:
        difference = ArrayDifference.of(value)
        if difference is None and not is_partial(value):
            return None
        place = BasePlace(value["base"], part, value["pointer"])
        size_bytes = ArraySpec.parse(value["dtype"], value["shape"]).nbytes
    except ArrayError as error:
        raise _bad_array(str(error)) from error
    if not all(isinstance(one, str) for one in place):
        raise _bad_array("the members `base` and `pointer` of a partial array must be strings")
    return _Described(place, size_bytes, difference)


@dataclass
class DocumentComparison:
    """Comparison of the documents of one answer with the documents that the reader has."""

    left_bytes: int
    """Bytes of the arrays that may still be compared. Further arrays are sent whole, to limit the time."""

    def compared(self, value: Any, before: Any, references: Mapping[str, Mapping[str, Any]], content: str) -> Any:
        """Return the document `value` with array differences in place of arrays that are similar to those in `before`.

        `before` is a document that the reader has, and `content` the content digest of its revision. `references` are
        the references to the arrays of `value`, by JSON Pointer.
        """
        bases = {at: one for at, one in members_of(before) if isinstance(one, EncodedArray)}

        def visit(pointer: str, one: Any) -> Any:
            if isinstance(one, EncodedArray):
                base = bases.get(pointer)
                if base is None:
                    return one
                return self._difference(one, base, content, pointer, references[pointer]["content"])
            if isinstance(one, dict):
                return {key: visit(pointer_to(pointer, key), member) for key, member in one.items()}
            if isinstance(one, list):
                return [visit(f"{pointer}/{index}", member) for index, member in enumerate(one)]
            return one

        return visit("", value)

    def _difference(self, array: EncodedArray, base: EncodedArray, content: str, pointer: str, digest: str) -> Any:
        self.left_bytes -= ArraySpec(array.dtype, array.shape).nbytes
        found = None
        if self.left_bytes >= 0:
            found = ArrayDifference.between(array, base, content, pointer, digest)
        return array if found is None else found.document


def _require_size(size_bytes: int) -> None:
    if size_bytes > MAX_ARRAY_BYTES:
        raise _bad_array(
            f"the arrays that a request describes by a base may have at most {MAX_ARRAY_BYTES // MIB} MiB in total, "
            "and their bases may have as much; split the request"
        )


def _bad_array(detail: str) -> InvalidProblem:
    return InvalidProblem(f"A partial array cannot be restored: {detail}.", code="bad-array")
