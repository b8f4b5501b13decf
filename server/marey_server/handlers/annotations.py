"""Commands that change annotations."""

from __future__ import annotations

from marey_schemas.annotations import AnnotationChange
from marey_schemas.items import Item
from marey_schemas.kinds import Kind
from marey_server.errors import NotFound
from marey_server.handlers.declarations import Access, writes
from marey_server.handlers.items import kind_of
from marey_server.handlers.reply import Rendered
from marey_server.handlers.resource import Resource
from marey_server.store import items


class AnnotationCommands(Resource):
    """The commands that an annotation understands."""

    path = "/projects/{project}/{kind}/{item}/commands"
    tag = "Annotations"

    @writes(
        access=Access.CONTRIBUTOR,
        body=AnnotationChange,
        answer=Item,
        precondition="required",
        etag=True,
        idempotency="key",
    )
    async def post(self, project: str, kind: str, item: str, body: AnnotationChange) -> Rendered:
        """Change an annotation (kind `annotations`) by commands: all of them, as one new revision, or none.

        Each command changes what the one before it left. Where one cannot be carried out, the answer is 422 and points
        at it.
        """
        if kind_of(kind) is not Kind.ANNOTATION:
            raise NotFound(f"There are no commands for {kind}; only for annotations.", code="no-commands")
        expected_rev = self.precondition.expected_rev
        return await self.answer(items.apply_commands, project, item, body, expected_rev=expected_rev)


RESOURCES: tuple[type[Resource], ...] = (AnnotationCommands,)
