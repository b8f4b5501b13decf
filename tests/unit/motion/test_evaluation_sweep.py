"""Evaluations with varied weights: results equal the results of a database that was built with these weights.

Groups are ranked by effect.
"""

from math import radians
from typing import Any

import numpy as np
import pytest
from tests.support.suggestion_cases import OPTIONS, evaluated

from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement import sweep
from marey_motion.evaluation.improvement.objective import objective_value
from marey_motion.evaluation.improvement.resimulation import Resimulation
from marey_motion.evaluation.improvement.sweep import (
    GROUPS,
    SweepRow,
    group_influences,
    reweighted,
    sweep_weights,
    vary_each_group,
)
from marey_motion.evaluation.pooling import pooled_metrics
from marey_motion.evaluation.running import EvaluationCancelled
from marey_motion.gait import generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.rigs import map_joints
from marey_schemas.options.improvement import ObjectiveOptions, SweepOptions
from marey_schemas.options.matching import DatabaseOptions, FeatureWeights


def walks(weights: FeatureWeights | None = None) -> MatchingDatabase:
    clips = [
        SourceClip(f"walk_{speed}_{turn}", "walk", generate_gait(speed, radians(turn), 3.0))
        for speed in (1.0, 2.0)
        for turn in (-50, 0, 50)
    ]
    skeleton = clips[0].clip.skeleton
    body = MatchingBody.from_mapping(skeleton, map_joints(skeleton))
    return build_database(clips, body, DatabaseOptions(weights=weights or FeatureWeights()))


@pytest.fixture(scope="module")
def database() -> MatchingDatabase:
    return walks()


ONCE = SweepOptions(estimation_replicates=1, confirmation_replicates=0)
OTHER = FeatureWeights(trajectory_directions=0.3, hip_velocity=2.0, left_foot_position=1.1)


def test_other_weights_are_those_of_a_database_built_with_them(database: MatchingDatabase) -> None:
    built, changed = walks(OTHER), reweighted(database, OTHER)
    assert np.allclose(changed.normaliser.scale, built.normaliser.scale, rtol=1e-14)
    assert np.array_equal(changed.features, built.features)
    assert changed.options == built.options


def test_a_group_without_weight_plays_no_part_and_cannot_be_brought_back(database: MatchingDatabase) -> None:
    silent = reweighted(database, FeatureWeights(hip_velocity=0.0))
    own = next(group for group in silent.layout.groups if group.name == "hip_velocity")
    assert np.abs(silent.normaliser.apply(silent.features)[:, own.start : own.stop]).max() < 1e-12
    with pytest.raises(MotionError, match="hip_velocity"):
        reweighted(silent, FeatureWeights())


def test_each_row_of_a_sweep_is_an_evaluation_with_these_weights(database: MatchingDatabase) -> None:
    rows = sweep_weights(database, OPTIONS, [FeatureWeights(), OTHER], how=ONCE)
    for row in rows:
        result = evaluated(reweighted(database, row.weights))
        assert row.metrics == pooled_metrics(result.trials)
        assert row.objective == objective_value(ObjectiveOptions(), result.trials, 0.0)
    assert rows[0].objective != rows[1].objective


def test_a_sweep_without_confirmations_builds_no_simulation_for_them(
    database: MatchingDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = []

    def build(*given: Any, replicates: range, **options: Any) -> Resimulation:
        built.append(replicates)
        return Resimulation(*given, replicates=replicates, **options)

    monkeypatch.setattr(sweep, "Resimulation", build)
    (row,) = sweep_weights(database, OPTIONS, [OTHER], how=ONCE)
    assert (row.confirming, built) == ((), [range(1)])


def test_each_group_is_varied_alone() -> None:
    settings = vary_each_group(DatabaseOptions(), (0.5, 4.0))
    assert len(settings) == 1 + 2 * (len(GROUPS) - 1)
    assert {setting.extra_joints for setting in settings} == {1.0}
    assert len(vary_each_group(DatabaseOptions(extra_joints=("head",)), (0.5, 4.0))) == 1 + 2 * len(GROUPS)
    assert settings[0] == FeatureWeights()
    for setting in settings[1:]:
        different = [group for group in GROUPS if getattr(setting, group) != getattr(FeatureWeights(), group)]
        assert len(different) == 1


def test_the_group_whose_weight_changes_most_is_the_most_influential() -> None:
    base = FeatureWeights()

    def row(objective: float, **weights: Any) -> SweepRow:
        return SweepRow(base.replace(**weights), {}, {}, objective)

    found = group_influences(
        [
            row(1.0),
            row(1.1, hip_velocity=2.0),
            row(0.9, hip_velocity=0.5),
            row(1.5, trajectory_positions=0.5),
            row(0.2, trajectory_positions=2.0, hip_velocity=2.0),
        ]
    )
    assert [influence.group for influence in found] == ["trajectory_positions", "hip_velocity"]
    assert found[1].spread == pytest.approx(0.2)
    assert (found[1].best_weight, found[0].best_weight) == (0.5, 1.0)
    assert found[1].gain == pytest.approx(0.1)
    assert found[0].gain == 0.0


def test_a_sweep_tells_its_progress_and_can_be_stopped(database: MatchingDatabase) -> None:
    reported = []
    sweep_weights(
        database, OPTIONS, [FeatureWeights(), OTHER], how=ONCE, progress=lambda *step: reported.append(step[:2])
    )
    assert reported[-1] == (12, 12)
    assert [done for done, _ in reported] == sorted(done for done, _ in reported)
    with pytest.raises(EvaluationCancelled):
        sweep_weights(database, OPTIONS, [OTHER], how=ONCE, cancelled=lambda: True)
