import threading
from itertools import product

import numpy as np
import pytest
from tests.support.evaluation_cases import arc, trajectory_database
from tests.support.present import present

from marey_motion.errors import MotionError
from marey_motion.evaluation.result import EvaluationResult
from marey_motion.evaluation.result_documents import records_to_tree
from marey_motion.evaluation.running import EvaluationCancelled, run_each
from marey_motion.evaluation.scenario import Trial, reference, suite_trials
from marey_motion.evaluation.suite import assemble, run_suite
from marey_motion.matching.database import MatchingDatabase
from marey_motion.matching.record import TrialRecord
from marey_schemas.encoding.codecs import encode_tree
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.matching import ControllerOptions

OPTIONS = EvaluationOptions(
    speeds_m_s=(1.0, 2.0), turn_rates_deg_s=(-50.0, 0.0, 50.0), duration_s=6.0, switch_every_s=2.0, replicates=1
)
TRIALS = suite_trials(OPTIONS)


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    return trajectory_database(*(arc(v, w, 8.0) for v, w in product((1.0, 2.0, 4.0), (-50.0, 0.0, 50.0))))


@pytest.fixture(scope="module")
def records(database: MatchingDatabase) -> list[TrialRecord]:
    return run_suite(database, OPTIONS, threads=1)


def stored(trials: tuple[Trial, ...], records: list[TrialRecord]) -> bytes:
    return encode_tree(records_to_tree(trials, records), "application/msgpack", arrays="blocks")


# Running


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_the_number_of_threads_changes_no_byte(
    database: MatchingDatabase, records: list[TrialRecord], threads: int
) -> None:
    assert stored(TRIALS, run_suite(database, OPTIONS, threads=threads)) == stored(TRIALS, records)


def test_the_order_of_the_trials_changes_no_byte(database: MatchingDatabase, records: list[TrialRecord]) -> None:
    order = np.random.default_rng(3).permutation(len(TRIALS)).tolist()
    shuffled = run_suite(database, OPTIONS, trials=[TRIALS[at] for at in order], threads=2)

    assert stored(TRIALS, [shuffled[order.index(at)] for at in range(len(TRIALS))]) == stored(TRIALS, records)


