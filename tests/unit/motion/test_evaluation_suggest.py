"""Suggestions of evaluations are correct for synthetic and for real clips."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import stdtr, stdtrit
from tests.support.compared_evaluations import compare_results
from tests.support.suggestion_cases import (
    OPTIONS,
    UNWANTED,
    evaluated,
    named,
    same_to_the_bit,
    simulated,
    wandering_tracks,
)
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.errors import MotionError
from marey_motion.evaluation.compare import OBJECTIVE, MetricChange, corrected_family, paired_change
from marey_motion.evaluation.improvement.effects import Effect
from marey_motion.evaluation.improvement.filling import FilledCell, Filling
from marey_motion.evaluation.improvement.objective import HEADLINES, headline_means
from marey_motion.evaluation.improvement.reasons import why_filling, why_redundant
from marey_motion.evaluation.improvement.redundancy import Removal
from marey_motion.evaluation.improvement.repeating import repeated
from marey_motion.evaluation.improvement.selection import joined, without_rows, without_sources
from marey_motion.evaluation.improvement.suggest import Suggestions, suggest
from marey_motion.evaluation.improvement.suggestion_documents import comparison_to_tree, suggestions_to_tree
from marey_motion.evaluation.replicates import run_replicates
from marey_motion.evaluation.running import EvaluationCancelled
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.evaluation.similarity import accepted_distance
from marey_motion.evaluation.suite import assemble
from marey_motion.formats import read_motion
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.rigs import map_joints
from marey_schemas.options.evaluation import EvaluationOptions
from marey_schemas.options.improvement import SuggestionOptions

FEW = SuggestionOptions(estimation_replicates=2, confirmation_replicates=3, simulated_additions=1)


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    tracks = wandering_tracks()
    return synthetic_database([*tracks, tracks[0]._replace(uid="copy_of_clip_000")])


@pytest.fixture(scope="module")
def outside() -> MatchingDatabase:
    return synthetic_database(named([arc_track(1.0, 50.0, 5.0), arc_track(2.0, -50.0, 5.0)], "turn"))


@pytest.fixture(scope="module")
def found(database: MatchingDatabase, outside: MatchingDatabase) -> Suggestions:
    options = FEW.replace(removals=3, blendable_m=3.0)
    return suggest(database, evaluated(database), collections={"turns": outside}, options=options)


def test_every_kind_of_suggestion_is_made(found: Suggestions) -> None:
    assert set(UNWANTED) <= {clip.source for clip in found.unused.clips}
    assert found.unused.ranges
    assert len(found.plan) == 3
    assert found.tried == (len(found.redundant), len(found.redundant))
    assert {(pair.first, pair.second) for pair in found.duplicates.pairs} == {("clip_000", "copy_of_clip_000")}
    assert [source for source, _ in found.spared] == ["copy_of_clip_000"]
    assert {filling.source for filling in found.fillings} <= {"turn_000", "turn_001"}
    assert found.similarity.threshold == 3.0


def test_effects_are_confirmed_in_other_replicates_or_said_not_to_be(found: Suggestions) -> None:
    first, *others = found.additions
    assert first.confirmed is not None
    assert all(step.confirmed is None for step in others)
    tree = suggestions_to_tree(found)
    assert "the mean distance from the path" in tree["additions"][0]["reason"]
    assert all(one["reason"].endswith("Its effect on the trials was not simulated.") for one in tree["additions"][1:])
    for step, planned in zip(found.plan, tree["redundant"]["plan"], strict=True):
        assert step.confirmed is not None
        assert step.confirmed.objective.replicates == 3
        assert planned["confirmed"]["objective"]["verdict"] == step.confirmed.objective.verdict
        assert "was not confirmed" not in planned["reason"]
    assert all("was not confirmed" in clip["reason"] for clip in tree["redundant"]["clips"])
    reason = tree["unused"]["confirmed_clips"]["reason"]
    assert reason.startswith("Without all of this unused data, in other replicates, ")
    assert tree["unused"]["confirmed_ranges"]["objective"]["replicates"] == 3
    assert tree["chance"]["offset_mean"] > 0.0


def test_all_confirmed_effects_are_one_family_in_each_metric(found: Suggestions) -> None:
    assert found.confirmed is not None
    steps = [*(step.confirmed for step in found.plan), *(step.confirmed for step in found.additions)]
    effects = [one for one in (found.confirmed.unused, found.confirmed.ranges, *steps) if one is not None]
    assert len(effects) == 6
    for name in HEADLINES:
        changes = [effect.headlines[name] for effect in effects]
        single = [replace(one, p=_single_probability(one)) for one in changes]
        assert [one.p for one in changes] == pytest.approx([one.p for one in corrected_family(single)])


def _single_probability(one: MetricChange) -> float | None:
    """Compute the uncorrected probability of a change from its interval, which is not corrected."""
    if one.p is None or one.low is None or one.high is None:
        return None
    if one.high == one.low:
        return float(2.0 ** (1 - one.replicates))
    spread = (one.high - one.low) / 2 / stdtrit(one.replicates - 1, 0.975)
    return float(2 * stdtr(one.replicates - 1, -abs(one.change) / spread))


def test_what_another_replicate_shows_is_not_called_unused(database: MatchingDatabase) -> None:
    options = OPTIONS.replace(replicates=3)
    trials = suite_trials(options)
    replicates = run_replicates(database, options, trials)
    assert replicates is not None
    (own,) = (clip for clip in database.clips if clip.uid == UNWANTED[0])
    replicates.usage.popularity[own.start + 5] += 1
    result = assemble(database, options, trials, simulated(database, options), replicates=replicates)
    found = suggest(database, result, options=FEW.replace(removals=0, consider=0, confirmation_replicates=0))
    assert UNWANTED[1] in {clip.source for clip in found.unused.clips}
    assert UNWANTED[0] not in {clip.source for clip in found.unused.clips}
    shown = {result.clips[use.clip].uid for use in result.usage if use.ticks}
    assert not shown & {clip.source for clip in found.unused.clips}


def test_the_threshold_is_the_suites_own_when_none_is_given(database: MatchingDatabase) -> None:
    result = evaluated(database)
    found = suggest(database, result, options=FEW.replace(removals=0, consider=0, confirmation_replicates=0))
    assert found.similarity.threshold == accepted_distance(result.records)
    assert (found.plan, found.redundant, found.fillings) == ((), (), ())


def test_the_document_holds_everything_with_a_reason_and_travels(found: Suggestions) -> None:
    tree = suggestions_to_tree(found)
    listed = json.loads(json.dumps(tree, default=np.ndarray.tolist, allow_nan=False))
    assert listed["schema"] == "marey/suggestions@1"
    lists = (
        listed["unused"]["clips"],
        listed["unused"]["ranges"],
        listed["redundant"]["clips"],
        listed["redundant"]["plan"],
        listed["near_duplicates"]["spared"],
        listed["fillings"],
        listed["additions"],
    )
    for entries in lists:
        assert entries
        for entry in entries:
            assert entry["reason"].endswith(".")
            assert "“" in entry["reason"]
    assert listed["redundant"]["plan"][0]["metrics"] == found.plan[0].metrics


def test_reasons_name_the_clip_and_what_it_does(found: Suggestions) -> None:
    tree = suggestions_to_tree(found)
    unused = {clip["source"]: clip["reason"] for clip in tree["unused"]["clips"]}
    assert "“fast_000”: without this clip (4.0 s), all trials stay exactly the same" in unused["fast_000"]
    assert tree["unused"]["ranges"]
    assert not any("exactly" in part["reason"] for part in tree["unused"]["ranges"])  # it is filtered again at the cut
    (spared,) = tree["near_duplicates"]["spared"]
    assert "nearly the same motion as “clip_000”" in spared["reason"]
    assert "turns contains" in tree["fillings"][0]["reason"]


def effect(*changes_m: float) -> Effect:
    """Return an effect whose changes of the mean distance from the path, by replicate, are given."""
    before, after = np.ones((1, len(changes_m))), 1.0 + np.array([changes_m])
    found = {
        name: repeated(paired_change(name, before, after), before, after - before) for name in (OBJECTIVE, *HEADLINES)
    }
    return Effect(found.pop(OBJECTIVE), found)


SURE = effect(-0.0021, -0.0024, -0.0027, -0.0024)


@pytest.mark.parametrize(
    ("confirmed", "said"),
    [
        (
            effect(0.0, 0.0, 0.0),
            "the mean distance from the path stays the same (another such measurement: +0.00 to +0.00 cm, in 75 of "
            "100 cases or more, because few runs changed).",
        ),
        (
            SURE,
            "the mean distance from the path decreases by 0.24 cm (another such measurement: -0.30 to -0.18 cm, in "
            "95 of 100 cases).",
        ),
        (
            effect(0.01, -0.01, 0.02, -0.02),
            "no effect on the mean distance from the path was found (another such measurement: -4.11 to +4.11 cm, "
            "in 95 of 100 cases).",
        ),
        (
            None,
            "the mean distance from the path seems to change by -1.90 cm, which was not confirmed in other replicates.",
        ),
    ],
)
def test_the_reason_for_a_removal_states_what_was_confirmed_and_not_what_was_estimated(
    confirmed: Effect | None, said: str
) -> None:
    removal = Removal("walk@1", "walk", 2.0, 3, effect(-0.019), 0.0, 0.0)
    assert why_redundant(removal, 9, confirmed) == f"Without “walk” (2.0 s, used in 3 of 9 trials), {said}"


@pytest.mark.parametrize(
    ("turn_rate_deg_s", "where"),
    [(50.0, "turning left at 50°/s"), (-25.0, "turning right at 25°/s"), (0.0, "straight ahead")],
)
def test_the_reason_for_a_filling_says_where_most_of_it_is_missing(turn_rate_deg_s: float, where: str) -> None:
    cells = (FilledCell(1.5, turn_rate_deg_s, 0.9, 1.0), FilledCell(1.0, 0.0, 0.1, 0.5))
    filling = Filling("runs", "a@1", "a", 4.0, cells, 1.0, 0.25, 40, False, 0.25, 0.5)
    assert why_filling(filling) == (
        f"“a” from runs contains 1.0 s of the missing data, the largest part at 1.5 m/s {where}; 25 % of it can be "
        "blended with the set."
    )


def test_suggesting_twice_says_the_same(
    database: MatchingDatabase, outside: MatchingDatabase, found: Suggestions
) -> None:
    again = suggest(database, evaluated(database), collections={"turns": outside}, options=found.options, threads=1)
    first, second = (
        json.dumps(suggestions_to_tree(one), default=np.ndarray.tolist, sort_keys=True) for one in (found, again)
    )
    assert first == second


def test_a_comparison_travels(database: MatchingDatabase) -> None:
    before, after = evaluated(database), evaluated(without_sources(database, ["clip_001"]))
    tree = comparison_to_tree(compare_results(before, after))
    listed = json.loads(json.dumps(tree, default=np.ndarray.tolist, allow_nan=False))
    assert listed["removed"] == ["clip_001"]
    assert {change["metric"] for change in listed["metrics"]} >= {"offset_mean", "abs_se_v"}


def test_an_evaluation_of_another_set_is_refused(database: MatchingDatabase) -> None:
    result = evaluated(database)
    with pytest.raises(MotionError, match="dataset"):
        suggest(without_sources(database, ["clip_001"]), result)
    with pytest.raises(MotionError, match="records"):
        suggest(database, replace(result, records=()))


def test_progress_only_rises_and_the_work_can_be_stopped(database: MatchingDatabase) -> None:
    told, result = [], evaluated(database)
    options = FEW.replace(removals=2)
    suggest(database, result, options=options, progress=lambda *step: told.append(step))
    assert [done for done, _, _ in told] == sorted(done for done, _, _ in told)
    assert told[-1][0] == told[-1][1]
    with pytest.raises(EvaluationCancelled):
        suggest(database, result, options=options, cancelled=lambda: True)


REAL = EvaluationOptions(duration_s=15.0, families=("circle",), replicates=1)


@pytest.fixture(scope="module")
def bandai(mocap: Path) -> tuple[MatchingDatabase, MatchingDatabase]:
    """A database of walks and runs that hardly turn, and a database of turns from another collection.

    Both databases use the body of the first collection.
    """

    def source(path: Path) -> SourceClip:
        motion = read_motion(path.read_bytes(), path.name)
        assert motion.clip is not None
        return SourceClip(path.stem, path.stem, motion.clip)

    straight, turns = (
        [source(path) for path in paths]
        for paths in (
            sorted((mocap / "bandai-namco-1").glob("*.bvh")),
            sorted((mocap / "bandai-namco-2").glob("*turn*.bvh")),
        )
    )
    skeleton = straight[0].clip.skeleton
    body = MatchingBody.from_mapping(skeleton, map_joints(skeleton))
    return build_database(straight, body), build_database(turns, body)


@pytest.fixture(scope="module")
def real(bandai: tuple[MatchingDatabase, MatchingDatabase]) -> Suggestions:
    options = SuggestionOptions(removals=10, consider=12, estimation_replicates=1, confirmation_replicates=0)
    return suggest(bandai[0], evaluated(bandai[0], REAL), collections={"turns": bandai[1]}, options=options)


@pytest.mark.soak
def test_on_real_clips_all_safe_removals_leave_every_record_bit_identical(
    bandai: tuple[MatchingDatabase, MatchingDatabase], real: Suggestions
) -> None:
    database = bandai[0]
    assert len(real.unused.clips) > 5
    assert real.unused.ranges
    less = without_rows(database, real.unused.rows)
    assert same_to_the_bit(database, real.result.records, less, simulated(less, REAL))


@pytest.mark.soak
def test_on_real_clips_ten_removals_do_what_was_predicted(
    bandai: tuple[MatchingDatabase, MatchingDatabase], real: Suggestions
) -> None:
    assert len(real.plan) == 10
    gone = {clip.source for clip in real.unused.clips} | {step.removal.source for step in real.plan}
    again = evaluated(without_sources(bandai[0], gone), REAL)
    assert real.plan[-1].metrics == headline_means(again.trials)


def test_on_real_clips_turns_are_found_for_a_set_that_hardly_turns_and_help_where_predicted(
    bandai: tuple[MatchingDatabase, MatchingDatabase], real: Suggestions
) -> None:
    database, turns = bandai
    assert all("turn" in filling.source for filling in real.fillings[:10])
    chosen = [step.filling.source for step in real.additions]
    union = joined(database, without_sources(turns, [clip.uid for clip in turns.clips if clip.uid not in chosen]))
    after = evaluated(union, REAL)
    assert after.coverage.index == real.additions[-1].coverage_index > real.result.coverage.index
    offsets = [
        np.array([trial.metrics["offset_mean"] for trial in result.trials]).reshape(after.coverage.seconds.shape)
        for result in (real.result, after)
    ]
    filled = (real.result.coverage.deficit_s > 0.0) & (after.coverage.deficit_s == 0.0)
    assert np.count_nonzero(filled) > 10
    assert offsets[1][filled].mean() < 0.8 * offsets[0][filled].mean()
