"""Requests for documents of a project by content digest; equal content has the same digest on every server."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from marey_client.errors import UnexpectedAnswer
from marey_client.transport import BLOCKS, as_json
from marey_schemas.datasets.contents import MOST_CONTENTS, ContentsRequest, PartOfContent, RequestedDocument
from marey_schemas.encoding.arrays import EncodedArray
from marey_schemas.encoding.codecs import MSGPACK, decode_tree
from marey_schemas.encoding.partial_arrays import partial_array

if TYPE_CHECKING:
    from marey_client.transport import Transport

K = TypeVar("K")


def request_contents(
    transport: Transport, project_url: str, request: ContentsRequest, *, keep_blocks: bool = False
) -> dict[str, Any]:
    """Request revisions and documents of a project by content digest, and return the server's answer as a dict.

    The lists in the answer, `revisions`, `documents` and `tiles`, have the order of the request. With `keep_blocks`,
    arrays stay compressed.
    """
    url = f"{project_url}/contents"
    response = transport.send_compressed("POST", url, content=as_json(request), headers={"Accept": BLOCKS})
    answer: dict[str, Any] = decode_tree(response.content, MSGPACK, keep_blocks=keep_blocks)
    return answer


def read_facets(transport: Transport, project_url: str, contents: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the facets (published numbers) of revisions, by content digest; revisions without facets are left out.

    `contents` are the content digests of at most `MOST_CONTENTS` revisions of the project.
    """
    found = request_contents(transport, project_url, ContentsRequest(revisions=tuple(contents)))
    named = zip(contents, found.get("facets", ()), strict=False)  # servers of earlier versions send none
    return {content: values for content, values in named if values}


def first_documents(
    transport: Transport, project_url: str, places: Sequence[RequestedDocument], *, keep_blocks: bool = False
) -> list[Any]:
    """Request the documents at the addresses `places`; return those that fit into one answer, at least one.

    The result contains the first documents, in the order of `places`. Raises `UnexpectedAnswer` if one of the revisions
    is no longer in the project.
    """
    request = ContentsRequest(documents=tuple(places))
    found: list[Any] = request_contents(transport, project_url, request, keep_blocks=keep_blocks)["documents"]
    for place, tree in zip(places, found, strict=False):
        if not isinstance(tree, dict):
            raise UnexpectedAnswer(f"the project no longer has the revision with the content digest {place.content}")
    if not found:
        raise UnexpectedAnswer(
            "the server's answer contains none of the requested documents; update the older of client and server"
        )
    return found


def read_documents(
    transport: Transport, project_url: str, places: Sequence[RequestedDocument]
) -> Iterator[dict[str, Any]]:
    """Yield the documents at the addresses `places`, in order, with numpy arrays.

    Only the documents of one answer of the server are in memory at a time.
    """
    waiting = list(places)
    while waiting:
        found = first_documents(transport, project_url, waiting[:MOST_CONTENTS])
        yield from found
        waiting = waiting[len(found) :]


@dataclass(frozen=True)
class ArrayBases:
    """Document that the receiving project has, with the tiles of its arrays: these tiles need not be sent to it."""

    content: str
    """Content digest of the revision that contains the document."""
    tiles: Mapping[str, Sequence[str]]
    """Digests of the tiles of each array of the document, by the JSON Pointer of the array."""

    def without_shared(self, pointer: str, array: EncodedArray) -> EncodedArray | dict[str, Any]:
        """Return `array` without the tiles that it shares with the array of this document at the same pointer.

        Returns the whole array if the two arrays share no tile.
        """
        return partial_array(array, self.content, pointer, self.tiles.get(pointer, ())) or array


def bases_of_arrays(transport: Transport, project_url: str, places: Mapping[K, PartOfContent]) -> dict[K, ArrayBases]:
    """Request the tiles of the arrays of documents; documents that the project does not have are left out.

    `places` are the addresses of the documents. One answer of the server covers at least one document; the documents
    that do not fit are requested again. Raises `UnexpectedAnswer` if an answer covers no document.
    """
    found: dict[K, ArrayBases] = {}
    waiting = list(places.items())
    while waiting:
        some = waiting[:MOST_CONTENTS]
        request = ContentsRequest(tiles=tuple(place for _, place in some))
        tiles = request_contents(transport, project_url, request)["tiles"]
        for (key, place), of_document in zip(some, tiles, strict=False):
            if of_document:
                found[key] = ArrayBases(place.content, of_document)
        if not tiles:
            raise UnexpectedAnswer(
                "the server's answer contains no requested tile; update the older of client and server"
            )
        waiting = waiting[len(tiles) :]
    return found