def test_shares_of_the_trials_run_alone_make_up_the_whole(
    database: MatchingDatabase, records: list[TrialRecord]
) -> None:
    shares = [run_suite(database, OPTIONS, trials=TRIALS[share::3], threads=2) for share in range(3)]

    assert stored(TRIALS, [shares[at % 3][at // 3] for at in range(len(TRIALS))]) == stored(TRIALS, records)


def test_trials_that_were_run_before_are_not_run_again(database: MatchingDatabase, records: list[TrialRecord]) -> None:
    done = {trial.name: record for trial, record in zip(TRIALS[:7], records, strict=False)}
    made = []
    resumed = run_suite(
        database, OPTIONS, done=done, threads=2, finished=lambda trial, _record: made.append(trial.name)
    )

    assert sorted(made) == sorted(trial.name for trial in TRIALS[7:])
    assert all(resumed[at] is records[at] for at in range(7))
    assert stored(TRIALS, resumed) == stored(TRIALS, records)


def test_nothing_is_run_when_everything_was(database: MatchingDatabase, records: list[TrialRecord]) -> None:
    done = {trial.name: record for trial, record in zip(TRIALS, records, strict=True)}

    assert run_suite(database, OPTIONS, done=done, cancelled=lambda: True) == records


def test_progress_begins_with_what_is_done_and_ends_with_all(
    database: MatchingDatabase, records: list[TrialRecord]
) -> None:
    told = []
    run_suite(
        database,
        OPTIONS,
        done={TRIALS[4].name: records[4]},
        threads=2,
        progress=lambda done, total, note: told.append((done, total, note)),
    )

    assert [done for done, _, _ in told] == list(range(1, len(TRIALS) + 1))
    assert {total for _, total, _ in told} == {len(TRIALS)}
    assert {note for _, _, note in told[1:]} == {trial.name for trial in TRIALS} - {TRIALS[4].name}


def test_callbacks_run_where_the_suite_was_called(database: MatchingDatabase) -> None:
    where = set()

    def note_thread(*_progress: object) -> None:
        where.add(threading.get_ident())

    def not_cancelled() -> bool:
        note_thread()
        return False

    run_suite(
        database,
        OPTIONS,
        trials=TRIALS[:4],
        threads=2,
        progress=note_thread,
        finished=note_thread,
        cancelled=not_cancelled,
    )

    assert where == {threading.get_ident()}


def test_a_cancelled_suite_hands_over_what_it_finished_and_can_be_resumed(
    database: MatchingDatabase, records: list[TrialRecord]
) -> None:
    kept = {}
    with pytest.raises(EvaluationCancelled, match="of 12 runs were not made"):
        run_suite(
            database,
            OPTIONS,
            threads=2,
            finished=lambda trial, record: kept.update({trial.name: record}),
            cancelled=lambda: len(kept) >= 5,
        )

    assert 5 <= len(kept) < len(TRIALS)
    assert stored(TRIALS, run_suite(database, OPTIONS, done=kept)) == stored(TRIALS, records)


def test_a_suite_cancelled_at_once_runs_nothing(database: MatchingDatabase) -> None:
    made = []
    with pytest.raises(EvaluationCancelled):
        run_suite(database, OPTIONS, finished=lambda trial, _record: made.append(trial), cancelled=lambda: True)

    assert made == []


def test_a_stop_is_asked_for_until_it_comes_and_then_holds() -> None:
    answers = iter([False, True, False, False])
    made: list[int] = []
    with pytest.raises(EvaluationCancelled, match="2 of 4 runs were not made"):
        run_each(lambda item: item, range(4), lambda item, _made: made.append(item), 2, lambda: next(answers))

    assert made == [0, 1]


def test_an_option_that_makes_no_sense_ends_the_suite_with_its_name(database: MatchingDatabase) -> None:
    options = OPTIONS.replace(controller=ControllerOptions(search_every_s=0.004))
    with pytest.raises(MotionError, match="search_every_s"):
        run_suite(database, options, threads=2)


def test_trials_that_cannot_be_told_apart_are_refused(database: MatchingDatabase) -> None:
    options = OPTIONS.replace(speeds_m_s=(1.0, 1.0 + 1e-9), turn_rates_deg_s=(0.0,), families=("circle",))
    with pytest.raises(MotionError, match="two trials are called circle v=1 w=0"):
        run_suite(database, options)


# Putting together


@pytest.fixture(scope="module")
def result(database: MatchingDatabase, records: list[TrialRecord]) -> EvaluationResult:
    return assemble(database, OPTIONS, TRIALS, records)


def test_every_tick_of_every_trial_is_counted_once(result: EvaluationResult, records: list[TrialRecord]) -> None:
    ticks = sum(len(record.rows) for record in records)

    assert sum(usage.ticks for usage in result.usage) == ticks
    assert sum(usage.share for usage in result.usage) == pytest.approx(1.0)
    assert sum(usage.entries for usage in result.usage) == result.switches[:, 2].sum()


def test_the_suite_has_values_for_all_for_each_family_and_for_each_speed(result: EvaluationResult) -> None:
    offsets = [present(one.metrics["offset_mean"]) for one in result.trials]
    of_circles = [present(one.metrics["offset_mean"]) for one in result.trials if one.trial.family == "circle"]
    switched = [present(one.regimes["switched"]["se_v"]) for one in result.trials if one.regimes]

    assert result.suite["offset_mean"] == pytest.approx(np.mean(offsets))
    assert result.suite["circle.offset_mean"] == pytest.approx(np.mean(of_circles))
    assert result.suite["switching.switched.se_v"] == pytest.approx(np.mean(switched))
    assert result.suite["unused_clips"] == sum(usage.ticks == 0 for usage in result.usage)


def test_trials_stand_in_the_order_of_the_suite(result: EvaluationResult) -> None:
    assert tuple(one.trial for one in result.trials) == TRIALS
    assert len(result.records) == len(TRIALS)


def test_records_and_trials_must_be_as_many(database: MatchingDatabase, records: list[TrialRecord]) -> None:
    with pytest.raises(MotionError, match="11 records for 12 trials"):
        assemble(database, OPTIONS, TRIALS, records[1:])


def test_the_unused_clips_can_go_without_changing_a_trial(
    database: MatchingDatabase, records: list[TrialRecord], result: EvaluationResult
) -> None:
    used = [at for at, usage in enumerate(result.usage) if usage.ticks]
    roots = [
        (database.root_positions[clip.start : clip.stop], database.root_headings[clip.start : clip.stop])
        for clip in database.clips
    ]
    unused = arc(0.2, 300.0, 6.0)
    more = trajectory_database(*roots, unused)
    less = trajectory_database(*(roots[at] for at in used))

    for other in (run_suite(more, OPTIONS), run_suite(less, OPTIONS)):
        for before, after in zip(records, other, strict=True):
            assert np.array_equal(before.positions, after.positions)
            assert np.array_equal(before.match_cost, after.match_cost, equal_nan=True)


# What a suite says


def test_a_clip_of_the_whole_trajectory_is_followed_without_error_or_transition() -> None:
    for speed, turn_rate in ((2.0, 50.0), (1.0, -100.0), (3.0, 25.0)):
        options = EvaluationOptions(
            speeds_m_s=(speed,), turn_rates_deg_s=(turn_rate,), families=("circle",), replicates=1
        )
        (trial,) = suite_trials(options)
        asked = reference(trial)
        database = trajectory_database((asked.positions, asked.headings))
        for follow in ("time", "path"):
            followed = options.replace(controller=ControllerOptions(follow=follow))
            metrics = assemble(database, followed, [trial], run_suite(database, followed)).trials[0].metrics
            assert present(metrics["offset_max"]) < 1e-10
            assert abs(present(metrics["se_omega_deg"])) < 1e-10
            assert present(metrics["dse_v"]) < 1e-10
            assert metrics["transitions"] == 0.0


def test_straight_and_circle_clips_hold_speed_and_turn_in_every_mode() -> None:
    for speed, turn_rate in ((1.0, 25.0), (2.0, 50.0), (3.0, 100.0)):
        database = trajectory_database(arc(speed, 0.0, 40.0), arc(speed, turn_rate, 40.0))
        for follow in ("time", "path", "open_loop"):
            options = EvaluationOptions(
                speeds_m_s=(speed,),
                turn_rates_deg_s=(turn_rate,),
                families=("circle",),
                replicates=1,
                controller=ControllerOptions(follow=follow, root_inertialisation=False),
            )
            trials = suite_trials(options)
            metrics = assemble(database, options, trials, run_suite(database, options)).trials[0].metrics
            assert present(metrics["abs_se_v"]) <= 2e-4
            assert present(metrics["abs_se_omega_deg"]) <= 0.5
            if follow == "time":
                assert 0.0 < present(metrics["offset_mean"]) < speed / 2
            if follow == "open_loop":
                assert present(metrics["offset_mean"]) < 0.05


def test_a_set_that_holds_the_mirror_image_of_every_clip_turns_alike_to_both_sides() -> None:
    options = EvaluationOptions(
        families=("circle",), replicates=1, controller=ControllerOptions(root_inertialisation=False)
    )
    grid = options
    database = trajectory_database(*(arc(v, w, 10.0) for v, w in product(grid.speeds_m_s, grid.turn_rates_deg_s)))
    result = assemble(database, options, suite_trials(options), run_suite(database, options))

    assert present(result.suite["offset_asymmetry"]) < 1e-12
    assert result.coverage.symmetry == 1.0
    assert result.coverage.index == 1.0
