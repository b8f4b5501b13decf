"""Report of suggestions for a set of clips: what to remove and what to add, why, and what these clips look like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from marey_motion.clip import Clip
from marey_motion.evaluation.improvement import reasons
from marey_motion.evaluation.improvement.duplicates import NearDuplicate
from marey_motion.evaluation.improvement.filling import Filling
from marey_motion.evaluation.improvement.redundancy import Removal
from marey_motion.evaluation.improvement.suggest import Suggestions
from marey_motion.evaluation.improvement.unused import UnusedClip
from marey_motion.evaluation.perceived import indistinguishable
from marey_motion.skeleton import Skeleton
from marey_reports.drawing.drawn import DrawnFigure, Sketch
from marey_reports.drawing.head import ReportHead, ReportInput
from marey_reports.drawing.markup import Html, element
from marey_reports.drawing.page import Section, page, shown
from marey_reports.drawing.strips import PoseRow, draw_even_poses
from marey_reports.drawing.tables import facts
from marey_reports.evaluation.provenance import provenance
from marey_schemas.wording import counted

MOST_DRAWN = 12
"""Greatest number of clips whose poses a chapter shows."""

Poses = Mapping[str, tuple[Clip, ...]]
"""Poses of clips by uid: frames at even intervals, each as a clip of one frame."""


class ShownSuggestion(NamedTuple):
    """One suggestion: its reason, and the clips that it is about, each with its uid and name."""

    reason: str
    clips: tuple[tuple[str, str], ...]


class _Chapter(NamedTuple):
    """Chapter of the page; `about` describes all its suggestions together."""

    name: str
    title: str
    about: str
    suggestions: tuple[ShownSuggestion, ...]


def render_suggestions(found: Suggestions, poses: Poses, *, title: str, inputs: Sequence[ReportInput] = ()) -> str:
    """Render suggestions as an HTML document.

    Parameters
    ----------
    found : the suggestions
    poses : poses of the clips that the suggestions are about; clips without poses are not drawn
    title : heading of the page, such as the path of the evaluation
    inputs : the evaluation and the candidates, for the head
    """
    chapters = [chapter for chapter in _chapters(found) if chapter.suggestions]
    sections = [_section(chapter, poses) for chapter in chapters]
    sections.append(Section("provenance", "Provenance", provenance([found.result], ["value"])))
    said = (
        "Unless a suggestion says otherwise, its effect on the trials was measured in replicates that were not used to "
        "choose it. No clip was changed."
        if chapters
        else "No clip was found that can be removed, or that would fill a gap in the coverage."
    )
    head = ReportHead("Suggestions for a set of clips", title, found.result.provenance.code_version, inputs)
    return page(head, (element("p", said, class_="verdict"), _numbers(found)), sections)


def shown_sources(found: Suggestions) -> set[str]:
    """Return the uids of the clips whose poses the page shows."""
    return {
        uid
        for chapter in _chapters(found)
        for suggestion in chapter.suggestions[:MOST_DRAWN]
        for uid, _ in suggestion.clips
    }


def _numbers(found: Suggestions) -> Html:
    filled = f"{100 * found.additions[-1].coverage_index:.0f} % with the clips to add" if found.additions else ""
    return facts(
        (
            ("Unused clips", str(len(found.unused.clips)), f"{found.unused.seconds:.1f} s with unused ranges"),
            (
                "Further removals",
                str(found.harmless_steps),
                f"{found.tried[0]} of {found.tried[1]} used clips were tried",
            ),
            ("Near-duplicates", str(len(found.spared)), f"within {found.duplicates.threshold_cm:g} cm"),
            ("Coverage", f"{100 * found.result.coverage.index:.0f} %", filled),
        )
    )


def _chapters(found: Suggestions) -> tuple[_Chapter, ...]:
    """Return all chapters in the order of the page, also those without suggestions."""
    look_same = None if found.metric is None else indistinguishable(found.metric)
    confirmed = found.confirmed
    unused = "" if confirmed is None or confirmed.unused is None else reasons.why_unused_again(confirmed.unused)
    ranges = "" if confirmed is None or confirmed.ranges is None else reasons.why_unused_again(confirmed.ranges)
    return (
        _Chapter(
            "unused", "Clips that no trial uses", unused,
            tuple(_about(one, reasons.why_unused_clip(one)) for one in found.unused.clips),
        ),
        _Chapter(
            "ranges", "Ranges that no trial uses", ranges,
            tuple(ShownSuggestion(reasons.why_unused_range(one), ()) for one in found.unused.ranges),
        ),
        *_removals(found),
        _Chapter(
            "duplicates", "Clips with nearly the same motion", "Below each clip stands the one that is like it.",
            tuple(
                ShownSuggestion(reasons.why_duplicate(source, pair, look_same), _both(source, pair))
                for source, pair in found.spared
            ),
        ),
        _Chapter(
            "fillings", "Clips that fill gaps in the coverage", reasons.why_look(found.fillings, found.defects),
            tuple(_about(one, reasons.why_filling(one, found.defects.get(one.source))) for one in found.fillings),
        ),
        _Chapter(
            "additions", "Order in which to add clips", "",
            tuple(
                ShownSuggestion(reasons.why_addition(step, found.defects.get(step.filling.source)), ())
                for step in found.additions
            ),
        ),
    )  # fmt: skip


def _removals(found: Suggestions) -> tuple[_Chapter, _Chapter]:
    """Return the chapters about removals that do not harm, and about those from the first harmful one on."""
    trials = len(found.result.trials)
    steps = tuple(
        _about(step.removal, reasons.why_redundant(step.removal, trials, step.confirmed)) for step in found.plan
    )
    about = "Each effect is measured without all clips above it."
    return (
        _Chapter("removals", "Clips to remove, one after another", about, steps[: found.harmless_steps]),
        _Chapter(
            "costs",
            "What still further removals cost",
            f"From here on, trials depart further from their paths. {about}",
            steps[found.harmless_steps :],
        ),
    )


def _about(clip: UnusedClip | Removal | Filling, reason: str) -> ShownSuggestion:
    return ShownSuggestion(reason, ((clip.source, clip.name),))


def _both(source: str, pair: NearDuplicate) -> tuple[tuple[str, str], ...]:
    """Return the clip to remove, and the clip that stays, each with its name."""
    ends = (pair.first, pair.first_name), (pair.second, pair.second_name)
    return ends if source == pair.first else (ends[1], ends[0])


def _section(chapter: _Chapter, poses: Poses) -> Section:
    suggestions = chapter.suggestions
    body: list[Html] = [element("p", chapter.about)] if chapter.about else []
    body.append(element("ol", [element("li", one.reason) for one in suggestions]))
    if any(one.clips for one in suggestions) and len(suggestions) > MOST_DRAWN:
        body.append(element("p", f"Poses of the first {MOST_DRAWN} of {counted(len(suggestions), 'suggestion')}:"))
    body.extend(_pictures(chapter, poses))
    return Section(chapter.name, chapter.title, tuple(body))


def _pictures(chapter: _Chapter, poses: Poses) -> list[Html]:
    """Draw the clips of the first suggestions: one picture for each skeleton."""
    by_skeleton: dict[Skeleton, list[tuple[str, str]]] = {}
    for suggestion in chapter.suggestions[:MOST_DRAWN]:
        for uid, name in suggestion.clips:
            if uid in poses:
                by_skeleton.setdefault(poses[uid][0].skeleton, []).append((uid, name))
    figures = {
        f"{chapter.name}-{number}": DrawnFigure(_drawn(clips, poses), f"{chapter.name}-{number}", "", chapter.title)
        for number, clips in enumerate(by_skeleton.values())
    }
    return [shown(figures, name) for name in figures]


def _drawn(clips: Sequence[tuple[str, str]], poses: Poses) -> Sketch:
    table: dict[str, object] = {"uid": [uid for uid, _ in clips], "name": [name for _, name in clips]}
    figure = draw_even_poses([PoseRow(name, "", poses[uid]) for uid, name in clips])
    return Sketch(figure, {"clips": table}, "Each body is seen from its front left.")
