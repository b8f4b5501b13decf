"""Report that compares two evaluations of the same trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from marey_motion.evaluation.compare import Comparison, MetricChange, probability
from marey_motion.evaluation.judgement import Judgement, judge, judge_trial
from marey_motion.evaluation.relevance import sum_by_source
from marey_motion.evaluation.result import EvaluationResult, TrialResult
from marey_motion.evaluation.scenario import demand
from marey_reports.drawing.markup import Content, Html, element
from marey_reports.drawing.page import Section, shown
from marey_reports.drawing.tables import MOST_NAMES, Cell, Number, facts, folded, number, table
from marey_reports.evaluation.definitions import METRICS
from marey_reports.evaluation.figures import (
    COVERAGE_FIGURES,
    SCENARIO_FIGURES,
    TRIAL_FIGURES,
    USE_FIGURES,
    DrawnFigure,
)
from marey_schemas.documents.evaluations import CONFIDENCE
from marey_schemas.documents.replicates import LEAST_REPLICATES
from marey_schemas.documents.worst_first import increase, worst_first
from marey_schemas.options.verdict import VerdictLimits
from marey_schemas.wording import counted, listed

Figures = Mapping[str, DrawnFigure]

MOST_TRIALS = 10
LEAST_SHIFT_M = 0.005  # what is written as 0.00 is neither good nor bad


def compared(before: EvaluationResult, after: EvaluationResult, comparison: Comparison | None = None) -> str:
    """Describe in one sentence whether the second evaluation follows more trajectories than the first.

    With `comparison`, the sentence also names the metrics that are better or worse.
    """
    first, second = judge(before), judge(after)
    kept = [{each.outcome.trial.name: each.followed for each in one.trials} for one in (first, second)]
    shared = kept[0].keys() & kept[1].keys()
    gained = sum(kept[1][name] and not kept[0][name] for name in shared)
    lost = sum(kept[0][name] and not kept[1][name] for name in shared)
    start = _direction(before, after)
    old, new = _followed(before, first), _followed(after, second)
    trajectories = counted(len(second.trials), "trajectory")
    parts = [f"the character follows {new} of {trajectories}, {'as before' if new == old else f'{old} before'}"]
    if (gained or lost) and before.replicates is None:
        parts.append(f"{counted(gained, 'trajectory')} gained and {lost} lost")
    offsets = before.suite.get("offset_mean"), after.suite.get("offset_mean")
    if offsets[0] is not None and offsets[1] is not None:
        parts.append(f"it is {offsets[1]:.2f} m from its path on average, {offsets[0]:.2f} m before")
    for verdict in ("better", "worse"):
        changes = () if comparison is None else comparison.metrics
        if names := [METRICS[one.metric].label for one in changes if one.verdict == verdict and one.metric in METRICS]:
            parts.append(f"{verdict} metrics: {listed(names)}")
    return f"{start}: {'; '.join(parts)}."


def _direction(before: EvaluationResult, after: EvaluationResult) -> str:
    """Describe whether the number of followed trajectories changed significantly, by a test of paired replicates."""
    sides = [one.replicates for one in (before, after)]
    followed = [np.count_nonzero(one.followed, axis=0) for one in sides if one is not None]
    if len(followed) < 2 or len(followed[0]) != len(followed[1]):
        return "Unclear, because there are no replicates"
    change = (followed[1] - followed[0]).astype(np.float64)
    if len(change) < LEAST_REPLICATES:
        return "Unclear, because there are too few replicates"
    if not change.any() or probability(change) > 1.0 - CONFIDENCE:
        return "No difference in followed trajectories found"
    return "Better" if change.mean() > 0.0 else "Worse"


def paired(before: EvaluationResult, after: EvaluationResult) -> list[tuple[TrialResult, TrialResult]]:
    """Pair the trials that both evaluations have, in the order of the first evaluation."""
    known = {each.trial.name: each for each in after.trials}
    return [(each, known[each.trial.name]) for each in before.trials if each.trial.name in known]


def headline_of_two(before: EvaluationResult, after: EvaluationResult, labels: tuple[str, str]) -> Html:
    """Make the summary of the most important numbers, old and new."""
    first, second = judge(before), judge(after)
    cells = before.coverage, after.coverage
    sources = [sum_by_source(each.clips, each.usage) for each in (before, after)]
    used = [sum(1 for source in own if source.ticks) for own in sources]
    enough = [f"{each.options.coverage_least_s:g} s" for each in (before, after)]
    return facts(
        (
            (
                "trajectories followed",
                f"{_arrow(_followed(before, first), _followed(after, second))} of {len(second.trials)}",
                " → ".join(labels),
            ),
            ("distance from the path (m)", _arrow(*(_written(each, "offset_mean") for each in (before, after))), ""),
            (
                "speeds and turns covered",
                _arrow(*(f"{100 * each.index:.0f} %" for each in cells)),
                "" if enough[0] == enough[1] else f"not comparable: {enough[0]} and {enough[1]} are required",
            ),
            ("clips used", _arrow(str(used[0]), str(used[1])), f"of {len(sources[0])} and {len(sources[1])}"),
        )
    )


def metric_chapter(
    before: EvaluationResult, after: EvaluationResult, comparison: Comparison | None, labels: tuple[str, str]
) -> Section:
    """Write the chapter on the changes of the metrics over all trials, with confidence intervals if computed."""
    changes = {change.metric: change for change in comparison.metrics} if comparison is not None else {}
    heads = ["measure", *labels, "change", *(["95 % interval", "verdict"] if comparison else []), "unit"]
    rows: list[Sequence[Cell]] = []
    for name, metric in METRICS.items():
        known = changes.get(name)
        old, new = (known.before, known.after) if known else (before.suite.get(name), after.suite.get(name))
        if old is None and new is None:
            continue
        change = known.change if known else new - old if old is not None and new is not None else None
        digits = metric.digits if known is None else max(metric.digits, 1)  # the mean of a count is no whole number
        row: list[Cell] = [metric.label, *(number(value, digits) for value in (old, new))]
        row.append(number(change, digits, signed=True, look=_look(known)))
        if comparison is not None:
            row += [_interval(known, digits), known.verdict if known else ""]
        rows.append([*row, metric.unit])
    text = "Values of the whole suite."
    if comparison is not None:
        text = (
            "Each value is the mean over the trials for which both evaluations define it, also for largest distances "
            "and counts, for which the report of one evaluation shows the maximum and the sum. "
            f"{_about_intervals(before)}"
        )
    listing = table(
        "Metrics of the suite", heads, rows, numbers=(1, 2, 3, 4) if comparison else (1, 2, 3), sortable=False
    )
    return Section("numbers", "Changes of the metrics", (element("p", text), listing))


def trial_chapter(
    before: EvaluationResult, after: EvaluationResult, comparison: Comparison | None, figures: Figures
) -> Section:
    """Write the chapter on the trials that became better or worse, beginning with the one that became worse most."""
    pairs = [(old, new) for old, new in paired(before, after) if old.metrics != new.metrics]
    pairs = worst_first(pairs, lambda pair: _shift(*pair), lambda pair: pair[0].trial.name)
    changed = sum(not each.same_motion for each in comparison.changed) if comparison is not None else len(pairs)
    text = f"The motion of the character changed in {changed:,} of {counted(len(before.trials), 'trial')}"
    text += "." if before.replicates is None else ", in the first replicate; distances are means over all replicates."
    if comparison is not None and (others := len(comparison.changed) - changed):
        text += f" In {counted(others, 'other trial')}, it is the same, but from other clips."
    heads = ("trial", "distance before (m)", "after (m)", "change (m)", "followed before", "after")
    listing: Content = None
    if pairs:
        rows = [_trial_row(old, new, before.options.limits, after.options.limits) for old, new in pairs]
        if len(rows) <= 2 * MOST_TRIALS:
            listing = table("The changed trials, the worst change first", heads, rows, numbers=(1, 2, 3))
        else:
            worst, best = rows[:MOST_TRIALS], rows[: -MOST_TRIALS - 1 : -1]
            everything = table("All changed trials, the worst change first", heads, rows, numbers=(1, 2, 3))
            listing = (
                table(f"The {MOST_TRIALS} worst changes", heads, worst, numbers=(1, 2, 3)),
                table(f"The {MOST_TRIALS} best changes", heads, best, numbers=(1, 2, 3)),
                folded(f"All {len(rows)} changed trials", everything),
            )
    pictures = shown(figures, "offsets", *SCENARIO_FIGURES, *TRIAL_FIGURES)
    return Section("trials", "Changed trials", (element("p", text), listing, pictures))


def clip_chapter(before: EvaluationResult, after: EvaluationResult, figures: Figures) -> Section:
    """Write the chapter on clips that were added or removed, or that are used in only one of the evaluations."""
    names = {clip.uid: clip.name for result in (after, before) for clip in result.clips}
    held = [{clip.uid for clip in result.clips} for result in (before, after)]
    used = [{result.clips[usage.clip].uid for usage in result.usage if usage.ticks} for result in (before, after)]
    lists = (
        ("Added clips", held[1] - held[0]),
        ("Removed clips", held[0] - held[1]),
        ("Clips no longer used", (used[0] - used[1]) & held[1]),
        ("Clips newly used", (used[1] - used[0]) & held[0]),
    )
    content = [_names(title, sorted(uids), names) for title, uids in lists if uids]
    if not content:
        content = [element("p", "Both evaluations have the same clips and use the same clips.")]
    return Section("clips", "Clips", (content, shown(figures, *USE_FIGURES)))


def coverage_of_two_chapter(figures: Figures) -> Section:
    """Write the chapter on the change of coverage."""
    return Section("coverage", "Coverage", shown(figures, *COVERAGE_FIGURES))


def _names(title: str, uids: Sequence[str], names: Mapping[str, str]) -> Html:
    listing = element("ul", [element("li", element("span", names[uid], title=uid)) for uid in uids], class_="names")
    heading = f"{title} ({len(uids)})"
    return folded(heading, listing) if len(uids) > MOST_NAMES else element("div", element("h3", heading), listing)


def _trial_row(old: TrialResult, new: TrialResult, *limits: VerdictLimits) -> list[Cell]:
    offsets = [each.metrics.get("offset_mean") for each in (old, new)]
    shift = _shift(old, new)
    look = "" if shift is None or abs(shift) < LEAST_SHIFT_M else "good" if shift < 0.0 else "bad"
    return [
        element("span", demand(old.trial), title=old.trial.name),
        *(number(offset) for offset in offsets),
        number(shift, signed=True, look=look),
        *("yes" if judge_trial(each, own).followed else "no" for each, own in zip((old, new), limits, strict=True)),
    ]


def _shift(old: TrialResult, new: TrialResult) -> float | None:
    """Compute the change of a trial's mean offset in metres; None if one of the two offsets is not defined."""
    return increase(old.metrics.get("offset_mean"), new.metrics.get("offset_mean"))


