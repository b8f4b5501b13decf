"""Motion files that the server has already become skeletons and clips."""

from __future__ import annotations

from typing import Any

from marey_motion.documents import skeleton_from_document
from marey_motion.errors import MotionError
from marey_motion.importing import files
from marey_motion.importing.files import FileDigests, ImportedDocuments, ImportRequest, ModelledDocuments
from marey_motion.importing.plan import PlannedFile, plan_imports
from marey_schemas.documents.clips import Check
from marey_schemas.documents.references import OutputRef
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.imports import ImportEntry, Refusal, skeleton_output
from marey_schemas.job_params import ImportParams
from marey_schemas.kinds import Kind
from marey_schemas.worker_protocol import StagedOutput
from marey_worker.context import Context, JobRefused, NoSuchThing
from marey_worker.job_io.staged_results import StagedResults

SKELETON_COLLECTION = "skeletons"


def run(context: Context, params: ImportParams) -> dict[str, Any]:
    """Import every file of the job. One entry per file; a bad one keeps no other from going in."""
    return _Importing(context, params).run()


class _Importing:
    """One job."""

    def __init__(self, context: Context, params: ImportParams) -> None:
        self._context = context
        self._params = params
        self._digests = {file.name: file.blob for file in params.files}
        self._request = self._read_request()
        self._results = StagedResults(context)

    def run(self) -> dict[str, Any]:
        """All files; what became of them, in the order given."""
        plan = plan_imports([file.name for file in self._params.files])
        entries = []
        for done, planned in enumerate(plan):
            self._context.progress(done, len(plan), f"importing {planned.name}")
            entries.append(self._entry(planned))
        self._results.flush()
        imported = [entry for entry in entries if entry.status == "created"]
        return {
            "entries": [entry.model_dump(mode="json", exclude_none=True) for entry in entries],
            "clips": sum(entry.frames is not None for entry in imported),
            "frames": sum(entry.frames or 0 for entry in imported),
        }

    def _entry(self, planned: PlannedFile) -> ImportEntry:
        if planned.role == "companion":
            return ImportEntry(name=planned.name, status="companion")
        if planned.role == "refused":
            return self._refused(planned, Refusal(code=planned.code, detail=planned.reason))
        try:
            found = self._read(planned)
        except MotionError as error:
            place = {name: value for name in ("line", "joint") if (value := getattr(error, name, None)) is not None}
            return self._refused(planned, Refusal(code=error.code, detail=str(error), **place))
        except NoSuchThing as error:
            return self._refused(planned, Refusal(code="blob-missing", detail=str(error)))
        if found.modelled is not None and found.modelled.graph is not None:
            detail = "a graph names models of the project; import it after them, in a request with few files"
            return self._refused(planned, Refusal(code="graph-alone", detail=detail))
        self._stage(planned, found)
        return ImportEntry(
            name=planned.name,
            status="created",
            frames=None if found.motion is None else len(found.motion["poses"]),
            warnings=tuple(Check.model_validate(check) for check in found.checks),
        )

    def _refused(self, planned: PlannedFile, refusal: Refusal) -> ImportEntry:
        self._context.log(f"{planned.name}: {refusal.detail} ({refusal.code})")
        return ImportEntry(name=planned.name, status="failed", error=refusal)

    def _read(self, planned: PlannedFile) -> ImportedDocuments:
        digest = self._digests[planned.name]
        if planned.companion is None:
            return files.import_file(planned, self._context.blob(digest), FileDigests(digest), self._request)
        beside = self._digests[planned.companion]
        digests = FileDigests(digest, beside, planned.companion)
        data, companion = self._context.blob(digest), self._context.blob(beside)
        return files.import_file(planned, data, digests, self._request, companion)

    def _read_request(self) -> ImportRequest:
        """The options in the words of the readers, with the skeleton the clips must use."""
        params = self._params
        options = files.import_options(params.model_dump())
        if params.skeleton is None:
            return ImportRequest(options, params.subject, params.licence, params.capture_system)
        try:
            item = self._context.item(Kind.SKELETON, params.skeleton)
        except NoSuchThing as error:
            raise JobRefused("no-skeleton", f"there is no skeleton {params.skeleton}") from error
        hierarchy = self._context.document(Kind.SKELETON, item.id, item.revision, "hierarchy")
        skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
        ref = {"item": item.id, "revision": item.revision}
        return ImportRequest(options, params.subject, params.licence, params.capture_system, skeleton, ref)

    # -- results --

    def _stage(self, planned: PlannedFile, found: ImportedDocuments) -> None:
        """The clip under the file's name, its skeleton beside it; an equal skeleton of the project is used instead."""
        skeleton_name = skeleton_output(planned.name)
        if found.hierarchy is not None and found.mapping is not None:
            self._results.add(
                StagedOutput(
                    name=skeleton_name,
                    kind=Kind.SKELETON,
                    item_name=found.skeleton_name,
                    collection=SKELETON_COLLECTION,
                    parts={"hierarchy": found.hierarchy, "mapping": found.mapping},
                    reuse="by_content",
                )
            )
        if found.motion is not None and found.info is not None:
            motion = found.motion
            if found.hierarchy is not None:
                motion = {**motion, "skeleton": OutputRef(output=skeleton_name).model_dump()}
            self._results.add(
                StagedOutput(
                    name=planned.name,
                    kind=Kind.CLIP,
                    item_name=planned.item_name,
                    collection="/".join(part for part in (self._params.collection, planned.folder) if part),
                    tags=self._params.tags,
                    parts={"motion": motion, "info": found.info},
                )
            )
        if found.modelled is not None:
            self._stage_model(planned, found, found.modelled)

    def _stage_model(self, planned: PlannedFile, found: ImportedDocuments, modelled: ModelledDocuments) -> None:
        """The model under its name, with its tree."""
        parts = dict(modelled.parts)
        if found.hierarchy is not None:
            parts["model"] = parts["model"] | {"skeleton": OutputRef(output=skeleton_output(planned.name)).model_dump()}
        self._results.add(
            StagedOutput(
                name=planned.name,
                kind=Kind.MODEL,
                item_name=modelled.name,
                collection="/".join(part for part in (self._params.collection, planned.folder) if part),
                tags=self._params.tags,
                parts=parts,
            )
        )
