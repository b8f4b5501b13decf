"""Kind `suggest`: suggests clips to remove from an evaluated set, and candidates that fill its gaps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.defects import Defects, compare_defects
from marey_motion.evaluation.improvement.suggest import Suggestions, suggest
from marey_motion.evaluation.improvement.suggestion_documents import suggestions_to_tree
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.display import posed_rows
from marey_motion.quality.measuring import measure_quality
from marey_reports.drawing.strips import even_frames
from marey_reports.evaluation.suggestions import render_suggestions, shown_sources
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.options.quality import QUALITY_RATE_HZ, QualityOptions
from marey_schemas.queue.facets import ItemFacets
from marey_schemas.queue.job_params import SuggestParams
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_worker.context import Context
from marey_worker.job_io.bodies import QualityBodies
from marey_worker.job_io.candidates import read_candidates
from marey_worker.job_io.chosen_metric import read_metric
from marey_worker.job_io.evaluated_set import EvaluatedSet, read_evaluated_set, store_document, store_file
from marey_worker.job_io.matching_clips import ClipSet, refusing_motion_errors, split_uid, uid_of
from marey_worker.job_io.stored_reports import inputs_of


def run(context: Context, params: SuggestParams) -> dict[str, Any]:
    """Compute suggestions for the evaluated set; the result counts them, and refers to their document and report."""
    evaluated = read_evaluated_set(context)
    candidates = read_candidates(context, evaluated)
    with refusing_motion_errors():
        found = suggest(
            evaluated.clips.database,
            evaluated.result,
            collections=candidates.databases,
            options=params,
            metric=read_metric(context, params.metric),
            threads=context.threads,
            progress=context.progress,
        )
    found = replace(found, defects=_defects(context, evaluated, found))
    context.publish_facets(facets_of(found))
    document = {**suggestions_to_tree(found), "unusable": [one._asdict() for one in candidates.unusable]}
    result = {**_counts(found), "unusable": len(candidates.unusable), "document": store_document(context, document)}
    if params.report:
        (pin,) = context.inputs["evaluation"]
        poses = poses_by_clip((evaluated.clips.database, *candidates.databases.values()), shown_sources(found))
        page = render_suggestions(found, poses, title=pin.path, inputs=inputs_of(context))
        result["report"] = store_file(context, page.encode())
    return result


def _defects(context: Context, evaluated: EvaluatedSet, found: Suggestions) -> dict[str, Defects]:
    """Measure the clips that would fill gaps, and the clips of the set beside them; return the defects by uid."""
    if not found.fillings:
        return {}
    clip_set, suggested = evaluated.clip_set, {one.source for one in found.fillings}
    pins = [pin for pin in context.inputs["candidates"] if uid_of(pin) in suggested]
    rate_hz = min(QUALITY_RATE_HZ, evaluated.clips.database.options.rate_hz)
    measures = _ClipMeasures(context, QualityOptions(rate_hz=rate_hz), clip_set)
    of_set = [values for _, values in measures.values_of(clip_set.clips) if not isinstance(values, str)]
    return {
        uid_of(pin): Defects({}, problem=values) if isinstance(values, str) else compare_defects(values, of_set)
        for pin, values in measures.values_of(pins)
    }


class _ClipMeasures:
    """Measurement of the quality of clips; those of the evaluated set have its joint mapping and its trims."""

    def __init__(self, context: Context, options: QualityOptions, clip_set: ClipSet) -> None:
        self._context = context
        self._options = options
        self._trims = {uid_of(pin): clip_set.trims.get(pin.item) for pin in clip_set.clips}
        self._bodies = QualityBodies(context, () if clip_set.rig is None else (clip_set.rig,))

    def values_of(self, pins: Sequence[PinnedInput]) -> Iterator[tuple[PinnedInput, Mapping[str, float | None] | str]]:
        """Yield each clip with the values of its measures, or with the reason why it cannot be measured."""
        for done, (pin, tree) in enumerate(self._context.documents(pins, "motion")):
            self._context.progress(0, None, f"measuring clip {done + 1} of {len(pins)}, {pin.name}")
            try:
                clip, body = self._bodies.posed(MotionDocument.model_validate(tree))
                trim = self._trims.get(uid_of(pin))
                yield pin, measure_quality(clip.sliced(*trim) if trim else clip, body, self._options).values
            except MotionError as error:
                yield pin, str(error)


def poses_by_clip(databases: Iterable[MatchingDatabase], sources: set[str]) -> dict[str, tuple[Clip, ...]]:
    """Return poses at even intervals of the clips with the uids `sources`, by uid."""
    return {
        clip.uid: tuple(posed_rows(database, np.array([clip.start + frame])) for frame in even_frames(clip.frame_count))
        for database in databases
        for clip in database.clips
        if clip.uid in sources
    }


def facets_of(found: Suggestions) -> list[ItemFacets]:
    """Return how much the removal of a clip would harm the set, as a facet (published number) of the clip.

    Only clips for which this harm was computed have the facet.
    """
    harms = {removal.source: removal.harm for removal in found.redundant}
    harms |= {clip.source: 0.0 for clip in found.unused.clips}
    clips = ((*split_uid(source), harm) for source, harm in sorted(harms.items()))
    return [ItemFacets(item=item, revision=revision, values={"removal_harm": harm}) for item, revision, harm in clips]


def _counts(found: Suggestions) -> dict[str, Any]:
    known = found.similarity.metric
    return {
        "unused_clips": len(found.unused.clips),
        "unused_s": found.unused.seconds,
        "removals": len(found.plan),
        "near_duplicates": len(found.duplicates.pairs),
        "blendable_share": found.similarity.share,
        "fillings": len(found.fillings),
        "needing_retarget": sum(one.needs_retarget for one in found.fillings),
        "coverage_index": found.result.coverage.index,
        "coverage_index_filled": found.additions[-1].coverage_index if found.additions else found.result.coverage.index,
        **({} if known is None else {"metric": known.model_dump(mode="json")}),
    }
