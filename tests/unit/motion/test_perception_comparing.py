"""Perceptual distances of sets of clips, and of evaluated rows; alignment by a metric."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marey_motion.alignment.aligning import SourceExample, align_clips
from marey_motion.alignment.dtw import align, align_cyclic
from marey_motion.clip import Clip
from marey_motion.errors import MotionError
from marey_motion.evaluation.improvement.duplicates import NearDuplicates, find_near_duplicates, spared_sources
from marey_motion.evaluation.perceived import PerceivedRows, indistinguishable, require_same_metric
from marey_motion.formats import read_motion
from marey_motion.gait import game_skeleton, generate_gait
from marey_motion.matching.body import MatchingBody
from marey_motion.matching.building import build_database
from marey_motion.matching.database import MatchingDatabase, SourceClip
from marey_motion.perception import comparing
from marey_motion.perception.comparing import ClipDistances, ComparableClip, compare_clips, prepare_comparison
from marey_motion.perception.maps import paired_distances
from marey_motion.perception.metric import metric_of
from marey_motion.perception.registration import clip_distance
from marey_motion.retargeting import plan_retarget, retarget
from marey_motion.rigs import guess_axes, map_joints
from marey_reports.perception.compared import ComparedClip, ComparedSet
from marey_reports.perception.page import draw_distance_figures, render_distances
from marey_schemas.documents.metrics import (
    MetricComponent,
    MetricDocument,
    MetricFit,
    MetricIdentity,
    built_in_metric,
    built_in_names,
)
from marey_schemas.options.alignment import AlignOptions
from marey_schemas.options.matching import DatabaseOptions
from marey_schemas.options.perception import DistanceOptions

PAPER = built_in_metric("published/positions-sigmoid")
METRIC = metric_of(PAPER)


@cache
def gaits() -> tuple[Clip, ...]:
    return tuple(generate_gait(speed, 0.0, 4.0) for speed in (1.1, 1.5, 1.6))


def body_of(clip: Clip) -> MatchingBody:
    return MatchingBody.from_mapping(clip.skeleton, map_joints(clip.skeleton))


def comparable(clip: Clip, **options: Any) -> ComparableClip:
    return prepare_comparison(clip, body_of(clip), METRIC, 60.0, name="clip", **options)


def compared_set(
    metric: MetricDocument, clips: list[ComparableClip], found: ClipDistances, options: DistanceOptions
) -> ComparedSet:
    return ComparedSet(metric, list(map(ComparedClip.of, clips)), dict(enumerate(clips)), found, options)


def test_every_built_in_metric_is_one_of_its_own_and_knows_its_origin() -> None:
    metrics = [built_in_metric(name) for name in built_in_names()]
    assert len({one.identity_digest() for one in metrics}) == len(metrics) == 24
    for one in metrics:
        assert MetricDocument.model_validate(one.stored()) == one
        assert metric_of(one).shares == tuple(part.share for part in one.components)
    renamed = PAPER.model_copy(update={"name": "ours", "notes": ("a note",)})
    assert MetricIdentity.of(renamed).digest == PAPER.identity_digest()
    with pytest.raises(KeyError):
        built_in_metric("published/power")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"components": PAPER.components * 2}, "same measurement"),
        ({"components": (PAPER.components[0].model_copy(update={"share": 0.5}),)}, "the shares have the sum 0.5"),
        ({"frame_rate_hz": 0.0}, "frame_rate_hz"),
    ],
)
def test_a_metric_that_makes_no_sense_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MetricDocument(**(dict(PAPER) | changes))
    with pytest.raises(ValueError, match="no weight for the joint class hand"):
        MetricComponent(measurement="angles", shaping="euclid", constant=0, norm=1, weights={"hand": 1.0}, share=1)


def test_a_metric_of_another_version_of_the_code_is_refused() -> None:
    with pytest.raises(MotionError, match="fit the metric again") as refused:
        metric_of(PAPER.model_copy(update={"code_version": "perceptual-metric@0"}))
    assert refused.value.code == "metric-of-other-version"


def test_a_table_has_the_distances_of_the_pairs_and_nearer_speeds_are_nearer() -> None:
    clips = [comparable(gait).compared for gait in gaits()]
    found = compare_clips(clips, METRIC, threads=2)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert found.totals[i, j] == found.totals[j, i] == clip_distance(clips[i], clips[j], METRIC).total
    assert found.pairs_by_distance().tolist() == [[1, 2], [0, 1], [0, 2]]
    assert (np.diag(found.totals) == 0).all()
    np.testing.assert_allclose(found.by_component[0], found.totals)


def test_progress_counts_the_pairs_that_are_done() -> None:
    clips, seen = [comparable(gait).compared for gait in gaits()], []
    compare_clips(clips, METRIC, progress=lambda done, total, _note: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_loops_are_cut_once_and_whole_clips_are_kept() -> None:
    (gait, *_) = gaits()
    cut = comparable(gait)
    assert cut.period is not None
    assert (cut.compared.cyclic, cut.compared.frame_count) == (True, cut.period.frames)
    whole = comparable(gait, cycles="whole")
    assert (whole.period, whole.compared.cyclic, whole.compared.frame_count) == (None, False, gait.frame_count)
    again = comparable(cut.motion.as_clip(gait.skeleton, 60.0), loop=True)
    assert (again.period, again.compared.cyclic) == (None, True)
    assert clip_distance(again.compared, cut.compared, METRIC).total < 0.1


def test_what_is_too_long_is_refused_before_it_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    (gait, *_) = gaits()
    clip = comparable(gait).compared
    monkeypatch.setattr(comparing, "MOST_TABLE_CELLS", 10)
    with pytest.raises(MotionError, match="compare fewer or shorter clips"):
        compare_clips([clip, clip], METRIC)
    monkeypatch.setattr(comparing, "MOST_COMPARED_FRAMES", 100)
    with pytest.raises(MotionError, match="cut it first"):
        comparable(gait)


def test_whole_clips_of_different_lengths_are_drawn_at_one_rate_or_refused() -> None:
    long, (gait, *_) = comparable(generate_gait(1.2, 0.0, 21.0), cycles="whole"), gaits()
    short = comparable(generate_gait(1.2, 0.0, 15.0), cycles="whole")
    clips = [long, short]
    found = compare_clips([clip.compared for clip in clips], METRIC)
    subject = compared_set(PAPER, clips, found, DistanceOptions(cycles="whole"))
    arrays = subject.arrays((0, 1))
    assert (arrays["combined"].shape, float(arrays["map_rate_hz"])) == ((630, 450), 30.0)
    assert set(draw_distance_figures(subject)) == {"registration"}
    assert any("Whole clips" in claim for claim in subject.claims())
    with pytest.raises(MotionError, match="clips 1 and 2 have 1260 and 240 frames"):
        compare_clips([long.compared, comparable(gait, cycles="whole").compared], METRIC)


@pytest.mark.parametrize(("name", "columns"), [("published/positions-sigmoid", 0), ("published/manhattan", 3)])
def test_a_report_lists_all_pairs_and_parts_only_of_metrics_with_several(name: str, columns: int) -> None:
    document = built_in_metric(name)
    metric = metric_of(document)
    clips = [prepare_comparison(gait, body_of(gait), metric, 60.0, name=f"<{at}>") for at, gait in enumerate(gaits())]
    found = compare_clips([clip.compared for clip in clips], metric)
    subject = compared_set(document, clips, found, DistanceOptions())
    figures = draw_distance_figures(subject)
    assert ("nearest-components" in figures) == (columns > 0)
    page = render_distances(subject, figures, title="Gaits <of> mine")
    assert "Gaits &lt;of&gt; mine" in page
    listed = page.partition("Pairs, the nearest first")[2].partition("</table>")[0]
    assert [one in listed for one in ("angles", "positions", "velocities")] == [columns > 0] * 3
    assert listed.index("&lt;1&gt; – &lt;2&gt;") < listed.index("&lt;0&gt; – &lt;2&gt;")
    assert "Of 3 clips" in page


def test_a_person_who_stands_first_gives_a_loop_of_walking() -> None:
    (gait, *_) = gaits()
    still = np.concatenate((np.zeros(150, np.int64), np.arange(gait.frame_count)))
    translations = None if gait.translations is None else gait.translations[still]
    stood = replace(gait, poses=gait.poses[still], translations=translations)
    cut = comparable(stood)
    assert cut.period is not None
    assert cut.period.start >= 140
    assert clip_distance(cut.compared, comparable(gait).compared, METRIC).total < 0.2


def test_the_best_cyclic_shift_is_that_of_trying_all() -> None:
    costs = np.random.default_rng(3).random((9, 11)) ** 2
    tried = [align(np.roll(costs, -shift, axis=1), max_run=3) for shift in range(11)]
    means = [one.total / len(one.path) for one in tried]
    found, shift = align_cyclic(costs, max_run=3)
    assert shift == int(np.argmin(means))
    assert found.total == tried[shift].total
    np.testing.assert_array_equal(found.path, tried[shift].path)
    with pytest.raises(MotionError, match="cannot be aligned"):
        align_cyclic(np.ones((2, 30)), max_run=3)


def test_alignment_by_a_metric_needs_no_weights_and_changes_nothing_without_one() -> None:
    examples = [SourceExample(f"{n}@1", str(n), gait.sliced(0, 60)) for n, gait in enumerate(gaits())]
    body = body_of(gaits()[0])
    plain = align_clips(examples, body, AlignOptions(reference="0@1"))
    seen = align_clips(examples, body, AlignOptions(reference="0@1"), metric=METRIC)
    assert all(one.cost > 0 for one in seen.clips[1:])
    assert [one.cost for one in seen.clips] != [one.cost for one in plain.clips]
    assert seen.clips[0].cost == 0.0
    assert (np.diff(seen.clips[1].time_function) > 0).all()
    with pytest.raises(MotionError, match="replaces the options cost, window and weights"):
        align_clips(examples, body, AlignOptions(weights={"Hips": 1.0}), metric=METRIC)


def database_of(clips: dict[str, Clip]) -> MatchingDatabase:
    first = next(iter(clips.values()))
    sources = [SourceClip(name, name, clip) for name, clip in clips.items()]
    return build_database(sources, body_of(first), DatabaseOptions())


def test_a_jump_to_the_frame_that_would_have_followed_is_not_seen() -> None:
    database = database_of({"a@1": gaits()[0], "b@1": gaits()[1]})
    rows = PerceivedRows(database, PAPER)
    start = database.clips[1].start
    seamless = rows.transitions(np.array([[10, 11, 4]]))
    assert (seamless.transitions, seamless.mean, seamless.p95) == (4, 0.0, 0.0)
    seen = rows.transitions(np.array([[10, 11, 1], [10, start + 40, 1]]))
    assert seen.p95 is not None
    assert seen.p95 > 0.1
    none = rows.transitions(np.empty((0, 3), np.int64))
    assert (none.transitions, none.median) == (0, None)
    require_same_metric(seen, none)
    require_same_metric(seen, None)
    other = PerceivedRows(database, built_in_metric("uniform/manhattan")).transitions(np.array([[10, 11, 1]]))
    with pytest.raises(
        MotionError, match=r"\(published/positions-sigmoid and uniform/manhattan\).* project/folder/name"
    ):
        require_same_metric(seen, other)
    with pytest.raises(MotionError, match="both called published/positions-sigmoid"):
        require_same_metric(seen, replace(other, metric=seen.metric))
    with pytest.raises(MotionError, match="same rate"):
        PerceivedRows(database, PAPER.model_copy(update={"frame_rate_hz": 30.0}))


def test_near_duplicates_that_look_different_are_kept() -> None:
    slow, *_ = gaits()
    shifted = generate_gait(1.12, 0.0, 4.0)
    database = database_of({"a@1": slow, "b@1": slow, "c@1": shifted})
    seen = find_near_duplicates(database, threshold_cm=30.0, perceived_rows=PerceivedRows(database, PAPER))
    by_pair = {(pair.first, pair.second): pair.perceived for pair in seen.pairs}
    assert by_pair["a@1", "b@1"] == 0.0
    others = [distance for pair, distance in by_pair.items() if "c@1" in pair]
    assert others
    assert min(float(one or 0) for one in others) > 0.059
    strict = spared_sources(database, seen, {}, most_perceived=0.0)
    assert [source for source, _ in strict] == ["b@1"]
    plain = find_near_duplicates(database, threshold_cm=30.0)
    assert plain == NearDuplicates(tuple(replace(one, perceived=None) for one in seen.pairs), 30.0, seen.aligned,
                                   seen.compared)  # fmt: skip


def test_what_people_do_not_distinguish_comes_from_the_judgements() -> None:
    assert indistinguishable(PAPER) == pytest.approx(0.059 + 0.1)
    fit = MetricFit(motions=21, participants=10, trials=630, pairs=210, rmse=0.1, noise_ceiling=0.08)
    ours = PAPER.model_copy(update={"origin": "fitted", "fit": fit})
    assert indistinguishable(ours) == pytest.approx(0.059 + 0.16)


REAL = (
    "bandai-namco-1/dataset-1_walk_normal_001.bvh", "bandai-namco-1/dataset-1_walk_tired_001.bvh",
    "cmu-amc/16/16_15.amc", "cmu-amc/16/16_31.amc",
)  # fmt: skip


def test_loops_of_real_walks_have_no_seam_and_walks_of_one_person_are_nearest(mocap: Path) -> None:
    target = game_skeleton()
    mapping = map_joints(target)
    body, axes = MatchingBody.from_mapping(target, mapping), guess_axes(target, mapping)
    clips = []
    for name in REAL:
        file = mocap / name
        asf = file.parent / f"{file.parent.name}.asf"
        companion = asf.read_bytes() if file.suffix == ".amc" else None
        clip = read_motion(file.read_bytes(), file.name, companion=companion).clip
        assert clip is not None
        own = map_joints(clip.skeleton)
        plan = plan_retarget(clip.skeleton, own, guess_axes(clip.skeleton, own), target, mapping, axes)
        made = prepare_comparison(retarget(clip, plan), body, METRIC, 60.0, name=name)
        assert made.period is not None
        assert 1.0 < made.period.frames / 60.0 < 1.3
        steps = paired_distances(made.compared, made.compared.at(np.arange(1.0, made.period.frames + 1.0)), METRIC)
        assert steps[-1] <= 1.5 * np.quantile(steps, 0.9)
        clips.append(made.compared)
    totals = compare_clips(clips, METRIC).totals
    assert int(np.argmin(totals + np.eye(4) * 9)) == 2 * 4 + 3
    assert totals[2, 3] < 0.5 * totals[:2, 2:].min()
