"""Purges of deleted items, in as many requests as they need."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from marey_client.transport import Transport
from marey_schemas.purges import PurgeAnswer, PurgeRequest


def purge_step_by_step(transport: Transport, project: str, request: PurgeRequest) -> Iterator[PurgeAnswer]:
    """Send as many requests as a purge needs, and yield each answer; each request continues after the last one."""
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


def combined(answers: Sequence[PurgeAnswer]) -> PurgeAnswer:
    """Combine one or several answers into one; an item that several previews contain is listed once."""
    return PurgeAnswer(
        preview=answers[0].preview,
        purged=tuple({one.item: one for answer in answers for one in answer.purged}.values()),
        refused=tuple({one.item: one for answer in answers for one in answer.refused}.values()),
        freed_bytes=sum(answer.freed_bytes for answer in answers),
    )
