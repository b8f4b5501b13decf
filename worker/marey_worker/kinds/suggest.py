"""Kind `suggest`: suggests clips to remove from an evaluated set, and candidates that fill its gaps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import ceil
from typing import Any

import numpy as np

from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.defects import Defects, compare_defects
from marey_motion.evaluation.improvement.selection import source_of
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
from marey_worker.job_io.candidates import Candidates, read_candidates
from marey_worker.job_io.chosen_metric import read_metric
from marey_worker.job_io.evaluated_set import EvaluatedSet, read_evaluated_set, store_document, store_file
from marey_worker.job_io.matching_clips import refusing_motion_errors, split_uid, uid_of
from marey_worker.job_io.stored_reports import inputs_of

ROUNDING_FRAMES = 1e-6
"""Difference in frames that is only due to rounding."""


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
    found = replace(found, defects=_defects(context, evaluated, candidates, found))
    context.publish_facets(facets_of(found))
    document = {**suggestions_to_tree(found), "unusable": [one._asdict() for one in candidates.unusable]}
    result = {**_counts(found), "unusable": len(candidates.unusable), "document": store_document(context, document)}
    if params.report:
        (pin,) = context.inputs["evaluation"]
        poses = poses_by_clip((evaluated.clips.database, *candidates.databases.values()), shown_sources(found))
        page = render_suggestions(found, poses, title=pin.path, inputs=inputs_of(context))
        result["report"] = store_file(context, page.encode())
    return result


def _defects(
    context: Context, evaluated: EvaluatedSet, candidates: Candidates, found: Suggestions
) -> dict[str, Defects]:
    """Measure the clips that would fill gaps, and the clips of the set beside them; return the defects by uid."""
    if not found.fillings:
        return {}
    suggested = {one.source for one in found.fillings}
    pins = [pin for pin in context.inputs["candidates"] if uid_of(pin) in suggested]
    measures = _ClipMeasures(context, evaluated, candidates)
    of_set = [values for _, values in measures.values_of(evaluated.clip_set.clips) if not isinstance(values, str)]
    return {
        uid_of(pin): Defects({}, problem=values) if isinstance(values, str) else compare_defects(values, of_set)
        for pin, values in measures.values_of(pins)
    }


class _ClipMeasures:
    """Measurement of the quality of clips, in the frames that their matching databases use.

    So a rest pose at the end of a clip, and frames outside a trim, are not measured. Clips that have the skeleton of
    the evaluated set have its joint mapping.
    """

    def __init__(self, context: Context, evaluated: EvaluatedSet, candidates: Candidates) -> None:
        database, rig = evaluated.clips.database, evaluated.clip_set.rig
        self._context = context
        self._rate_hz = database.options.rate_hz
        self._options = QualityOptions(rate_hz=min(QUALITY_RATE_HZ, self._rate_hz))
        self._used = {source_of(clip): clip for one in (database, *candidates.databases.values()) for clip in one.clips}
        self._bodies = QualityBodies(context, () if rig is None else (rig,))

    def values_of(self, pins: Sequence[PinnedInput]) -> Iterator[tuple[PinnedInput, Mapping[str, float | None] | str]]:
        """Yield each clip with the values of its measures, or with the reason why it cannot be measured."""
        for done, (pin, tree) in enumerate(self._context.documents(pins, "motion")):
            self._context.progress(0, None, f"measuring clip {done + 1} of {len(pins)}, {pin.name}")
            try:
                clip, body = self._bodies.posed(MotionDocument.model_validate(tree))
                yield pin, measure_quality(self._used_frames(clip, uid_of(pin)), body, self._options).values
            except MotionError as error:
                yield pin, self._reason(error, tree["frame_rate_hz"])

    def _reason(self, error: MotionError, frame_rate_hz: float) -> str:
        if error.code != "frame-rate-too-low":
            return str(error)
        # The error advises to choose another rate for the measures, and this job has no such parameter.
        return f"it has {frame_rate_hz:g} frames per second, fewer than the {self._options.rate_hz:g} that are measured"

    def _used_frames(self, clip: Clip, uid: str) -> Clip:
        used = self._used[uid]
        first = round(used.first_s * clip.frame_rate_hz)
        steps = (used.frame_count - 1) * clip.frame_rate_hz / self._rate_hz
        return clip.sliced(first, min(first + ceil(steps - ROUNDING_FRAMES) + 1, clip.frame_count))


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
        "removals": found.harmless_steps,
        "near_duplicates": len(found.duplicates.pairs),
        "blendable_share": found.similarity.share,
        "fillings": len(found.fillings),
        "needing_retarget": sum(one.needs_retarget for one in found.fillings),
        "coverage_index": found.result.coverage.index,
        "coverage_index_filled": found.additions[-1].coverage_index if found.additions else found.result.coverage.index,
        **({} if known is None else {"metric": known.model_dump(mode="json")}),
    }
