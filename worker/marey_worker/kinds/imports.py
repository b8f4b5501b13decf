"""Kind `import`: imports stored files as skeletons, clips, annotations, aligned clips, models, graphs and records."""

from __future__ import annotations

from typing import Any

from marey_motion.errors import MotionError
from marey_motion.importing.files import import_file, mapping_part, planned_entry, refusal_of
from marey_motion.importing.graphs import FEW, NamedModel, graph_item
from marey_motion.importing.items import FileToImport, GivenSkeleton, ImportedFile, ImportedItem
from marey_motion.importing.plan import PlannedFile, plan_imports, reading_order
from marey_motion.importing.siblings import AxisFinding, axes_of_skeletons, axis_of_siblings
from marey_schemas.documents.clips import Check
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.imports import ImportEntry, Refusal, refused_entry
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions, UpAxis
from marey_schemas.queue.job_params import ImportParams
from marey_schemas.queue.worker_protocol import StagedOutput
from marey_worker.context import Context, FileTooLarge, JobRefused, NoSuchThing
from marey_worker.job_io.staged_results import StagedResults


def run(context: Context, params: ImportParams) -> dict[str, Any]:
    """Import every file of the job; the result has an entry for each file. A faulty file does not affect the others.

    Raises `JobRefused` if the skeleton that the parameters name does not exist.
    """
    return _Importing(context, params).run()


