"""Resources that create annotations and change them by commands."""

from __future__ import annotations

from functools import partial

from marey_schemas.editing.annotation_commands import AnnotationChange, AnnotationImport
from marey_schemas.items import Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_server.errors import ConflictProblem, NotFoundProblem, PreconditionFailedProblem
from marey_server.handlers.items import MAX_DOCUMENT_BYTES, kind_of
from marey_server.http.declarations import Access, RequestBody, writes
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.motions import annotating
from marey_server.store import items
from marey_server.store.items.annotating import AnnotatedClip

MOST_TRIES = 5
"""Greatest number of times that commands with `If-Match: *` are applied while other requests change the annotation."""


class AnnotationCommands(Resource):
    """Commands on an annotation."""

    path = "/projects/{project}/{kind}/{item}/commands"
    tag = "Annotations"

    @writes(
        access=Access.CONTRIBUTOR,
        body=AnnotationChange,
        answer=Item,
        precondition="required",
        etag=True,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, kind: str, item: str, body: AnnotationChange) -> Rendered:
        """Apply commands to an annotation (kind `annotations`); together they create one new revision.

        Each command is applied to the result of the previous one. If a command cannot be applied, the annotation does
        not change, and the answer is 422 with a pointer to this command.
        """
        if kind_of(kind) is not Kind.ANNOTATION:
            raise NotFoundProblem(
                f"These commands can be applied only to annotations, not to an item of the kind {kind}.",
                code="no-commands",
            )
        expected_rev = self.precondition.expected_rev
        for _ in range(MOST_TRIES):
            found = await self.look_up(items.find_annotation, project, item)
            changed = await self.compute(annotating.apply_commands, found, body, expected_rev=expected_rev)
            try:
                return await self.answer(items.put_changed, project, item, changed, body.message)
            except PreconditionFailedProblem:
                if expected_rev is not None:
                    raise
        raise ConflictProblem(
            "Other requests changed this annotation at the same time; try again.", code="changed-meanwhile"
        )


class ClipAnnotations(Resource):
    """Annotations of a clip."""

    path = "/projects/{project}/{kind}/{item}/annotations"
    tag = "Annotations"

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(AnnotationImport, max_bytes=MAX_DOCUMENT_BYTES),
        answer=Item,
        status=201,
        etag=True,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, kind: str, item: str, body: AnnotationImport) -> Rendered:
        """Create an annotation of a clip from a document or a file in the format of Marey's predecessor.

        The path parameter `kind` must be `clips`. The annotation is created in the clip's folder.
        """
        if kind_of(kind) is not Kind.CLIP:
            raise NotFoundProblem(f"Only clips can be annotated, not items of the kind {kind}.", code="no-annotations")
        clip = await self.look_up(items.find_annotated_clip, project, item)
        prepared = await self._prepared(clip, body)
        return await self.answer_with(
            lambda made: Reply(made, rev=made.rev, location=f"/projects/{project}/annotations/{made.id}"),
            items.create_item,
            project,
            Kind.ANNOTATION,
            prepared,
        )

    async def _prepared(self, clip: AnnotatedClip, body: AnnotationImport) -> ItemCreate:
        """Return the annotation to create; the bytes of a file are read in a child process."""
        if body.file is None:
            return await self.compute(annotating.prepare_annotation, clip, body)
        content = await self.look_up(annotating.find_file, body, MAX_DOCUMENT_BYTES)
        self.holding.grow(len(content))
        order = partial(annotating.annotation_order, clip, body, content)
        parts = await self.compute_apart(annotating.READ_ANNOTATION, order, annotating.found_annotation)
        return annotating.created(clip, body, parts)


RESOURCES: tuple[type[Resource], ...] = (AnnotationCommands, ClipAnnotations)
