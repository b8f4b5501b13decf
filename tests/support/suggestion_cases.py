"""Small suites of trials with databases of known contents, for tests of suggestions."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from tests.support.synthetic_databases import Track, arc_track, mirrored_track, random_tracks, synthetic_database

from marey_motion.arrays import Ints32
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.evaluation.suite import assemble, run_suite
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import TrialRecord
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.matching import ControllerOptions

OPTIONS = EvaluationOptions(
    speeds_m_s=(1.0, 2.0),
    turn_rates_deg_s=(-50.0, 0.0, 50.0),
    approach_s=2.0,
    duration_s=6.0,
    replicates=1,
    families=("circle",),
    # A frame that is barred near the current one could be chosen in a copy of its clip.
    controller=ControllerOptions(reselect_window_s=0.0),
)
UNWANTED = ("fast_000", "fast_001")


def named(tracks: list[Track], prefix: str = "clip") -> list[Track]:
    return [track._replace(uid=f"{prefix}_{number:03d}") for number, track in enumerate(tracks)]


def wandering_tracks(count: int = 8, seed: int = 3) -> list[Track]:
    """Return random tracks (paths of a root), and two tracks that are faster than every trial."""
    fast = [arc_track(9.0 + number, 0.0, 4.0, uid=uid) for number, uid in enumerate(UNWANTED)]
    return [*named(random_tracks(count, seed)), *fast]


def with_mirrored(tracks: list[Track]) -> MatchingDatabase:
    """Return a database of the tracks and of their mirrored copies."""
    both = sorted(
        (one for track in tracks for one in (track, mirrored_track(track)._replace(uid=f"{track.uid}~mirrored"))),
        key=lambda track: track.uid,
    )
    database = synthetic_database(both)
    clips = tuple(
        replace(clip, mirrored_from=clip.uid.removesuffix("~mirrored")) if clip.uid.endswith("~mirrored") else clip
        for clip in database.clips
    )
    return replace(database, clips=clips)


def simulated(database: MatchingDatabase, options: EvaluationOptions = OPTIONS) -> list[TrialRecord]:
    """Return the records of all trials of the suite."""
    return run_suite(database, options, trials=suite_trials(options))


def evaluated(database: MatchingDatabase, options: EvaluationOptions = OPTIONS) -> EvaluationResult:
    """Return the evaluation of the database, without a baseline."""
    return assemble(database, options, suite_trials(options), simulated(database, options))


def same_to_the_bit(
    database: MatchingDatabase,
    records: Sequence[TrialRecord],
    other: MatchingDatabase,
    other_records: Sequence[TrialRecord],
) -> bool:
    """Return whether two sets of trials are equal in every bit, with rows given as clip and frame."""
    return all(
        np.array_equal(getattr(one, name), getattr(two, name), equal_nan=name.endswith("_cost"))
        for one, two in zip(records, other_records, strict=True)
        for name in ("positions", "headings", "status", "match_cost", "continuing_cost", "pose_cost")
    ) and all(
        places(database, one.rows) == places(other, two.rows) for one, two in zip(records, other_records, strict=True)
    )


def places(database: MatchingDatabase, rows: Ints32) -> list[tuple[str, int]]:
    """Return the uid of the clip and the frame of each row.

    For a part of a clip, these are uid and frame of the whole clip.
    """
    found = []
    for index, row in zip(database.clip_of_row[rows].tolist(), rows.tolist(), strict=True):
        clip = database.clips[index]
        uid, _, part = clip.uid.partition("#")
        found.append((uid, row - clip.start + (int(part.split("-")[0]) if part else 0)))
    return found
