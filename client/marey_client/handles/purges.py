"""Purges of deleted items; one purge may need several requests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from marey_client.transport import Transport
from marey_schemas.purges import PurgeAnswer, PurgeRequest


def purge_step_by_step(transport: Transport, project: str, request: PurgeRequest) -> Iterator[PurgeAnswer]:
    """Send the requests of a purge until all of its items have been examined, and yield each answer."""
    wanted = request
    while True:
        answer = transport.post(PurgeAnswer, f"/projects/{project}/purges", wanted)
        yield answer
        if answer.next is None:
            return
        wanted = request.model_copy(update={"after": answer.next})


def purge_items(transport: Transport, project: str, request: PurgeRequest) -> PurgeAnswer:
    """Purge all items that a request selects, and return what was done with each of them."""
    return combined(list(purge_step_by_step(transport, project, request)))


def without_contained(previews: Sequence[PurgeAnswer]) -> list[int]:
    """Return the indices, in ascending order, of previews that together contain the items of all previews.

    Previews whose items all occur in larger previews are left out; otherwise the same bytes would be counted twice, and
    the purge of the same items would be requested twice.
    """
    items = [{one.item for one in each.purged} | {one.item for one in each.refused} for each in previews]
    kept: list[int] = []
    found: set[str] = set()
    for place in sorted(range(len(items)), key=lambda one: len(items[one]), reverse=True):
        if not items[place] <= found:
            kept.append(place)
            found |= items[place]
    return sorted(kept)


def combined(answers: Sequence[PurgeAnswer]) -> PurgeAnswer:
    """Combine the answers of a purge into one answer.

    An item that occurs in several answers is listed once, but its bytes are counted once per answer. Previews do not
    count bytes that items of different answers share, so the purge may free more bytes than the previews state.
    """
    return PurgeAnswer(
        preview=answers[0].preview,
        purged=tuple({one.item: one for answer in answers for one in answer.purged}.values()),
        refused=tuple({one.item: one for answer in answers for one in answer.refused}.values()),
        freed_bytes=sum(answer.freed_bytes for answer in answers),
    )
