"""Documents of a project, requested by the content digests of revisions, which are the same on every server."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from marey_client.errors import UnexpectedAnswer
from marey_client.transport import BLOCKS, MAX_ANSWER_BYTES, as_json
from marey_schemas.datasets.contents import MOST_CONTENTS, ContentsRequest, PartOfContent
from marey_schemas.encoding.codecs import MSGPACK, decode_tree

if TYPE_CHECKING:
    from marey_client.transport import Transport


def request_contents(
    transport: Transport, project_url: str, request: ContentsRequest, *, keep_blocks: bool = False
) -> dict[str, Any]:
    """Request revisions and documents of a project by content digest, and return the server's answer as a dict.

    The lists `revisions` and `documents` in the answer have the order of the request. With `keep_blocks`, arrays stay
    compressed.
    """
    url = f"{project_url}/contents"
    response = transport.send("POST", url, content=as_json(request), headers={"Accept": BLOCKS})
    answer: dict[str, Any] = decode_tree(response.content, MSGPACK, max_bytes=MAX_ANSWER_BYTES, keep_blocks=keep_blocks)
    return answer


def read_facets(transport: Transport, project_url: str, contents: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the facets of at most `MOST_CONTENTS` revisions of a project; revisions without facets are left out."""
    found = request_contents(transport, project_url, ContentsRequest(revisions=tuple(contents)))
    named = zip(contents, found.get("facets", ()), strict=False)  # servers of earlier versions send none
    return {content: values for content, values in named if values}


def first_documents(
    transport: Transport, project_url: str, places: Sequence[PartOfContent], *, keep_blocks: bool = False
) -> list[Any]:
    """Request documents by address; return the first of them, as many as fit into one answer, but at least one.

    The result has the order of `places`, but may be shorter.

    Raises `UnexpectedAnswer` if one of the revisions is no longer in the project.
    """
    request = ContentsRequest(documents=tuple(places))
    found: list[Any] = request_contents(transport, project_url, request, keep_blocks=keep_blocks)["documents"]
    for place, tree in zip(places, found, strict=False):
        if not isinstance(tree, dict):
            raise UnexpectedAnswer(f"the project has no revision with the content {place.content} any more")
    if not found:
        raise UnexpectedAnswer("the server's answer has no documents")
    return found


def read_documents(transport: Transport, project_url: str, places: Sequence[PartOfContent]) -> Iterator[dict[str, Any]]:
    """Yield the documents at the given addresses, in order, with numpy arrays; memory holds one answer at a time."""
    waiting = list(places)
    while waiting:
        found = first_documents(transport, project_url, waiting[:MOST_CONTENTS])
        yield from found
        waiting = waiting[len(found) :]
