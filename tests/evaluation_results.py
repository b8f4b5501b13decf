"""Evaluations made up for tests: no search, no clips, but every number where a real one has it."""

from dataclasses import dataclass, replace

import numpy as np

from marey_motion.evaluation.result import (
    ClipUsage,
    Coverage,
    EvaluationOptions,
    EvaluationResult,
    Grid,
    Provenance,
    TrialResult,
)
from marey_motion.evaluation.scenario import Trial, reference, suite_trials
from marey_motion.matching.database import DatabaseClip
from marey_motion.matching.record import Status, TrialRecord

RATE_HZ = 60.0
SMALL_GRID = Grid((1.0, 2.0, 3.0), (-100.0, -50.0, 0.0, 50.0, 100.0))


@dataclass
class Making:
    """How a made-up evaluation comes about.

    Parameters
    ----------
    clips, frames : how many clips, of about how many frames each
    quality : 1 follows well, smaller ones worse
    one_sided : the clips hardly turn left
    """

    clips: int = 12
    frames: int = 400
    seed: int = 0
    quality: float = 1.0
    one_sided: bool = False
    unused: int = 2


def made_up(options=None, names=None, **making):
    """A plausible evaluation."""
    options = options or EvaluationOptions(grid=SMALL_GRID, duration_s=12.0)
    how = Making(**making)
    random = np.random.default_rng(how.seed)
    clips = some_clips(how, random, names)
    trials, records = [], []
    for trial in suite_trials(options):
        record = made_up_record(trial, clips[: max(1, how.clips - how.unused)], how, random)
        records.append(record)
        trials.append(made_up_outcome(trial, record))
    result = EvaluationResult(
        options=options,
        provenance=Provenance(
            dataset="sha256:" + "d" * 64,
            clips={clip.uid: clip.content for clip in clips},
            normaliser="sha256:" + "a" * 64,
            options="sha256:" + "b" * 64,
            scenarios="sha256:" + "c" * 64,
            code_version="0.1.0",
        ),
        clips=clips,
        trials=tuple(trials),
        suite={},
        usage=(),
        switches=np.zeros((0, 3), dtype=np.int64),
        coverage=made_up_coverage(options, clips, how, random),
        records=tuple(records),
        notes=(),
    )
    return replace(result, **_summed(result))


def some_clips(how, random, names=None):
    clips, start = [], 0
    for index in range(how.clips):
        length = int(how.frames * random.uniform(0.3, 2.0))
        name = names[index] if names and index < len(names) else f"walk_{index:03d}_take{index % 3}"
        clips.append(DatabaseClip(f"clip_{index:04d}@1", name, "sha256:" + f"{index:064x}", start, start + length))
        start += length
    return tuple(clips)


def made_up_record(trial: Trial, clips, how, random):
    guide = reference(trial, RATE_HZ)
    ticks = guide.tick_count
    turn = abs(np.degrees(trial.turn_rate_rad_s)) / 100
    lag = 0.15 * (0.3 + turn * trial.speed_m_s / 3) / how.quality
    times = np.arange(ticks) / RATE_HZ
    sway = lag * np.stack((np.sin(0.9 * times + trial.speed_m_s), np.cos(1.3 * times)), axis=1)
    positions = guide.positions[:ticks] + sway * np.minimum(1.0, times / 4)[:, None]
    headings = guide.headings[:ticks] + 0.1 * turn / how.quality * np.sin(2 * np.pi * 1.8 * times)
    rows = np.empty(ticks, dtype=np.int32)
    status = np.zeros(ticks, dtype=np.int8)
    cost = 0.05 + 0.01 * np.abs(np.sin(2 * np.pi * 1.8 * times))
    tick, row, favourites = 0, 0, 1.0 / np.arange(1, len(clips) + 1)
    while tick < ticks:
        clip = clips[random.choice(len(clips), p=favourites / favourites.sum())]
        row = int(random.integers(clip.start, max(clip.start + 1, clip.stop - 20)))
        span = min(ticks - tick, int(random.integers(6, 120)), clip.stop - row)
        rows[tick : tick + span] = np.arange(row, row + span)
        if tick:
            status[tick - 1], status[tick] = Status.REPLACED, Status.REPLACING
            cost[tick] += random.uniform(0.05, 0.5) / how.quality
        tick += span
    return TrialRecord(RATE_HZ, rows, positions, headings, status, cost * 4, cost * 5, cost)


