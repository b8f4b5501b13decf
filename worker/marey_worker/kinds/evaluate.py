"""Kind `evaluate`: evaluates a set of locomotion clips by trials, which are divided among tasks and then combined."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from marey_client.poses.player_pages import ShownMotion, page_data
from marey_motion.clip import Clip
from marey_motion.documents import clip_to_document, skeleton_to_document
from marey_motion.evaluation.held_out import take_trials
from marey_motion.evaluation.judgement import judge
from marey_motion.evaluation.perceived import PerceivedRows
from marey_motion.evaluation.relevance import recorded_rows, sum_by_source
from marey_motion.evaluation.replicates import MeasuredReplicates, run_replicates
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.result_documents import records_from_tree, records_to_tree, result_to_tree
from marey_motion.evaluation.scenario import Trial, demand, suite_trials
from marey_motion.evaluation.suite import assemble, evaluate_baseline, run_suite
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.display import displayed_clip
from marey_motion.matching.record import TrialRecord
from marey_reports.evaluation.figures import FIGURES, DrawnFigure, draw_figure, draw_figures
from marey_reports.evaluation.page import render_report
from marey_reports.evaluation.played import PlayedTrial, choose_played
from marey_reports.evaluation.region_strips import PosedTrial, choose_by_region, poses_of
from marey_reports.evaluation.sentences import region_verdicts, verdict
from marey_schemas.documents.evaluations import HEADLINE_METRICS
from marey_schemas.documents.references import OutputRef
from marey_schemas.documents.reports import EvaluationReport
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_schemas.kinds import Kind
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.queue.facets import ItemFacets
from marey_schemas.queue.job_params import EvaluateParams
from marey_schemas.queue.worker_protocol import PinnedInput, StagedOutput
from marey_worker.context import Context, JobRefused
from marey_worker.job_io.chosen_metric import read_metric
from marey_worker.job_io.matching_clips import read_clips, refusing_motion_errors, uid_of, wanted_clips
from marey_worker.job_io.stored_reports import inputs_of, store_report

GATHERING_STEPS = 4
MOST_RATE_HZ = 30.0
"""Greatest frame rate of a played trial."""
MOST_BYTES = 750_000
"""Greatest size of a played trial in a page, if nothing could be compressed."""
_ROTATION_BYTES, _TRANSLATION_BYTES = 8, 16
"""Bytes in base64 of a packed rotation and of a packed translation that cannot be compressed."""
Headline = dict[str, float | int | None]


def run(context: Context, params: EvaluateParams) -> dict[str, Any]:
    """Simulate the trials of this task and their replicates; the result refers to a file with their records."""
    options = EvaluationOptions.of(params)
    trials = _trials(context, params, options)[context.task.position :: context.task.size]
    clips = read_clips(context, params, options.database)
    runs = max(1, len(trials) * options.replicates)  # a task is without trials if there are fewer takes than allowed
    started = time.monotonic()
    with refusing_motion_errors():
        records = run_suite(
            clips.database,
            options,
            trials=trials,
            index=clips.index,
            threads=context.threads,
            progress=lambda done, _total, note: context.progress(done, runs, note),
        )
        replicates = run_replicates(
            clips.database,
            options,
            trials,
            index=clips.index,
            threads=context.threads,
            progress=lambda done, _total, note: context.progress(len(trials) + done, runs, note),
        )
    found = {"records": records_to_tree(trials, records)} if trials else {}
    if replicates is not None:
        found["replicates"] = replicates.as_tree()
    file = context.scratch / "trials.msgpack"
    file.write_bytes(encode_tree(found, MSGPACK, arrays="blocks"))
    return {
        "trials": len(trials),
        "seconds": round(time.monotonic() - started, 4),
        "measured": {"blob": context.put_file(file)},
    }


def gather(context: Context, params: EvaluateParams, results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Compute the measures from the records of all trials; stage the evaluation, and a report if one is requested."""
    options = EvaluationOptions.of(params)
    context.progress(0, GATHERING_STEPS, "reading the records of the trials")
    trials = _trials(context, params, options)
    database = read_clips(context, params, options.database).database
    records, replicates = _read_trials(context, results, trials)
    with refusing_motion_errors():
        baseline = None
        if params.baseline and suite_trials(options):
            context.progress(1, GATHERING_STEPS, "measuring generated clips")
            baseline = evaluate_baseline(options, threads=context.threads)
        context.progress(2, GATHERING_STEPS, "measuring the trials")
        result = assemble(database, options, trials, records, replicates=replicates, baseline=baseline)
        if (metric := read_metric(context, params.metric)) is not None:
            result = replace(result, perceived=PerceivedRows(database, metric).transitions(result.switches))
    headline = headline_of(result)
    evaluation = {
        **result_to_tree(result),
        "normaliser": database.normaliser.as_tree(),
        "clip_set": wanted_clips(context, params).as_tree(),
        "verdict": verdict(result),
        "regions": [region.model_dump() for region in region_verdicts(result)],
        "headline": headline,
    }
    parts = {"evaluation": evaluation, "records": records_to_tree(trials, records)}
    if params.report:
        context.progress(3, GATHERING_STEPS, "writing the report")
        parts["report"] = write_report(context, database, result, params)
    context.stage(
        [StagedOutput(name=params.name, kind=Kind.EVALUATION, item_name=params.name, tags=params.tags, parts=parts)]
    )
    context.publish_facets(facets_of(result, context.inputs["clips"]))
    simulating_s = round(sum(one["seconds"] for one in results), 4)
    perceived = {} if result.perceived is None else {"perceived": asdict(result.perceived)}
    return {"verdict": evaluation["verdict"], **headline, **perceived, "simulating_s": simulating_s}


