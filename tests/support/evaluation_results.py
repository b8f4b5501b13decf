"""Synthetic evaluations for tests: records that are computed without motion and searches, measured like real ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator

from marey_motion.arrays import Ints, Ints32
from marey_motion.evaluation.coverage import Windows, coverage_of
from marey_motion.evaluation.metrics import measure_trial
from marey_motion.evaluation.pooling import pooled_metrics
from marey_motion.evaluation.relevance import count_switches, measure_usage
from marey_motion.evaluation.result import Coverage, EvaluationResult, Provenance
from marey_motion.evaluation.scenario import Trial, reference, suite_trials
from marey_motion.matching.database import DatabaseClip
from marey_motion.matching.record import Status, TrialRecord
from marey_schemas.options.evaluation import EvaluationOptions

RATE_HZ = 60.0
SMALL = EvaluationOptions(
    speeds_m_s=(1.0, 2.0, 3.0), turn_rates_deg_s=(-100.0, -50.0, 0.0, 50.0, 100.0), duration_s=12.0, replicates=1
)


@dataclass(frozen=True)
class Making:
    """Parameters of a synthetic evaluation.

    Parameters
    ----------
    clips, frames : number of clips, and approximate number of frames of each clip
    sway_m : distance of the character from its path at high speed and turn rate
    turns_deg_s : range of the turn rates of the clips
    unused : number of clips, counted from the last one, that are never displayed
    names : names of the first clips
    """

    clips: int = 12
    frames: int = 400
    seed: int = 0
    sway_m: float = 0.2
    turns_deg_s: tuple[float, float] = (-90.0, 90.0)
    unused: int = 2
    names: tuple[str, ...] = ()


def synthetic_result(options: EvaluationOptions = SMALL, **making: Any) -> EvaluationResult:
    """Return a plausible evaluation; the same arguments give the same evaluation."""
    how = Making(**making)
    random = np.random.default_rng(how.seed)
    clips = some_clips(how, random)
    shown = clips[: max(1, len(clips) - how.unused)]
    trials = suite_trials(options)
    records = tuple(wandering(trial, shown, how.sway_m, random) for trial in trials)
    return evaluated(options, clips, trials, records, some_coverage(options, clips, how, random))


def evaluated(
    options: EvaluationOptions,
    clips: tuple[Any, ...],
    trials: Sequence[Any],
    records: tuple[Any, ...],
    coverage: Coverage,
) -> EvaluationResult:
    """Return the evaluation of trials, computed from their records."""
    outcomes = tuple(
        measure_trial(trial, reference(trial, RATE_HZ), record, options)
        for trial, record in zip(trials, records, strict=True)
    )
    return EvaluationResult(
        options=options,
        provenance=Provenance(
            dataset="sha256:" + "d" * 64,
            clips={clip.uid: clip.content for clip in clips},
            normaliser="sha256:" + "a" * 64,
            options="sha256:" + "b" * 64,
            scenarios="sha256:" + "c" * 64,
            code_version="1.2.3",
        ),
        clips=clips,
        trials=outcomes,
        suite=pooled_metrics(outcomes),
        usage=measure_usage(clips, records),
        switches=count_switches(clips, records),
        coverage=coverage,
        records=records,
    )


def some_clips(how: Making, random: Generator) -> tuple[DatabaseClip, ...]:
    clips, start = [], 0
    for index in range(how.clips):
        stop = start + max(1, int(how.frames * random.uniform(0.3, 2.0)))
        name = how.names[index] if index < len(how.names) else f"walk_{index:03d}"
        clips.append(DatabaseClip(f"clip-{index:04d}@1", name, f"sha256:{index:064x}", start, stop))
        start = stop
    return tuple(clips)


def wandering(trial: Trial, clips: tuple[Any, ...], sway_m: float, random: Generator) -> TrialRecord:
    """Return the record of a character that sways about its path and plays ranges of clips, early clips most often."""
    guide = reference(trial, RATE_HZ)
    ticks = guide.tick_count
    times = np.arange(ticks) / RATE_HZ
    turn = abs(trial.turn_rate_rad_s) / np.radians(100.0)
    sway = sway_m * (0.3 + turn * trial.speed_m_s) * np.minimum(1.0, times / 4.0)
    positions = guide.positions[:ticks] + (sway * (np.sin(0.9 * times + trial.speed_m_s), np.cos(1.3 * times))).T
    headings = guide.headings[:ticks] + 0.05 * sway * np.sin(2 * np.pi * 1.8 * times)
    rows, entered = _stretches(ticks, clips, random)
    status = np.zeros(ticks, dtype=np.int8)
    status[entered], status[entered - 1] = Status.REPLACING, Status.REPLACED
    pose_cost = 0.05 + 0.01 * np.abs(np.sin(2 * np.pi * 1.8 * times))
    pose_cost[entered - 1] += random.uniform(0.05, 0.5, len(entered))
    return TrialRecord(RATE_HZ, rows, positions, headings, status, 4.0 * pose_cost, 5.0 * pose_cost, pose_cost)


def _stretches(ticks: int, clips: tuple[Any, ...], random: Generator) -> tuple[Ints32, Ints]:
    """Return the displayed row of each tick, and the ticks at which another range of a clip begins."""
    favour = 1.0 / np.arange(1, len(clips) + 1)
    rows, tick = np.empty(ticks, dtype=np.int32), 0
    entered: list[int] = []
    while tick < ticks:
        clip = clips[random.choice(len(clips), p=favour / favour.sum())]
        row = int(random.integers(clip.start, max(clip.start + 1, clip.stop - 20)))
        span = min(ticks - tick, int(random.integers(6, 120)), clip.stop - row)
        rows[tick : tick + span] = np.arange(row, row + span)
        entered += [tick] * bool(tick)
        tick += span
    return rows, np.array(entered, dtype=np.int64)


def some_coverage(options: EvaluationOptions, clips: tuple[Any, ...], how: Making, random: Generator) -> Coverage:
    """Return the coverage by clips, each with about one speed and turn rate.

    About a tenth of the clips goes backwards.
    """
    counts = [max(0, clip.frame_count - round(RATE_HZ)) for clip in clips]
    owner = np.repeat(np.arange(len(clips)), counts).astype(np.int32)
    speed = random.uniform(0.6, 3.0, len(clips))[owner] + 0.15 * random.normal(size=len(owner))
    least, most = how.turns_deg_s
    turn = random.uniform(least, most, len(clips))[owner] + 5.0 * random.normal(size=len(owner))
    ahead = np.where(random.random(len(clips)) < 0.1, -1.0, 1.0)[owner]
    speed = np.abs(speed)
    windows = Windows(speed, np.radians(turn), speed * ahead, 0.1 * speed * random.normal(size=len(owner)))
    too_short = tuple(index for index, count in enumerate(counts) if not count)
    return coverage_of(windows, owner, too_short, options, window_s=1.0 / RATE_HZ)
