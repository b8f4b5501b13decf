"""A suite of trials over a database: run on several threads, measured, and assembled.

The result depends only on the database, the options and the trials, not on the threads or the order of work.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import count
from math import radians

from marey_motion.errors import MotionError
from marey_motion.evaluation.coverage import measure_coverage
from marey_motion.evaluation.held_out import take_trials
from marey_motion.evaluation.looks import LooksMeter
from marey_motion.evaluation.metrics import measure_trial
from marey_motion.evaluation.pooling import pool_suite
from marey_motion.evaluation.provenance import provenance_of
from marey_motion.evaluation.relevance import UsageTally, count_switches, treading_share, unused_clips
from marey_motion.evaluation.replicates import MeasuredReplicates, run_of, run_replicates, simulate
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.running import CancelCallback, ProgressCallback, run_each
from marey_motion.evaluation.scenario import Trial, reference, require_names, suite_trials
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.copies import index_of
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.matching.record import TrialRecord
from marey_motion.matching.search import SearchIndex
from marey_motion.rigs import map_joints
from marey_schemas.documents.replicates import LEAST_REPLICATES
from marey_schemas.options.evaluation import EvaluationOptions

_baselines: dict[EvaluationOptions, EvaluationResult] = {}
BASELINE_CLIP_S = 8.0


def run_suite(
    database: MatchingDatabase,
    options: EvaluationOptions,
    *,
    trials: Sequence[Trial] | None = None,
    done: Mapping[str, TrialRecord] | None = None,
    index: SearchIndex | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    finished: Callable[[Trial, TrialRecord], None] | None = None,
    cancelled: CancelCallback | None = None,
) -> list[TrialRecord]:
    """Run motion matching along the reference trajectory of each trial.

    Callbacks run in the calling thread.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    options of the evaluation
    trials : sequence of Trial, optional    the trials to run; all of the suite if None
    done : mapping of str to TrialRecord, optional    simulated ticks of trials that have run already, by name of the
        trial; these trials are not run again
    index : SearchIndex, optional    index of the database's normalised features, built if None
    threads : int, optional    number of trials at a time; one per processor if None
    progress : callable, optional    called as progress(trials done, total, name of the last trial)
    finished : callable, optional    called with each trial and its simulated ticks as soon as the trial ends
    cancelled : callable, optional    called before trials are started; returns True to stop

    Returns
    -------
    list of TrialRecord    one per trial, in the order of `trials`

    Raises
    ------
    EvaluationCancelled    if cancelled; trials that are running are finished first
    MotionError    if two trials have the same name, for example because their speeds differ by less than a millionth
    """
    wanted = suite_trials(options) if trials is None else tuple(trials)
    require_names(wanted)
    records = dict(done or {})
    ahead = [trial for trial in wanted if trial.name not in records]
    report = progress or (lambda _done, _total, _note: None)
    report(len(wanted) - len(ahead), len(wanted), "")
    numbers = count(len(wanted) - len(ahead) + 1)

    def keep(trial: Trial, record: TrialRecord) -> None:
        records[trial.name] = record
        if finished is not None:
            finished(trial, record)
        report(next(numbers), len(wanted), trial.name)

    if ahead:
        searched = index or index_of(database)
        run = _runner(database, searched, options)
        run_each(run, ahead, keep, threads or os.cpu_count() or 1, cancelled or (lambda: False))
    return [records[trial.name] for trial in wanted]


def _runner(
    database: MatchingDatabase, index: SearchIndex, options: EvaluationOptions
) -> Callable[[Trial], TrialRecord]:
    return lambda trial: simulate(database, index, options, run_of(trial, 0, options))


def assemble(
    database: MatchingDatabase,
    options: EvaluationOptions,
    trials: Sequence[Trial],
    records: Sequence[TrialRecord],
    *,
    replicates: MeasuredReplicates | None = None,
    baseline: EvaluationResult | None = None,
) -> EvaluationResult:
    """Measure finished trials and assemble the result.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    options of the evaluation
    trials : sequence of Trial    the trials
    records : sequence of TrialRecord    simulated ticks of each trial, in the order of the trials
    replicates : MeasuredReplicates, optional    the further replicates, if the options ask for more than one
    baseline : EvaluationResult, optional    the same suite over generated clips

    Returns
    -------
    EvaluationResult    the evaluation

    Raises
    ------
    MotionError    if the records belong to other trials, or if replicates are missing
    """
    if len(trials) != len(records):
        raise MotionError(f"each trial needs one record, but there are {len(records)} records for {len(trials)} trials")
    rate, looks = database.options.rate_hz, LooksMeter(database, options.controller)
    results = tuple(
        measure_trial(trial, reference(trial, rate), record, options, looks)
        for trial, record in zip(trials, records, strict=True)
    )
    pooled = pool_suite(results, treading_share(database.clips, records), options, replicates)
    tally = UsageTally.of(database.clips)
    for trial, record in zip(trials, records, strict=True):
        tally.add(database.clips, trial.name, record)
    if replicates is not None:
        tally = UsageTally.total([tally, replicates.usage])
    usage = tally.usage(database.clips)
    return EvaluationResult(
        options=options,
        provenance=provenance_of(database, options, trials),
        clips=database.clips,
        trials=pooled.trials,
        suite={**pooled.suite, "unused_clips": float(len(unused_clips(usage)))},
        usage=usage,
        switches=count_switches(database.clips, records),
        coverage=measure_coverage(database, options),
        records=tuple(records),
        baseline=baseline,
        notes=tuple(str(note) for note in database.notes),
        replicates=pooled.replicates,
    )


def evaluate(
    database: MatchingDatabase,
    options: EvaluationOptions,
    *,
    threads: int | None = None,
    with_baseline: bool = True,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> EvaluationResult:
    """Evaluate a database: run all trials, and measure them.

    By default, the same trials also run over generated clips, the baseline, for comparison.

    Parameters
    ----------
    database : MatchingDatabase    the clips
    options : EvaluationOptions    options of the evaluation
    threads : int, optional    number of trials at a time; one per processor if None
    with_baseline : bool    whether to evaluate the baseline, too; it never has trials along takes
    progress : callable, optional    called as progress(runs done, total, name of the last trial); a run is one
        replicate of a trial, over the database or over generated clips
    cancelled : callable, optional    returns True to stop

    Returns
    -------
    EvaluationResult    the evaluation

    Raises
    ------
    EvaluationCancelled    if cancelled
    MotionError    if two trials have the same name, if no clip is suitable for the requested trials along takes, or if
        no clip of the baseline can be generated
    """
    trials = (*suite_trials(options), *take_trials(database, options))
    index = index_of(database)
    replicated = len(trials) * options.replicates
    asked = len(suite_trials(options))
    with_baseline = with_baseline and asked > 0
    total = replicated + (asked * baseline_replicates(options) if with_baseline else 0)
    report = progress or (lambda _done, _total, _note: None)

    def progress_after(before: int) -> ProgressCallback:
        return lambda done, _total, note: report(before + done, total, note)

    records = run_suite(
        database,
        options,
        trials=trials,
        index=index,
        threads=threads,
        progress=progress_after(0),
        cancelled=cancelled,
    )
    replicates = run_replicates(
        database,
        options,
        trials,
        index=index,
        threads=threads,
        progress=progress_after(len(trials)),
        cancelled=cancelled,
    )
    baseline = None
    if with_baseline:
        baseline = evaluate_baseline(options, threads=threads, progress=progress_after(replicated), cancelled=cancelled)
    return assemble(database, options, trials, records, replicates=replicates, baseline=baseline)


def evaluate_baseline(
    options: EvaluationOptions,
    *,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    cancelled: CancelCallback | None = None,
) -> EvaluationResult:
    """Evaluate the baseline: the same trials over clips generated for every cell of the grid.

    The result contains no simulated ticks; the last result is cached. The baseline has as many replicates as
    `baseline_replicates` returns, because chance affects its metrics, too. Trials along takes are left out.

    Parameters
    ----------
    options : EvaluationOptions    options of the evaluation
    threads : int, optional    number of trials at a time; one per processor if None
    progress : callable, optional    called as progress(done, total, name)
    cancelled : callable, optional    returns True to stop

    Returns
    -------
    EvaluationResult    the evaluation

    Raises
    ------
    EvaluationCancelled    if cancelled
    MotionError    if no clip can be generated for any speed and turn rate of the grid
    """
    families = tuple(family for family in options.families if family != "takes")
    options = options.replace(replicates=baseline_replicates(options), families=families)
    if options not in _baselines:
        database, notes = baseline_database(options)
        made = evaluate(database, options, threads=threads, with_baseline=False, progress=progress, cancelled=cancelled)
        _baselines.clear()
        _baselines[options] = replace(made, records=(), notes=(*notes, *made.notes))
    elif progress is not None:
        runs = len(_baselines[options].trials) * options.replicates
        progress(runs, runs, "")
    return _baselines[options]


def baseline_replicates(options: EvaluationOptions) -> int:
    """Return the number of replicates in which the baseline of an evaluation runs.

    Parameters
    ----------
    options : EvaluationOptions    options of the evaluation

    Returns
    -------
    int    the number of replicates of the evaluation, but at most `LEAST_REPLICATES`, the number that a confidence
        interval needs. More are not needed, because differences from the baseline are not tested
    """
    return min(options.replicates, LEAST_REPLICATES)


def baseline_clips(options: EvaluationOptions) -> tuple[list[SourceClip], list[str]]:
    """Generate a gait for each pair of speed and turn rate of the grid, and for the speed to which trials switch.

    Parameters
    ----------
    options : EvaluationOptions    grid and rate

    Returns
    -------
    clips : list of SourceClip    the gaits
    notes : list of str    pairs of speed and turn rate for which no gait can be generated
    """
    speeds = set(options.speeds_m_s)
    if "switching" in options.families:
        speeds.add(options.switch_speed_m_s)
    clips: list[SourceClip] = []
    notes: list[str] = []
    for speed in sorted(speeds):
        for turn_rate in sorted(set(options.turn_rates_deg_s)):
            name = f"v={speed:g} w={turn_rate:g}"
            try:
                clip = generate_gait(speed, radians(turn_rate), BASELINE_CLIP_S, options.database.rate_hz)
            except MotionError as error:
                if error.code != "gait-out-of-reach":
                    raise
                notes.append(f"no generated clip for {name}: {error.message}")
                continue
            clips.append(SourceClip(uid=f"gait-{len(clips):04d}", name=name, clip=clip))
    return clips, notes


def baseline_database(options: EvaluationOptions) -> tuple[MatchingDatabase, list[str]]:
    """Build a database of the generated clips, with a normaliser fitted to these clips.

    Parameters
    ----------
    options : EvaluationOptions    grid and rate

    Returns
    -------
    database : MatchingDatabase    the gaits
    notes : list of str    pairs of speed and turn rate for which no gait can be generated

    Raises
    ------
    MotionError    if no gait can be generated for any pair
    """
    clips, notes = baseline_clips(options)
    if not clips:
        raise MotionError(
            "no walk can be generated for any speed and turn rate of the grid; choose slower "
            "speeds or lower turn rates",
            where="grid",
        )
    skeleton = clips[0].clip.skeleton
    body = MatchingBody.from_mapping(skeleton, map_joints(skeleton))
    return build_database(clips, body, options.database.replace(mirroring="none")), notes
