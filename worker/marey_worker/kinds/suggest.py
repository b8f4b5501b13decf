"""Kind `suggest`: suggests clips to remove from an evaluated set, and candidates that fill its gaps."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from marey_motion.clip import Clip
from marey_motion.evaluation.improvement.suggest import Suggestions, suggest
from marey_motion.evaluation.improvement.suggestion_documents import suggestions_to_tree
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.display import posed_rows
from marey_reports.drawing.strips import even_frames
from marey_reports.evaluation.suggestions import render_suggestions, shown_sources
from marey_schemas.queue.facets import ItemFacets
from marey_schemas.queue.job_params import SuggestParams
from marey_worker.context import Context
from marey_worker.job_io.candidates import read_candidates
from marey_worker.job_io.chosen_metric import read_metric
from marey_worker.job_io.evaluated_set import read_evaluated_set, store_document, store_file
from marey_worker.job_io.matching_clips import refusing_motion_errors, split_uid
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
    context.publish_facets(facets_of(found))
    document = {**suggestions_to_tree(found), "unusable": [one._asdict() for one in candidates.unusable]}
    result = {**_counts(found), "unusable": len(candidates.unusable), "document": store_document(context, document)}
    if params.report:
        (pin,) = context.inputs["evaluation"]
        poses = poses_by_clip((evaluated.clips.database, *candidates.databases.values()), shown_sources(found))
        page = render_suggestions(found, poses, title=pin.path, inputs=inputs_of(context))
        result["report"] = store_file(context, page.encode())
    return result


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