def made_up_outcome(trial, record):
    guide = reference(trial, RATE_HZ)
    ticks = guide.tick_count
    after = np.arange(ticks) / RATE_HZ >= trial.approach_s
    offset = np.linalg.norm(record.positions - guide.positions[:ticks], axis=1)[after]
    speed = np.linalg.norm(np.diff(record.positions, axis=0, prepend=record.positions[:1]), axis=1) * RATE_HZ
    speed_error = (speed - guide.speeds_m_s[:ticks])[after]
    turn = np.degrees(np.diff(record.headings, prepend=record.headings[0]) * RATE_HZ)
    turn_error = (turn - np.degrees(guide.turn_rates_rad_s[:ticks]))[after]
    switches = int(np.count_nonzero(record.status == Status.REPLACING))
    metrics = {
        "offset_mean": float(offset.mean()),
        "offset_max": float(offset.max()),
        "offset_final": float(offset[-1]),
        "se_v": float(speed_error.mean()),
        "abs_se_v": abs(float(speed_error.mean())),
        "se_omega_deg": float(turn_error.mean()),
        "abs_se_omega_deg": abs(float(turn_error.mean())),
        "dse_v": float(speed_error.std()),
        "dse_omega_deg": float(turn_error.std()),
        "pose_cost_mean": float(record.pose_cost.mean()),
        "pose_cost_p95": float(np.quantile(record.pose_cost, 0.95)),
        "pose_cost_max": float(record.pose_cost.max()),
        "transitions": float(switches),
        "transitions_per_s": switches / (ticks / RATE_HZ),
        "response_s": 0.8 if trial.family == "switching" and trial.speed_m_s < 2.5 else None,
    }
    return TrialResult(trial, metrics, {"base": metrics} if trial.family == "switching" else {})


def made_up_coverage(options, clips, how, random):
    windows = sum(max(0, clip.frame_count - 60) for clip in clips)
    owner = np.concatenate(
        [np.full(max(0, clip.frame_count - 60), index, dtype=np.int32) for index, clip in enumerate(clips)]
    )
    speeds = random.uniform(0.4, 3.0, len(clips))
    turns = random.uniform(-90.0, 15.0 if how.one_sided else 90.0, len(clips)) * (random.random(len(clips)) > 0.35)
    wander = np.cumsum(random.normal(size=(windows, 2)), axis=0) * (0.004, 0.25)
    speed = np.abs(speeds[owner] + wander[:, 0] - np.round(wander[:, 0]))
    turn = turns[owner] + (wander[:, 1] % 20.0) - 10.0
    speed_edges = _edges(options.grid.speeds_m_s)
    turn_edges = _edges(options.grid.turn_rates_deg_s)
    counts, _, _ = np.histogram2d(speed, turn, bins=[speed_edges, turn_edges])
    seconds = counts / RATE_HZ
    deficit = np.maximum(0.0, options.coverage_least_s - seconds)
    side = np.sign(random.random(windows) - 0.1)
    return Coverage(
        clip=owner,
        speed_m_s=speed,
        turn_rate_rad_s=np.radians(turn),
        forward_m_s=speed * side,
        strafe_m_s=0.2 * speed * random.normal(size=windows),
        speed_edges_m_s=speed_edges,
        turn_rate_edges_deg_s=turn_edges,
        seconds=seconds,
        deficit_s=deficit,
        index=float(np.mean(deficit == 0.0)),
        symmetry=float(1.0 - 0.5 * np.abs(seconds - seconds[:, ::-1]).sum() / max(seconds.sum(), 1e-9)),
        too_short=tuple(index for index, clip in enumerate(clips) if clip.frame_count < 60),
    )


def _edges(centres):
    centres = np.asarray(centres)
    steps = np.diff(centres) if len(centres) > 1 else np.ones(1)
    inner = 0.5 * (centres[:-1] + centres[1:])
    return np.concatenate(([centres[0] - steps[0] / 2], inner, [centres[-1] + steps[-1] / 2]))


def _summed(result):
    """Usage, switches and pooled metrics, as counted from the records."""
    starts = np.array([clip.start for clip in result.clips])
    ticks = np.zeros(result.clips[-1].stop, dtype=np.int64)
    trials = np.zeros(len(result.clips), dtype=np.int64)
    entries = np.zeros(len(result.clips), dtype=np.int64)
    pairs = []
    for record in result.records:
        ticks += np.bincount(record.rows, minlength=len(ticks))
        owners = np.searchsorted(starts, record.rows, side="right") - 1
        trials[np.unique(owners)] += 1
        entered = np.flatnonzero(record.status == Status.REPLACING)
        np.add.at(entries, owners[entered], 1)
        pairs.append(np.stack((record.rows[entered - 1], record.rows[entered]), axis=1))
    rows, counts = np.unique(np.concatenate(pairs), axis=0, return_counts=True)
    usage = []
    for index, clip in enumerate(result.clips):
        shown = ticks[clip.start : clip.stop]
        usage.append(
            ClipUsage(
                index,
                int(shown.sum()),
                float(shown.sum() / ticks.sum()),
                int(entries[index]),
                int(trials[index]),
                shown,
            )
        )
    names = result.trials[0].metrics
    suite = {name: _mean([each.metrics[name] for each in result.trials]) for name in names}
    return {
        "usage": tuple(usage),
        "switches": np.concatenate((rows, counts[:, None]), axis=1).astype(np.int64),
        "suite": suite,
    }


def _mean(values):
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
