"""The report of suggestions: each suggestion with its reason, and poses of its clips."""

from dataclasses import replace

import pytest
from tests.support.report_pages import is_sound
from tests.support.suggestion_cases import evaluated, named, wandering_tracks
from tests.support.synthetic_databases import arc_track, synthetic_database

from marey_motion.clip import Clip
from marey_motion.evaluation.improvement import reasons
from marey_motion.evaluation.improvement.suggest import Suggestions, suggest
from marey_motion.evaluation.improvement.suggestion_documents import suggestions_to_tree
from marey_motion.gait import generate_gait
from marey_reports.drawing.strips import even_frames
from marey_reports.evaluation.suggestions import MOST_DRAWN, Poses, render_suggestions, shown_sources
from marey_schemas.options.improvement import SuggestionOptions


@pytest.fixture(scope="module")
def found() -> Suggestions:
    tracks = wandering_tracks()
    database = synthetic_database([*tracks, tracks[0]._replace(uid="copy_of_clip_000")])
    outside = synthetic_database(named([arc_track(1.0, 50.0, 5.0), arc_track(2.0, -50.0, 5.0)], "turn"))
    options = SuggestionOptions(
        estimation_replicates=2, confirmation_replicates=3, simulated_additions=1, removals=2, blendable_m=3.0
    )
    return suggest(database, evaluated(database), collections={"turns": outside}, options=options)


def poses_of(clip: Clip) -> tuple[Clip, ...]:
    return tuple(clip.sliced(frame, frame + 1) for frame in even_frames(clip.frame_count))


@pytest.fixture(scope="module")
def poses(found: Suggestions) -> Poses:
    """Poses of all clips that the page shows; those of the candidates have a skeleton of their own."""
    small, tall = (poses_of(generate_gait(1.3, 0.2, 1.0, stature_m=height)) for height in (1.5, 1.9))
    return {uid: tall if uid.startswith("turn") else small for uid in shown_sources(found)}


def test_every_suggestion_is_on_the_page_with_its_reason(found: Suggestions, poses: Poses) -> None:
    page = is_sound(render_suggestions(found, poses, title="lab/walks-eval"))
    trials = len(found.result.trials)
    expected = [
        *map(reasons.why_unused_clip, found.unused.clips),
        *map(reasons.why_unused_range, found.unused.ranges),
        *(reasons.why_redundant(step.removal, trials, step.confirmed) for step in found.plan),
        *(reasons.why_duplicate(source, pair) for source, pair in found.spared),
        *map(reasons.why_filling, found.fillings),
        *map(reasons.why_addition, found.additions),
    ]
    assert len(expected) > 6
    assert [reason for reason in expected if reason not in page.text] == []
    assert f"Coverage {100 * found.result.coverage.index:.0f} %" in page.text


def test_removals_after_which_trials_depart_further_are_not_called_clips_to_remove(
    found: Suggestions, poses: Poses
) -> None:
    first, second = found.plan
    assert first.confirmed is not None
    change = replace(first.confirmed.headlines["offset_mean"], change=0.03, low=0.02, high=0.04, p=1e-6)
    worse = replace(first.confirmed, headlines={**first.confirmed.headlines, "offset_mean": change})
    assert change.verdict == "worse"
    for plan, harmless in (((first, second), 2), ((first, replace(second, confirmed=worse)), 1)):
        changed = replace(found, plan=plan)
        assert changed.harmless_steps == harmless
        page = is_sound(render_suggestions(changed, poses, title="lab/walks-eval"))
        _, *parts = page.text.split("What still further removals cost")  # in the contents, and as a heading
        listed = parts[0] if parts else page.text
        trials = len(found.result.trials)
        texts = [reasons.why_redundant(step.removal, trials, step.confirmed) for step in plan]
        assert [text in listed for text in texts] == [number < harmless for number in range(2)]
    tree = suggestions_to_tree(changed)
    assert tree["redundant"]["harmless_steps"] == 1


def test_the_clips_of_the_first_suggestions_are_drawn_and_the_twin_of_a_duplicate_too(found: Suggestions) -> None:
    drawn = shown_sources(found)
    assert {step.removal.source for step in found.plan} <= drawn
    assert {"clip_000", "copy_of_clip_000"} <= drawn
    assert {one.source for one in found.fillings[:MOST_DRAWN]} <= drawn


def test_of_many_suggestions_the_first_are_drawn_and_the_page_says_so(found: Suggestions, poses: Poses) -> None:
    clip = found.unused.clips[0]
    many = tuple(replace(clip, source=f"c{n}", name=f"clip {n}") for n in range(MOST_DRAWN + 3))
    found = replace(found, unused=replace(found.unused, clips=many))
    assert {f"c{n}" for n in range(MOST_DRAWN + 3)} & shown_sources(found) == {f"c{n}" for n in range(MOST_DRAWN)}
    page = is_sound(render_suggestions(found, {**poses, "c0": next(iter(poses.values()))}, title="t"))
    assert f"Poses of the first {MOST_DRAWN} of {MOST_DRAWN + 3} suggestions" in page.text


def test_a_set_that_needs_no_change_has_a_page_that_says_so(found: Suggestions) -> None:
    nothing = replace(
        found,
        unused=replace(found.unused, clips=(), ranges=()),
        plan=(),
        spared=(),
        fillings=(),
        additions=(),
    )
    page = is_sound(render_suggestions(nothing, {}, title="t"))
    assert "No clip was found that can be removed" in page.text
    assert shown_sources(nothing) == set()
