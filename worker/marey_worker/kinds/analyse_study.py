"""Kind `analyse_study`: analyses the judgements of a study, and fits metrics to them.

The results contain differences of motions and numbers of participants, and nothing about single participants.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from marey_motion import documents
from marey_motion.errors import MotionError
from marey_motion.matching.body import MatchingBody
from marey_motion.perception.comparing import MOST_TABLE_CELLS, measure_clip
from marey_motion.perception.fitting import PairDifferences
from marey_motion.perception.judging import Judgements, judgements_of
from marey_motion.perception.measuring import MeasuredClip
from marey_motion.perception.study_analysis import (
    StudyAnalysis,
    analyse_study,
    analysis_to_tree,
    measure_pairs,
    metric_to_tree,
)
from marey_reports.perception.study_page import render_study_report
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.metrics import METRIC_RATE_HZ
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.studies import StudyDocument
from marey_schemas.items import LOOP_TAG
from marey_schemas.kinds import Kind
from marey_schemas.queue.job_params import AnalyseStudyParams
from marey_schemas.studies.conducting import JudgingParticipant
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.evaluated_set import store_document, store_file
from marey_worker.job_io.matching_clips import refusing_motion_errors
from marey_worker.job_io.skeleton_cache import Rig, read_mapped
from marey_worker.job_io.stored_reports import inputs_of


def run(context: Context, params: AnalyseStudyParams) -> dict[str, Any]:
    """Analyse a study; the result refers to the document, to the report, and to the best metric if one was fitted.

    If the motions cannot be measured, for example because their skeletons differ, no metric is fitted, and the document
    gives the reason. Raises `JobRefused` if nobody has answered a trial.
    """
    (pin,) = context.inputs["study"]
    study = StudyDocument.model_validate(context.document(Kind.STUDY, pin.item, pin.revision, "study"))
    context.progress(0, None, "reading the answers")
    judgements = _judgements(study, context.judgements(pin))
    pairs, refusal = _measured(context, study)
    context.progress(0, None, "fitting metrics")
    with refusing_motion_errors():
        analysis = analyse_study(judgements, pairs, name=study.title, draws=params.draws, seed=context.seed)
    ref = {"item": pin.item, "revision": pin.revision}
    tree = analysis_to_tree(analysis, ref)
    tree["refusals"] += refusal
    tree["clips"] = [one.clip.model_dump(mode="json") for one in study.motions]
    tree["labels"] = [one.label for one in study.motions]
    result = {**_headline(analysis), "document": store_document(context, tree)}
    if analysis.fits:
        result["fitted"] = store_document(context, metric_to_tree(analysis, analysis.fits[0], ref))
    if params.report:
        context.progress(0, None, "writing the report")
        title, names = params.title or study.title, _names(context, study)
        page = render_study_report(analysis, names, refusal, title=title, inputs=inputs_of(context))
        result["report"] = store_file(context, page.encode())
    return result


def _judgements(study: StudyDocument, people: Sequence[JudgingParticipant]) -> Judgements:
    """Return the answered trials of all participants; participants who answered no trial are left out.

    Raises `JobRefused` if nobody has answered a trial.
    """
    answered = [[trial for trial in one.trials if trial.chosen is not None] for one in people]
    answers = [
        (who, trial.shown, trial.chosen)
        for who, trials in enumerate(filter(None, answered))
        for trial in trials
        if trial.chosen is not None
    ]
    if not answers:
        raise JobRefused(
            "no-judgements", "nobody has answered a trial of this revision of the study; wait for participants"
        )
    return judgements_of(len(study.motions), answers)


def _measured(context: Context, study: StudyDocument) -> tuple[list[PairDifferences], list[str]]:
    """Return the measured differences of all pairs of motions.

    If they cannot be measured, return an empty list and the reason.
    """
    try:
        clips = [_measure(context, one.revision) for one in study.motions]
        counts = np.array([clip.frame_count for clip in clips])
        if (cells := int(counts.sum()) ** 2 // 2) > MOST_TABLE_CELLS:
            raise MotionError(
                f"the motion maps of all pairs have {cells:,} cells together, and at most {MOST_TABLE_CELLS:,} are "
                "possible; use shorter motions"
            )
        return measure_pairs(clips, context.progress), []
    except MotionError as error:
        return [], [f"no metric was fitted: {error}"]


def _measure(context: Context, ref: RevisionRef) -> MeasuredClip:
    document = MotionDocument.model_validate(context.document(Kind.CLIP, ref.item, ref.revision, "motion"))
    info = context.document(Kind.CLIP, ref.item, ref.revision, "info", required=False) or {}
    mapped = read_mapped(context, Rig.as_stored(RevisionRef.model_validate(document.skeleton.model_dump())))
    body = MatchingBody.from_mapping(mapped.skeleton, mapped.mapping)
    clip = documents.clip_from_document(document, mapped.skeleton)
    _, measured = measure_clip(clip, body, METRIC_RATE_HZ, loop=LOOP_TAG in info.get("tags", ()))
    return measured


def _names(context: Context, study: StudyDocument) -> list[str]:
    """Return a name for each motion, as reports show it: its label, or else the name of the clip."""
    refs = [RevisionRef.model_validate(one.clip.model_dump()) for one in study.motions]
    return [one.label or context.item(Kind.CLIP, ref.item).name for one, ref in zip(study.motions, refs, strict=True)]


def _headline(analysis: StudyAnalysis) -> dict[str, Any]:
    best = analysis.fits[0] if analysis.fits else None
    return {
        "participants": analysis.participants,
        "trials": len(analysis.judgements.shown),
        "missing_pairs": len(analysis.missing),
        "triangle_violations": analysis.violated,
        "noise_ceiling": analysis.table.noise_ceiling,
        "best_shaping": None if best is None else best.parts[0].component.shaping,
        "best_rmse": None if best is None else best.quality.rmse,
    }
