"""Resource that imports motion files, sent with the request or named by the digest of a blob."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from marey_schemas.imports import ImportAnswer, ImportEntry, ImportRequest
from marey_schemas.options.imports import ImportOptions, UpAxis
from marey_schemas.queue.jobs import Job, JobCreate
from marey_schemas.sizes import KIB, MIB
from marey_server.errors import ApiProblem, BadRequestProblem, InvalidProblem, NotFoundProblem, TooLargeProblem
from marey_server.field_errors import field_errors
from marey_server.handlers.uploads import store_in_pieces
from marey_server.http.declarations import Access, Files, RequestBody, writes
from marey_server.http.multipart import FORM, MultipartReader, PartHead, Piece, boundary_of
from marey_server.http.negotiation import body_type
from marey_server.http.receiving import BATCH_BYTES, Receiver
from marey_server.http.reply import Reply
from marey_server.http.resource import Resource
from marey_server.http.validation import decode_body, validate_body
from marey_server.motions import importing
from marey_server.motions.importing import PreparedImport, SourceFile, WaitingFiles
from marey_server.store import blobs, projects
from marey_server.store.blob_backings import SPOOLED_BYTES, Spool
from marey_server.store.jobs import submission
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:
    from marey_motion.importing.items import GivenSkeleton
    from marey_motion.importing.plan import PlannedFile

Work = tuple[int, Callable[[], Awaitable[PreparedImport]]]
"""Place of a file in the import, and the function that reads the file."""

MAX_FILES = 1000
MAX_UPLOAD_BYTES = 2048 * MIB
MAX_FORM_BYTES = 256 * KIB
MAX_LIST_BYTES = MIB
"""Greatest size of a list of files that are named by their digests."""
FILES_AHEAD = 2
"""Greatest number of files that are read in advance, while the file before them is still being read."""
FILES_PER_WRITE = 16
"""Greatest number of files that are stored in one transaction."""


class ProjectImports(Resource):
    """Import of motion files into a project."""

    path = "/projects/{project}/imports"
    tag = "Imports"

    async def begin(self, **_path: str) -> None:
        """Check the media type of the body before the files are received."""
        content_type = self.request.headers.get("Content-Type", "")
        self.fields: dict[str, bytearray] = {}
        self.files: list[SourceFile] = []
        self.parts: MultipartReader | None = None
        if content_type.lower().startswith("multipart/"):
            self.parts = MultipartReader(boundary_of(content_type), max_parts=MAX_FILES + 32)
            settings = self.services.settings
            spooled_bytes = min(settings.import_files_now * SPOOLED_BYTES, settings.import_bytes_now)
            self.hold_body(BATCH_BYTES + MAX_FORM_BYTES + spooled_bytes)
        else:
            body_type(content_type, others=(FORM,))
            self.hold_body(MAX_LIST_BYTES)
        self.body = bytearray()
        self._file: tuple[str, Receiver] | None = None
        self._field: bytearray | None = None

    async def receive(self, chunk: bytes) -> None:
        """Receive the next bytes of the files."""
        if self.parts is None:
            self.body += chunk
            if len(self.body) > MAX_LIST_BYTES:
                raise TooLargeProblem(f"The JSON list of files to import may have at most {MAX_LIST_BYTES} bytes.")
            return
        for piece in self.parts.feed(chunk):
            await self._take(piece)

    async def _take(self, piece: Piece) -> None:
        if isinstance(piece, PartHead):
            if piece.file_name is None:
                self._field = self.fields.setdefault(piece.field, bytearray())
            else:
                self._file = (piece.file_name, Receiver(self.services))
        elif isinstance(piece, bytes) and self._file is not None:
            await self._file[1].write(piece)
        elif isinstance(piece, bytes) and self._field is not None:
            self._field += piece
            if sum(map(len, self.fields.values())) > MAX_FORM_BYTES:
                raise TooLargeProblem(f"The form fields may have at most {MAX_FORM_BYTES} bytes in total.")
        elif self._file is not None:
            await self._take_file(*self._file)
            self._file = None
        else:
            self._field = None

    async def _take_file(self, name: str, receiver: Receiver) -> None:
        """Keep a received file in memory, or store it as a blob if the request is too large for an immediate import."""
        spool = await receiver.finish()
        file = SourceFile(name, spool.digest, spool.size_bytes, spool)
        if self._is_large([*self.files, file]):
            with spool:
                await self._keep(spool)
            file = SourceFile(name, file.digest, file.size_bytes, None)
        self.files.append(file)

    async def _keep(self, spool: Spool) -> None:
        """Store a file as a blob that the caller may use in the project of the import."""
        await store_in_pieces(self, spool)
        await self.change(_keep, self.path_kwargs["project"], spool)

    def _is_large(self, files: Sequence[SourceFile]) -> bool:
        settings = self.services.settings
        size = sum(file.size_bytes for file in files)
        return len(files) > settings.import_files_now or size > settings.import_bytes_now

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(
            Files, max_bytes=MAX_UPLOAD_BYTES, alternative=ImportRequest, fields=ImportOptions, streamed=True
        ),
        answer=ImportAnswer,
        also=((202, Job),),
        headers=("X-Request-Id",),
        in_folders=True,
    )
    async def post(self, project: str) -> Reply:
        """Import motion files; the answer has one entry for each file. A faulty file does not affect the others.

        Send files as multipart/form-data, with the options as form fields, or name files by digest. If the project
        already has the content of a file, importing the file changes nothing. Many files, or many bytes, are imported
        by a job (202), whose result has the same fields as this answer.
        """
        if self.parts is not None:
            self.parts.finish()
            options = _form_options(self.fields)
        else:
            request = await self._read_request()
            options = ImportOptions.model_validate(request.model_dump(exclude={"files"}, exclude_unset=True))
            self.files = await self.look_up(_stored_files, request)
        if not self.files:
            raise BadRequestProblem("The request contains no files; send at least one.", code="no-files")
        await self.look_up(importing.require_folder, project, options.collection)
        if self._is_large(self.files):
            return await self._submit(project, options)
        async with self.using_children():
            return Reply(ImportAnswer(entries=tuple(await self._import_now(project, options))))

    async def _read_request(self) -> ImportRequest:
        return await self.compute(_decode, bytes(self.body), body_type(self.request.headers.get("Content-Type")))

    async def _submit(self, project: str, options: ImportOptions) -> Reply:
        for file in self.files:
            if isinstance(file.content, Spool):
                with file.content as spool:
                    await self._keep(spool)
        files = [{"name": file.name, "blob": file.digest} for file in self.files]
        params = {**options.model_dump(mode="json", exclude_unset=True), "files": files}
        (job,) = await self.change(submission.submit, project, [JobCreate(kind="import", params=params)])
        return Reply(job, status=202, location=f"/jobs/{job.id}", headers={"Retry-After": "1"})

    async def _import_now(self, project: str, options: ImportOptions) -> list[ImportEntry]:
        """Import all files; return one entry for each file, in order."""
        skeleton = None
        if options.skeleton is not None:
            skeleton = await self.look_up(importing.read_skeleton, project, options.skeleton)
        plans, order = await self.compute(importing.plan, [file.name for file in self.files])
        by_name = {file.name: file for file in reversed(self.files)}
        prepare = partial(self._prepare, by_name, options, skeleton)
        waiting = WaitingFiles()
        entries = await self._import_all(
            project, ((place, partial(prepare, plans[place], None)) for place in order), waiting
        )
        entries |= await self._import_all(
            project,
            (
                (place, partial(_ready, file) if axis is None else partial(prepare, plans[place], axis))
                for place, file, axis in waiting.files()
            ),
            None,
        )
        for entry in entries.values():
            self.services.metrics.imports.labels(entry.status).inc()
        return [entries[place] for place in range(len(plans))]

    async def _import_all(
        self, project: str, works: Iterable[Work], waiting: WaitingFiles | None
    ) -> dict[int, ImportEntry]:
        """Read files in child processes while earlier files are stored; return the entries by place in the import.

        Files that wait for other files are recorded in `waiting`, if it is given, and not stored.
        """
        entries: dict[int, ImportEntry] = {}
        reading = deque(works)
        ahead: deque[tuple[int, asyncio.Task[PreparedImport]]] = deque()
        storing: asyncio.Task[dict[int, ImportEntry]] | None = None
        try:
            while reading or ahead:
                ready: dict[int, PreparedImport] = {}
                while (reading or ahead) and len(ready) < FILES_PER_WRITE:
                    while reading and len(ahead) <= FILES_AHEAD:
                        place, work = reading.popleft()
                        ahead.append((place, asyncio.ensure_future(work())))
                    place, task = ahead[0]
                    file = await task
                    ahead.popleft()
                    if waiting is None or not waiting.take(place, file):
                        ready[place] = file
                if storing is not None:
                    entries |= await storing
                storing = asyncio.ensure_future(self._store(project, ready))
            if storing is not None:
                entries |= await storing
        finally:
            await _give_up(one for one in (*(task for _, task in ahead), storing) if one is not None)
        return entries

    async def _store(self, project: str, ready: dict[int, PreparedImport]) -> dict[int, ImportEntry]:
        files = list(ready.values())
        new = await self.look_up(importing.new_skeletons, project, files)
        for digest, first in importing.firsts_of_skeletons(files, new).items():
            make = partial(importing.mapping_order, first)
            try:
                mapping = await self.compute_in_child(importing.FIND_MAPPING, make, importing.found_mapping)
                files = importing.add_mapping(files, digest, mapping)
            except ApiProblem as error:
                files = importing.refuse_with_skeleton(files, digest, error)
        return dict(zip(ready, await self.change(importing.publish, project, files), strict=True))

    async def _prepare(
        self,
        by_name: dict[str, SourceFile],
        options: ImportOptions,
        skeleton: GivenSkeleton | None,
        planned: PlannedFile,
        sibling_axis: UpAxis | None,
    ) -> PreparedImport:
        if (entry := importing.planned_entry(planned)) is not None:
            return entry
        sources = [await self._with_bytes(by_name[name]) for name in planned.together]
        try:
            return await self.compute_in_child(
                importing.READ_FILE,
                partial(importing.file_order, planned, sources, options, skeleton, sibling_axis),
                partial(importing.prepared_import, planned.name, sources),
            )
        except ApiProblem as error:
            return importing.refused_import(planned.name, error)

    async def _with_bytes(self, file: SourceFile) -> SourceFile:
        if file.content is not None:
            return file
        data = await self.look_up(blobs.read_blob, file.digest, 0, file.size_bytes)  # allowed when it was looked up
        if len(data) != file.size_bytes:
            raise NotFoundProblem(f"The blob {file.digest} is no longer stored; send it again.")
        return SourceFile(file.name, file.digest, file.size_bytes, data)

    def on_finish(self) -> None:
        """Discard the received files."""
        super().on_finish()
        for file in getattr(self, "files", ()):
            if isinstance(file.content, Spool):
                file.content.close()


async def _ready(file: PreparedImport) -> PreparedImport:
    """Return `file`, which was read before; called in place of a coroutine that reads a file."""
    return file


async def _give_up(tasks: Iterable[asyncio.Task[Any]]) -> None:
    """Cancel tasks that have not ended, and wait until all tasks have ended."""
    left = list(tasks)
    for task in left:
        task.cancel()
    await asyncio.gather(*left, return_exceptions=True)


def _decode(data: bytes, media_type: str) -> ImportRequest:
    return validate_body(ImportRequest, decode_body(data, media_type, max_array_bytes=0))


def _keep(tx: Transaction, project: str, spool: Spool) -> None:
    blobs.put_blob(tx, spool, project_id=projects.require(tx, project).id)


def _form_options(form: dict[str, bytearray]) -> ImportOptions:
    """Return the options that the form fields contain. Raises `InvalidProblem`, which names the first invalid field."""
    try:
        values: dict[str, Any] = {name: value.decode() for name, value in form.items()}
    except UnicodeDecodeError:
        raise BadRequestProblem("The text of form fields must be encoded as UTF-8.", code="bad-multipart") from None
    if "tags" in values:
        values["tags"] = [tag for tag in values["tags"].split(",") if tag]
    try:
        return ImportOptions.model_validate(values)
    except ValidationError as error:
        faults = field_errors(error, ImportOptions, values)
        first = f"{faults[0].pointer or 'the form'}: {faults[0].detail}"
        raise InvalidProblem(f"The form is not valid: {first}", code="invalid-form", errors=faults) from None


def _stored_files(tx: Transaction, request: ImportRequest) -> list[SourceFile]:
    """Return the files that the request names by digest. Raises `NotFoundProblem` if the caller may not read a file."""
    sizes = blobs.sizes_of_readable(tx, [file.blob for file in request.files])
    return [SourceFile(file.name, file.blob, sizes[file.blob], None) for file in request.files]


RESOURCES: tuple[type[Resource], ...] = (ProjectImports,)