class _Importing:
    """State of a job of the kind `import`."""

    def __init__(self, context: Context, params: ImportParams) -> None:
        self._context = context
        self._params = params
        self._options = ImportOptions.model_validate(params.model_dump(exclude={"files"}, exclude_unset=True))
        self._digests = {file.name: file.blob for file in params.files}
        self._skeleton = self._read_skeleton()
        self._results = StagedResults(context)
        self._mappings: dict[bytes, Any] = {}
        """Parts `mapping` of the skeletons so far, by the canonical JSON of the skeleton's hierarchy."""
        self._models: list[tuple[str, str, NamedModel]] = []
        """Models that this job imports: collection, name, and the reference that a graph uses."""

    def run(self) -> dict[str, Any]:
        """Import all files in order, and return the result of the job."""
        plan = plan_imports([file.name for file in self._params.files])
        findings: list[AxisFinding | None] = [None] * len(plan)
        made: list[ImportEntry | None] = [None] * len(plan)
        for done, place in enumerate(reading_order(plan)):
            planned = plan[place]
            self._context.progress(done, len(plan), f"importing {planned.name}")
            made[place] = planned_entry(planned)
            if made[place] is None:
                made[place], findings[place] = self._import(planned)
        axes = axes_of_skeletons(findings)
        entries = []
        for planned, entry, finding in zip(plan, made, findings, strict=True):
            # What was put aside is read again, because later files may have shown its upward axis, or be its models.
            final = entry or self._import(planned, axis_of_siblings(finding, axes), is_last=True)[0]
            assert final is not None
            if final.error is not None:
                self._context.log(f"{planned.name}: {final.error.detail} ({final.error.code})")
            entries.append(final)
        self._results.flush()
        imported = [entry for entry in entries if entry.status == "created"]
        return {
            "entries": [entry.model_dump(mode="json", exclude_none=True) for entry in entries],
            "clips": sum(entry.frames is not None for entry in imported),
            "frames": sum(entry.frames or 0 for entry in imported),
        }

    def _import(
        self, planned: PlannedFile, sibling_axis: UpAxis | None = None, *, is_last: bool = False
    ) -> tuple[ImportEntry | None, AxisFinding | None]:
        """Import a file; return its entry in the result, and the upward axis that the motion shows.

        If the motion does not clearly show the axis, or if the file is a graph without its models, the entry is None
        and nothing is staged: the file must be read again after all others. With `is_last`, it is imported in any case.
        """
        try:
            found = self._read(planned, sibling_axis)
            if found.axis is not None and not found.axis.is_clear and not is_last:
                return None, found.axis
            if found.graph is not None and not found.items and not is_last:
                return None, None
            items = found.items if found.graph is None else (*found.items, self._graph_item(found))
        except NoSuchThing as error:
            return refused_entry(planned.name, Refusal(code="blob-missing", detail=str(error))), None
        except FileTooLarge as error:
            return refused_entry(planned.name, Refusal(code=error.code, detail=str(error))), None
        except MotionError as error:
            return refused_entry(planned.name, refusal_of(error)), None
        if found.refusal is not None:
            return refused_entry(planned.name, found.refusal), found.axis
        for item in items:
            self._stage(item)
        checks = tuple(map(Check.model_validate, found.checks))
        return ImportEntry(name=planned.name, status="created", frames=found.frames, warnings=checks), found.axis

    def _read(self, planned: PlannedFile, sibling_axis: UpAxis | None) -> ImportedFile:
        digest = self._digests[planned.name]
        beside = None if planned.companion is None else self._digests[planned.companion]
        notes = None if planned.notes is None else self._digests[planned.notes]
        return import_file(
            FileToImport(
                planned,
                self._context.blob(digest),
                digest,
                self._options,
                companion=None if beside is None else self._context.blob(beside),
                companion_digest=beside,
                skeleton=self._skeleton,
                sibling_axis=sibling_axis,
                notes=None if notes is None else self._context.blob(notes),
                notes_digest=notes,
            )
        )

    def _read_skeleton(self) -> GivenSkeleton | None:
        if self._options.skeleton is None:
            return None
        try:
            item = self._context.item(Kind.SKELETON, self._options.skeleton)
        except NoSuchThing as error:
            raise JobRefused("no-skeleton", f"the project has no skeleton {self._options.skeleton}") from error
        hierarchy = self._context.document(Kind.SKELETON, item.id, item.revision, "hierarchy")
        return GivenSkeleton(item.id, item.revision, hierarchy)

    def _graph_item(self, found: ImportedFile) -> ImportedItem:
        """Return the item of the graph in a file; its models may be in the project, in this file, or in earlier files.

        Raises `MotionError` if a model is missing or ambiguous.
        """
        assert found.graph is not None
        before = len(self._models)
        for item in found.items:
            self._note_model(item)
        try:
            return graph_item(found.graph, self._find_models)
        except MotionError:
            del self._models[before:]  # the file is refused
            raise

    def _find_models(self, name: str, collection: str | None) -> tuple[int, list[NamedModel]]:
        """Find models by name, among the models of the project and those that this job creates.

        Return the number of matches, and the first few models. If this job creates a new revision of a model, the new
        revision is returned.
        """
        stored = self._context.find_items(Kind.MODEL, name, collection)
        found = {one.path: NamedModel(one.path, {"item": one.id, "revision": one.revision}) for one in stored}
        for folder, called, model in self._models:
            if called == name and collection in (None, folder):
                found[model.path] = model
        return len(found), list(found.values())[:FEW]

    def _stage(self, item: ImportedItem) -> None:
        parts = dict(item.parts)
        if item.kind is Kind.SKELETON and "mapping" not in parts:
            content = canonical_json(parts["hierarchy"])
            if content not in self._mappings:
                self._mappings[content] = mapping_part(parts["hierarchy"])
            parts["mapping"] = self._mappings[content]
        self._results.add(
            StagedOutput(
                name=item.name,
                kind=item.kind,
                item_name=item.item_name,
                collection=item.collection,
                tags=tuple(item.tags),
                parts=parts,
                reuse=item.reuse,
                same_skeleton=item.same_skeleton,
            )
        )
        self._note_model(item)

    def _note_model(self, item: ImportedItem) -> None:
        """Remember a model, to which graphs of this job may refer."""
        if item.kind is Kind.MODEL:
            path = f"{item.collection}/{item.item_name}".lstrip("/")
            self._models.append((item.collection, item.item_name, NamedModel(path, {"output": item.name})))
