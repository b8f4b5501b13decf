"""Kind `quality`: measures defects of clips and their totals, and compares them with those of recorded clips."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.errors import AnnotationError
from marey_motion.quality.measuring import ClipQuality, measure_quality
from marey_motion.quality.totals import DrawnTotals, changes_from, total_over_clips
from marey_motion.version import code_version
from marey_reports.quality.page import draw_quality_figures, quality_csv, render_quality
from marey_schemas.documents.annotations import Annotation, SegmentDocument
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.quality import (
    CONTACT_LABELS,
    MAIN_MEASURE,
    MEASURES,
    MeasuredSet,
    QualityChange,
    QualityConditions,
    QualityDocument,
    QualityRow,
    QualityTotal,
    worst_clips_first,
)
from marey_schemas.documents.references import RevisionRef
from marey_schemas.options.quality import QualityOptions
from marey_schemas.queue.facets import MOST_MEASURED, ItemFacets
from marey_schemas.queue.job_params import QualityParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_schemas.wording import counted
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.bodies import QualityBodies
from marey_worker.job_io.evaluated_set import store_document, store_file
from marey_worker.job_io.refusals import UNUSABLE, Refusals, present
from marey_worker.job_io.stored_reports import inputs_of, stored_figure


def run(context: Context, params: QualityParams) -> dict[str, Any]:
    """Measure the clips and the reference, if it is given; the result has the totals, and refers to stored files.

    These files are the document, the table and the report. A clip that cannot be measured is listed as a refusal in the
    result. Raises `JobRefused` if none of the clips, or none of the given reference clips, can be measured.
    """
    _require_count(sum(len(context.inputs.get(name, ())) for name in ("clips", "reference")))
    measuring = _Measuring(context, params)
    measured = measuring.measure("clips")
    reference = measuring.measure("reference") if context.inputs.get("reference") else None
    document = _document(context, params, measured, reference, measuring.refusals)
    context.publish_facets(measuring.facets)
    return _result(context, params, document)


def _require_count(count: int) -> None:
    if count > MOST_MEASURED:
        raise JobRefused(
            "too-many-clips",
            f"{count:,} clips are given, and one job measures at most {MOST_MEASURED:,}; measure fewer",
        )


@dataclass
class _Found:
    """Measurements of several clips: one row for each, and the seconds of motion in bins of speed and of turn rate."""

    rows: list[QualityRow] = field(default_factory=list)
    speed_seconds: Any = 0.0
    turn_seconds: Any = 0.0

    def add(self, row: QualityRow, quality: ClipQuality) -> None:
        self.rows.append(row)
        self.speed_seconds = self.speed_seconds + quality.speed_seconds
        self.turn_seconds = self.turn_seconds + quality.turn_seconds


class _Measuring:
    """Measurement of the inputs of a job.

    Clips are read one by one, so that the memory does not depend on their number.
    """

    def __init__(self, context: Context, params: QualityParams) -> None:
        self.refusals = Refusals(context)
        self._facets: dict[str, ItemFacets] = {}
        self._context = context
        self._options = QualityOptions.of(params)
        self._bodies = QualityBodies(context, context.inputs.get("rigs", ()))
        self._contacts = _read_contacts(context)

    @property
    def facets(self) -> list[ItemFacets]:
        """The measured values of all clips, as facets (published numbers). The clips of the reference are included."""
        return list(self._facets.values())

    def measure(self, name: str) -> _Found:
        """Measure the clips of the input `name`. Raises `JobRefused` if none of them can be measured."""
        pins, found = self._context.inputs[name], _Found()
        for done, (pin, (motion, info)) in enumerate(self._context.documents_of_each(pins, "motion", "info")):
            self._context.progress(done, len(pins), f"measuring {pin.name}")
            try:
                found.add(*self._measured(pin, motion, info))
            except UNUSABLE as error:
                self.refusals.add(pin, error)
        if not found.rows:
            what = "" if name == "clips" else " of the reference"
            raise JobRefused(
                "nothing-measured", f"none of {counted(len(pins), 'clip')}{what} can be measured{self.refusals.first}"
            )
        return found

    def _measured(self, pin: PinnedInput, tree: Any, info: Mapping[str, Any] | None) -> tuple[QualityRow, ClipQuality]:
        motion = MotionDocument.model_validate(present(pin, tree))
        clip, body = self._bodies.posed(motion)
        quality = measure_quality(clip, body, self._options, self._contacts_of(pin, clip.frame_count))
        row = QualityRow(
            item=pin.item,
            revision=pin.revision,
            name=pin.path,
            take=_take_of(pin, info or {}),
            seconds=clip.duration_s,
            frames=quality.frames,
            frame_rate_hz=clip.frame_rate_hz,
            values=dict(quality.values),
            notes=body.notes,
        )
        known = {name: value for name, value in quality.values.items() if value is not None}
        self._facets[pin.item] = ItemFacets(item=pin.item, revision=pin.revision, values=known)
        return row, quality

    def _contacts_of(self, pin: PinnedInput, frames: int) -> NDArray[np.bool_] | None:
        """Return the annotated contacts of a clip, of shape (frames, 2) for the left and the right foot.

        Return None if the job has no annotations, so that contacts are detected. Raises `AnnotationError` if it has
        annotations, but none of them has a contact segment for this revision of the clip.
        """
        if self._contacts is None:
            return None
        segments = self._contacts.get((pin.item, pin.revision), ())
        if not segments:
            raise AnnotationError(
                f"no given annotation of revision {pin.revision} has a segment {' or '.join(CONTACT_LABELS)}; "
                "annotate the contacts, or measure the clip in a job without annotations",
                code="no-annotation",
            )
        labelled = np.zeros((frames, 2), dtype=np.bool_)
        for segment in segments:
            labelled[segment.start : segment.end] |= CONTACT_LABELS[segment.label]
        return labelled


def _read_contacts(context: Context) -> dict[tuple[str, int], list[SegmentDocument]] | None:
    """Return the annotated contacts by clip and revision, as segments; None if there is no input `contacts`."""
    pins = context.inputs.get("contacts", ())
    if not pins:
        return None
    found: dict[tuple[str, int], list[SegmentDocument]] = {}
    for _, tree in context.documents(pins, "annotation"):
        annotation = Annotation.model_validate(tree)
        clip = RevisionRef.model_validate(annotation.clip.model_dump())
        segments = [one for one in annotation.segments if one.label in CONTACT_LABELS]
        found.setdefault((clip.item, clip.revision), []).extend(segments)
    return found


def _take_of(pin: PinnedInput, info: Mapping[str, Any]) -> str:
    """Return a key that is equal for clips of one recording: performer and take, or else the item's id."""
    take = info.get("take")
    return pin.item if take is None else f"{info.get('subject') or ''}/{take}"