def _interval(change: MetricChange | None, digits: int) -> Number:
    if change is None or change.low is None or change.high is None:
        return Number(None, "–")
    low, high = (number(bound, digits, signed=True).written for bound in (change.low, change.high))
    return Number(change.low, f"{low} to {high}")


def _about_intervals(result: EvaluationResult) -> str:
    replicates = result.options.replicates
    if replicates < LEAST_REPLICATES:
        return (
            f"The evaluations have {counted(replicates, 'replicate')}, so it is unknown which changes are chance. "
            f"Evaluate with at least {LEAST_REPLICATES} replicates to know."
        )
    return (
        f"The 95 % confidence intervals are those of the mean changes in {replicates} replicates. “Better”, “worse” "
        "and “changed” are corrected for the number of metrics: by chance alone, about one of twenty comparisons has "
        "a “better” or “worse”, and as many have a “changed”."
    )


def _look(change: MetricChange | None) -> str:
    verdict = change.verdict if change is not None else ""
    return {"better": "good", "worse": "bad"}.get(verdict, "")


def _followed(result: EvaluationResult, judgement: Judgement) -> str:
    """Return the number of followed trajectories, as the mean over the replicates if there are any."""
    if result.replicates is None:
        return str(judgement.followed)
    return f"{np.count_nonzero(result.replicates.followed, axis=0).mean():.1f}".removesuffix(".0")


def _arrow(old: str, new: str) -> str:
    return f"{old} → {new}"


def _written(result: EvaluationResult, name: str) -> str:
    value = result.suite.get(name)
    return "–" if value is None else f"{value:.{METRICS[name].digits}f}"