def _trials(context: Context, params: EvaluateParams, options: EvaluationOptions) -> tuple[Trial, ...]:
    """Return all trials of the evaluation.

    Trials along takes depend on the clips, so the clips are read if there are such trials. Raises `JobRefused` if a
    figure is requested for a trial that the evaluation does not have.
    """
    with refusing_motion_errors():
        trials = suite_trials(options)
        if "takes" in options.families:
            trials += take_trials(read_clips(context, params, options.database).database, options)
    if unknown := set(params.trial_figures) - {trial.name for trial in trials}:
        named = f"{min(unknown)!r}; a name is like {trials[0].name!r}"
        raise JobRefused("unknown-trial", f"trial_figures: the evaluation has no trial {named}")
    return trials


def _read_trials(
    context: Context, results: Sequence[Mapping[str, Any]], trials: Sequence[Trial]
) -> tuple[list[TrialRecord], MeasuredReplicates | None]:
    """Read the files of all tasks: return the record of each trial, and the measured replicates, if there are any."""
    found = [decode_tree(context.blob(result["measured"]["blob"]), MSGPACK) for result in results]
    known = {
        name: record for one in found if "records" in one for name, record in records_from_tree(one["records"]).items()
    }
    trees = [one["replicates"] for one in found if "replicates" in one]
    return [known[trial.name] for trial in trials], MeasuredReplicates.from_trees(trees, trials)


def headline_of(result: EvaluationResult) -> Headline:
    """Return the main numbers of an evaluation by name; `HEADLINE_METRICS` lists these names."""
    sources = sum_by_source(result.clips, result.usage)
    rows = recorded_rows(result.clips, result.usage)
    found: Headline = {
        "clips": len(sources),
        "unused_clips": sum(source.ticks == 0 for source in sources),
        "data_s": rows / result.options.database.rate_hz,
        "trials": len(result.trials),
        "followed_trials": judge(result).followed,
        "baseline_offset_mean_m": None if result.baseline is None else result.baseline.suite["offset_mean"],
        "coverage_index": result.coverage.index,
        "symmetry": result.coverage.symmetry,
    }
    for name, metric in HEADLINE_METRICS.items():
        if metric.of_trials is not None:
            found[name] = result.suite[metric.of_trials]
    return {name: found[name] for name in HEADLINE_METRICS}