def _document(
    context: Context, params: QualityParams, measured: _Found, reference: _Found | None, refusals: Refusals
) -> QualityDocument:
    # The seeds of both sets differ, so that their draws are independent.
    own = _totals(measured, params.draws, context.seed)
    other = None if reference is None else _totals(reference, params.draws, context.seed + 1)
    changes = {} if other is None else changes_from(own, other)
    return QualityDocument(
        code_version=code_version(),
        conditions=QualityConditions(
            options=QualityOptions.of(params),
            contacts="annotated" if context.inputs.get("contacts") else "detected",
            draws=params.draws,
            seed=context.seed,
        ),
        units={name: measure.unit for name, measure in MEASURES.items()},
        measured=_set(measured, own),
        reference=None if reference is None or other is None else _set(reference, other),
        changes={name: QualityChange(value=value, low=low, high=high) for name, (value, low, high) in changes.items()},
        refused=tuple(refusals.entries),
    )


def _totals(found: _Found, draws: int, seed: int) -> DrawnTotals:
    return total_over_clips(
        {name: [row.values[name] for row in found.rows] for name in MEASURES},
        [row.seconds for row in found.rows],
        [row.take for row in found.rows],
        draws=draws,
        seed=seed,
    )


def _set(found: _Found, drawn: DrawnTotals) -> MeasuredSet:
    return MeasuredSet(
        clips=tuple(found.rows),
        totals={name: QualityTotal(**total._asdict()) for name, total in drawn.totals.items()},
        speed_seconds=tuple(np.asarray(found.speed_seconds).tolist()),
        turn_seconds=tuple(np.asarray(found.turn_seconds).tolist()),
    )


def _result(context: Context, params: QualityParams, document: QualityDocument) -> dict[str, Any]:
    reference, worst = document.reference, worst_clips_first(document.measured.clips)[0]
    result = {
        "clips": len(document.measured.clips),
        "reference_clips": 0 if reference is None else len(reference.clips),
        "conditions": document.conditions.model_dump(mode="json"),
        "totals": {name: total.value for name, total in document.measured.totals.items()},
        "reference": None if reference is None else {name: one.value for name, one in reference.totals.items()},
        "worst": {"name": worst.name, MAIN_MEASURE: worst.values[MAIN_MEASURE]},
        "refused": list(document.refused),
        "document": store_document(context, document.model_dump(mode="json", by_alias=True)),
        "table": store_file(context, quality_csv(document).encode()),
    }
    if params.report:
        context.progress(0, None, "writing the report")
        title = params.title or f"Quality of {counted(len(document.measured.clips), 'clip')}"
        figures = draw_quality_figures(document)
        page = render_quality(document, figures, title=title, inputs=inputs_of(context))
        result["report"] = store_file(context, page.encode())
        stored = [stored_figure(context, figure) for figure in figures.values()]
        result["figures"] = [figure.model_dump(mode="json", by_alias=True) for figure in stored]
    return result
