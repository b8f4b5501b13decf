"""Comparisons of evaluations of real walks: how often chance looks like a change, and how often changes are found."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.support.real_takes import body_of, read_takes

from marey_motion.evaluation.compare import MetricChange, corrected, paired_change
from marey_motion.evaluation.relevance import sum_by_source
from marey_motion.evaluation.replicates import run_replicates
from marey_motion.evaluation.result import EvaluationResult, ReplicateValues
from marey_motion.evaluation.scenario import suite_trials
from marey_motion.evaluation.suite import assemble, run_suite
from marey_motion.matching.building import build_database, with_normaliser
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_schemas.options.evaluation import EvaluationOptions

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1800)]

FAMILIES = {"judged": {"better", "worse"}, "others": {"changed"}}
"""Families of metrics, with the verdicts that their changes can have."""
COMPARISONS, REPLICATES = 1000, 8
POOL = 48
"""Number of simulated replicates, from which the replicates of each comparison are drawn."""
OPTIONS = EvaluationOptions(
    speeds_m_s=(1.0, 1.5, 2.5), turn_rates_deg_s=(-75.0, -25.0, 0.0, 50.0), duration_s=8.0, switch_every_s=3.0
)
TURNS = frozenset(
    f"16_{number}" for number in (11, 12, 13, 17, 19, 23, 25, 26, 27, 29, 37, 39, 40, 41, 43, 48, 49, 51, 53)
)
"""Takes of subject 16 that turn or veer."""


@pytest.fixture(scope="module")
def walks(mocap: Path) -> list[SourceClip]:
    return [take for take in read_takes(mocap, "cmu-amc/16/*") if take.clip.frame_count > 60]


def built(takes: Sequence[SourceClip]) -> MatchingDatabase:
    return build_database(takes, body_of(takes[0].clip))


def evaluated(database: MatchingDatabase, count: int) -> EvaluationResult:
    options = OPTIONS.replace(replicates=count)
    trials = suite_trials(options)
    replicates = run_replicates(database, options, trials)
    return assemble(database, options, trials, run_suite(database, options), replicates=replicates)


@pytest.fixture(scope="module")
def base(walks: list[SourceClip]) -> tuple[MatchingDatabase, EvaluationResult]:
    database = built(walks)
    return database, evaluated(database, POOL)


def changes(before: ReplicateValues, after: ReplicateValues, some: Sequence[int], others: Sequence[int]) -> set[str]:
    """Return the families in which replicates of two evaluations differ by a verdict."""
    found: list[MetricChange] = []
    for metric in sorted({*before.names} & {*after.names}):
        first, second = before.of_trials(metric)[:, some], after.of_trials(metric)[:, others]
        if np.any(np.isfinite(first) & np.isfinite(second)):
            found.append(paired_change(metric, first, second))
    told = {one.verdict for one in corrected(found)}
    return {family for family, verdicts in FAMILIES.items() if told & verdicts}


def test_chance_rarely_looks_like_a_change(base: tuple[MatchingDatabase, EvaluationResult]) -> None:
    """Both sides have the same clips; only the start and the length of the approach differ."""
    values = base[1].replicates
    assert values is not None
    random, counts = np.random.default_rng(0), dict.fromkeys(FAMILIES, 0)
    for _ in range(COMPARISONS):
        drawn = random.permutation(np.arange(1, POOL))[: 2 * REPLICATES].tolist()
        for family in changes(values, values, drawn[:REPLICATES], drawn[REPLICATES:]):
            counts[family] += 1
    print(f"false verdicts in {COMPARISONS} comparisons: {counts}")
    assert max(counts.values()) <= 0.05 * COMPARISONS


def test_planted_changes_are_found(walks: list[SourceClip], base: tuple[MatchingDatabase, EvaluationResult]) -> None:
    database, result = base
    sources = sum_by_source(result.clips, result.usage)
    fifth = min(sources, key=lambda source: abs(source.share - 0.2))
    planted = {
        "a clip is removed": [take for take in walks if take.uid != fifth.uid],
        "turns are removed": [take for take in walks if take.name not in TURNS],
        "clips are faster": [
            replace(take, clip=replace(take.clip, frame_rate_hz=1.2 * take.clip.frame_rate_hz)) for take in walks
        ],
    }
    before = result.replicates
    assert before is not None
    random = np.random.default_rng(1)
    shares = {}
    for name, takes in planted.items():
        after = evaluated(with_normaliser(built(takes), database.normaliser), 24).replicates
        assert after is not None
        found = 0
        for _ in range(50):
            drawn = random.choice(np.arange(1, 24), REPLICATES, replace=False).tolist()
            found += bool(changes(before, after, drawn, drawn))
        shares[name] = found / 50
    print(f"share of the displayed frames of the removed clip: {fifth.share:.2f}; found: {shares}")
    assert min(shares.values()) >= 0.9