def facets_of(result: EvaluationResult, pins: Sequence[PinnedInput]) -> tuple[ItemFacets, ...]:
    """Return how much each evaluated clip was used in the trials, as facets (published numbers) of the clip.

    The use of a mirrored copy is added to the use of the clip itself.
    """
    used = {source.uid: source for source in sum_by_source(result.clips, result.usage)}
    return tuple(
        ItemFacets(
            item=pin.item,
            revision=pin.revision,
            values={"usage": source.share, "used_frames": float((source.popularity > 0).mean())},
        )
        for pin in pins
        if (source := used.get(uid_of(pin))) is not None and len(source.popularity) > 0
    )


def write_report(
    context: Context, database: MatchingDatabase, result: EvaluationResult, params: EvaluateParams
) -> dict[str, Any]:
    """Draw all figures, write the report page, and store them as files.

    Return the document that refers to these files.
    """
    figures = draw_figures(result)
    page = render_report(
        result,
        title=params.name,
        figures=figures,
        inputs=inputs_of(context),
        played=play_trials(database, result),
        posed=pose_trials(database, result),
    )
    drawn = [*((None, figure) for figure in figures.values()), *_trial_figures(result, params)]
    return store_report(context, EvaluationReport, params.name, page, drawn)


def _trial_figures(result: EvaluationResult, params: EvaluateParams) -> Iterator[tuple[str, DrawnFigure]]:
    """Yield the requested figures of single trials, each with the name of its trial."""
    families = {one.trial.name: one.trial.family for one in result.trials}
    for trial in params.trial_figures:
        for name, kind in FIGURES.items():
            if kind.trials == "any" or (kind.trials == "one" and families[trial] in kind.families):
                yield trial, draw_figure(name, result, trial=trial)


def play_trials(database: MatchingDatabase, result: EvaluationResult) -> list[PlayedTrial]:
    """Return the motion shown in the worst and in a typical trial; empty if the trials have no records."""
    hierarchy = skeleton_to_document(database.body.skeleton).model_dump(mode="json", by_alias=True, exclude_none=True)
    played = []
    for role, judged, record in choose_played(result):
        clip = displayed_clip(database, record, result.options.controller)
        name = f"{demand(judged.outcome.trial)}, {role} trial"
        played.append(PlayedTrial(role, judged, record, clip, _packed(name, clip, hierarchy)))
    return played


def pose_trials(database: MatchingDatabase, result: EvaluationResult) -> list[PosedTrial]:
    """Return poses of the worst, a typical and the best trial of each region; empty if the trials have no records."""
    return [
        PosedTrial(region, role, judged, poses_of(displayed_clip(database, record, result.options.controller)))
        for region, role, judged, record in choose_by_region(result)
    ]


def _packed(name: str, clip: Clip, hierarchy: dict[str, Any]) -> str:
    motion = clip_to_document(thinned(clip), OutputRef(output="skeleton"))
    return page_data(name, [ShownMotion(name, motion, hierarchy)])


def thinned(clip: Clip) -> Clip:
    """Return every n-th frame of a clip, as a clip with a lower frame rate.

    The number n is the least that meets `MOST_RATE_HZ` and `MOST_BYTES`.
    """
    moved = len(clip.translated_joints)
    frame_bytes = _ROTATION_BYTES * clip.skeleton.joint_count + _TRANSLATION_BYTES * (1 + moved)
    step = max(math.ceil(clip.frame_rate_hz / MOST_RATE_HZ), math.ceil(clip.frame_count * frame_bytes / MOST_BYTES))
    translations = None if clip.translations is None else clip.translations[::step]
    return replace(clip, frame_rate_hz=clip.frame_rate_hz / step, poses=clip.poses[::step], translations=translations)
