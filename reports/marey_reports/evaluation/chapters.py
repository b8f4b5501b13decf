"""The chapters of the report of one evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from marey_motion.evaluation.judgement import LimitCheck, Measure, TrialVerdict, exceeded_in_suite, judge
from marey_motion.evaluation.relevance import SourceUsage, recorded_rows, sum_by_source
from marey_motion.evaluation.result import EvaluationResult, ReplicateValues
from marey_motion.evaluation.scenario import demand
from marey_reports.drawing.markup import Content, Html, coded, element, joined
from marey_reports.drawing.page import Section, shown
from marey_reports.drawing.tables import MOST_NAMES, Cell, Number, facts, folded, number, share, table
from marey_reports.drawing.words import duration
from marey_reports.evaluation.definitions import METRICS
from marey_reports.evaluation.figures import (
    COVERAGE_FIGURES,
    SCENARIO_FIGURES,
    TRIAL_FIGURES,
    USE_FIGURES,
    DrawnFigure,
)
from marey_reports.evaluation.sentences import interval_text
from marey_reports.evaluation.words import find_holes
from marey_schemas.documents.replicates import LEAST_REPLICATES, MeanInterval
from marey_schemas.wording import counted

Figures = Mapping[str, DrawnFigure]

HOLES = "holes"
WORST_TRIALS = 10
WALK_GRAPH = (
    "`marey report project/name --walk-graph walks.graphml` writes the graph of single frames, with the order of every "
    "walk, as GraphML or JSON."
)
LOAD_CLIPS = 15
MOST_HOLES = 15


def headline(result: EvaluationResult) -> Html:
    """Return the summary of the most important numbers as HTML."""
    judgement, coverage = judge(result), result.coverage
    sources = sum_by_source(result.clips, result.usage)
    used = sum(1 for source in sources if source.ticks)
    base = result.baseline
    beside = "" if base is None else f"{_written(base, 'offset_mean')} with generated clips (baseline)"
    held = recorded_rows(result.clips, result.usage) / result.options.database.rate_hz
    covered = int(np.count_nonzero(coverage.deficit_s <= 0.0))
    return facts(
        (
            ("trajectories followed", f"{judgement.followed} of {len(judgement.trials)}", judgement.grade),
            ("feet in contact slide at", _written(result, "foot_skate"), _beside_clips(result)),
            ("distance from the path", _written(result, "offset_mean"), _joined(_spread(result), beside)),
            ("speeds and turns covered", f"{covered} of {coverage.deficit_s.size}", f"{duration(held)} of clips"),
            ("clips used", f"{used} of {len(sources)}", _mirroring(result)),
            ("left-right symmetry", f"{coverage.symmetry:.2f}", "of the data; 1: both sides equal, 0: one side only"),
        )
    )


def _spread(result: EvaluationResult) -> str:
    return "" if result.replicates is None else interval_text(result.replicates, "offset_mean", 2)


def _joined(*parts: str) -> str:
    return "; ".join(part for part in parts if part)


def coverage_chapter(result: EvaluationResult, figures: Figures) -> Section:
    """Write the chapter on the coverage of the clips."""
    coverage = result.coverage
    short = [result.clips[index].name for index in coverage.too_short]
    text = element(
        "p",
        f"The clips contain {duration(len(coverage.clip) / result.options.database.rate_hz)} of motion, measured in "
        f"windows of one second. At least {result.options.coverage_least_s:g} s of it are available for "
        f"{100 * coverage.index:.0f} % of the speeds and turn rates that the trials request.",
    )
    too_short = element("p", f"Clips shorter than one second are not counted: {_listed(short)}.") if short else None
    pictures = shown(figures, *(name for name in COVERAGE_FIGURES if name != HOLES))  # it has a chapter of its own
    return Section("coverage", "Coverage", (text, too_short, pictures))


def error_chapter(result: EvaluationResult, figures: Figures) -> Section:
    """Write the chapter on the errors of the character, the worst trials first."""
    judgement = judge(result)
    lost = len(judgement.trials) - judgement.followed
    text = (
        "The character follows every trajectory."
        if not lost
        else f"The character does not follow {lost:,} of {counted(len(result.trials), 'trajectory')}. In "
        f"{len(judgement.trials) - judgement.on_path:,}, it loses place, speed or heading; in the others, it does not "
        "look right."
    )
    rows = [_trial_row(each) for each in judgement.ranked[:WORST_TRIALS]]
    listing = table("The worst trials; values beyond their limits are marked", TRIAL_HEADS, rows, numbers=TRIAL_NUMBERS)
    pictures = (
        shown(figures, "offsets"),
        listing,
        element("div", shown(figures, *SCENARIO_FIGURES), class_="pair"),
        shown(figures, *TRIAL_FIGURES),
    )
    return Section("errors", "Errors", (element("p", text), pictures))


def load_chapter(result: EvaluationResult, figures: Figures) -> Section:
    """Write the chapter on the most used clips."""
    used = _by_use(result)
    half, total = 0, 0.0
    while half < len(used) and total < 0.5:
        total += used[half].share
        half += 1
    text = (
        f"{half:,} of {counted(len(used), 'used clip')} {'provides' if half == 1 else 'provide'} at least half of the "
        "displayed frames."
        if used
        else "No clip was displayed."
    )
    rows = [_use_row(source, result) for source in used[:LOAD_CLIPS]]
    listing = table("The most used clips", USE_HEADS, rows, numbers=range(1, 5)) if rows else None
    return Section(
        "load",
        "Most used clips",
        (element("p", text), listing, shown(figures, *USE_FIGURES), element("p", coded(WALK_GRAPH))),
    )


def unused_chapter(result: EvaluationResult) -> Section:
    """Write the chapter on the clips that were never displayed."""
    sources = sum_by_source(result.clips, result.usage)
    unused = [source for source in sources if not source.ticks]
    if not unused:
        return Section("unused", "Unused clips", element("p", "Every clip was used at least once."))
    seconds = sum(len(source.popularity) for source in unused) / result.options.database.rate_hz
    text = element(
        "p",
        f"{counted(len(unused), 'clip')} of {len(sources)}, {duration(seconds)} of motion, "
        f"{'was' if len(unused) == 1 else 'were'} displayed in no trial. Without "
        f"{'it' if len(unused) == 1 else 'them'}, but with the same normaliser, the results of these trials stay the "
        f"same. Other trials may need {'it' if len(unused) == 1 else 'them'}.",
    )
    names = element("ul", [element("li", source.name) for source in unused], class_="names")
    content: Content = names if len(unused) <= MOST_NAMES else folded(f"All {len(unused)} names", names)
    return Section("unused", "Unused clips", (text, content))


def recording_chapter(result: EvaluationResult, figures: Figures) -> Section:
    """Write the chapter on the data to record next."""
    holes = find_holes(result.coverage)
    if not holes:
        text = element("p", "There is enough data for every speed and turn rate that the trials request.")
        return Section("record", "Data to record next", (text, shown(figures, HOLES)))
    missing = float(result.coverage.deficit_s.sum())
    rest = sum(hole.missing_s for hole in holes[MOST_HOLES:])
    items = [element("li", hole.words, ": ", element("b", f"{duration(hole.missing_s)} missing")) for hole in holes]
    more = (
        element("p", f"The other {counted(len(holes) - MOST_HOLES, 'hole')}: {duration(rest)} missing.")
        if rest
        else None
    )
    return Section(
        "record",
        "Data to record next",
        (
            element(
                "p",
                f"At least {duration(missing)} of motion are missing: each of {result.coverage.deficit_s.size} cells "
                f"of speed and turn rate needs {result.options.coverage_least_s:g} s. The largest holes first:",
            ),
            element("ol", items[:MOST_HOLES]),
            more,
            shown(figures, HOLES),
        ),
    )


def baseline_chapter(result: EvaluationResult) -> Section:
    """Write the chapter on the metrics over all trials, compared with the baseline.

    The baseline consists of the same trials with generated clips, one for each speed and turn rate.
    """
    base = result.baseline
    replicates = result.replicates
    heads = ["measure", "this dataset", *(["95 % interval"] if replicates is not None else [])]
    baseline_runs = None if base is None else base.replicates
    heads += ["generated baseline"] if base is not None else []
    heads += [*(["95 % interval"] if baseline_runs is not None else []), "unit"]
    beyond = exceeded_in_suite(result)
    rows: list[Sequence[Cell]] = []
    for name, metric in METRICS.items():
        if name not in result.suite:
            continue
        look = BEYOND if METRICS[name].limited_as in beyond or name in beyond else ""
        row: list[Cell] = [metric.label, number(result.suite[name], metric.digits, look=look)]
        if replicates is not None:
            row.append(_interval(replicates.interval(name), metric.digits))
        if base is not None:
            row.append(number(base.suite.get(name), metric.digits))
        if baseline_runs is not None:
            row.append(_interval(baseline_runs.interval(name), metric.digits))
        rows.append([*row, metric.unit])
    pooled = HOW_POOLED if replicates is None else f"{HOW_POOLED} {_replicated(replicates)}"
    marked = f"{MARKED} Limits that depend on the desired speed of a trial are not applied to them."
    about = (
        f"{pooled} {marked} The baseline is the same suite with generated clips, one for each speed and turn rate. "
        "It shows the results of the same motion matching if no data is missing."
        if base is not None
        else f"{pooled} {marked} No baseline was evaluated."
    )
    listing = table("Metrics of the suite", heads, rows, numbers=range(1, len(heads) - 1), sortable=False)
    return Section("numbers", "Metrics", (element("p", about), listing))


def _replicated(replicates: ReplicateValues) -> str:
    ran = (
        f"Each trial ran {replicates.count} times, with another phase of the stride at the start and another length of "
        "the approach. Values are means over these replicates"
    )
    if replicates.count < LEAST_REPLICATES:
        return f"{ran}, too few for 95 % intervals."
    return f"{ran}; their 95 % intervals show how far chance moves them."


def _interval(found: MeanInterval | None, digits: int) -> Number:
    if found is None or found.low is None or found.high is None:
        return Number(None, "–")
    return Number(found.low, f"{number(found.low, digits).written} to {number(found.high, digits).written}")


def appendix_chapter(result: EvaluationResult) -> Section:
    """Write the appendix, which lists every trial and every clip."""
    trials = table("All trials", TRIAL_HEADS, map(_trial_row, judge(result).trials), numbers=TRIAL_NUMBERS)
    clips = table(
        "All clips",
        USE_HEADS,
        (_use_row(source, result) for source in _by_use(result, unused=True)),
        numbers=range(1, 5),
    )
    return Section(
        "all",
        "All trials and clips",
        (
            element("p", "Click on the heading of a column to sort by this column."),
            folded(f"All {len(result.trials)} trials", trials),
            folded(f"All {len(sum_by_source(result.clips, result.usage))} clips", clips),
        ),
    )


HOW_POOLED = (
    "The values are means over all trials, with these exceptions: the maximum for the largest distance, the root mean "
    "square for “ahead or behind” and “beside the path”, and the sum for counts."
)
MARKED = "Values beyond the limits of single trials are marked."
BEYOND = "bad"
TRIAL_COLUMNS: tuple[tuple[str, str, tuple[Measure, ...], int, float], ...] = (
    ("distance (m)", "offset_mean", ("place",), 2, 1.0),
    ("largest (m)", "offset_max", (), 2, 1.0),
    ("speed error (m/s)", "settled_se_v", ("speed",), 2, 1.0),
    ("speed spread (m/s)", "settled_dse_v", ("speed wobble",), 2, 1.0),
    ("turn rate error (deg/s)", "se_omega_deg", ("turn",), 1, 1.0),
    ("turn rate spread (deg/s)", "dse_omega_deg", ("turn wobble",), 0, 1.0),
    ("heading error (deg)", "heading_rms_deg", ("heading",), 0, 1.0),
    ("response (s)", "response_median_s", ("response",), 2, 1.0),
    ("feet slide (m/s)", "foot_skate", ("skating",), 2, 1.0),
    ("feet sink (cm)", "foot_depth_p95", ("sinking",), 1, 100.0),
    ("steps per metre", "contacts_per_m", ("gliding", "pattering"), 2, 1.0),
    ("transition cost (m)", "pose_cost_mean", ("jerking",), 2, 1.0),
    ("transitions (1/s)", "transitions_per_s", ("jumping",), 2, 1.0),
    ("treading (1/s)", "treading_per_s", ("treading",), 2, 1.0),
)
"""Numeric columns of the table of trials: heading, name of the metric, names of limits, decimals, and factor.

If a trial has one of the limits, the column shows the value that was compared with the limit, instead of the metric.
The value is multiplied by the factor.
"""
SIGNED = ("settled_se_v", "se_v", "se_omega_deg")
TRIAL_HEADS = ("trial", *(column[0] for column in TRIAL_COLUMNS))
TRIAL_NUMBERS = range(1, len(TRIAL_COLUMNS) + 1)
USE_HEADS = ("clip", "share of display", "length (s)", "own frames displayed", "times entered")


def _trial_row(trial: TrialVerdict) -> list[Cell]:
    outcome = trial.outcome
    row: list[Cell] = [element("span", demand(outcome.trial), title=outcome.trial.name)]
    for _, metric, measures, digits, factor in TRIAL_COLUMNS:
        check = max((each for each in trial.checks if each.measure in measures), key=_strain, default=None)
        value = outcome.metrics.get(metric) if check is None else check.value
        look = BEYOND if check is not None and check.exceeded else ""
        if check is not None and check.measure == "response" and check.value is None:
            row.append(Number(None, "unanswered", look))
            continue
        scaled = None if value is None else factor * value
        row.append(number(scaled, digits, signed=metric in SIGNED, look=look))
    return row


def _strain(check: LimitCheck) -> float:
    return check.strain


def _beside_clips(result: EvaluationResult) -> str:
    of_clips = result.suite.get("foot_skate_clips")
    return "" if of_clips is None else f"{of_clips:.2f} m/s in the clips shown"


def _use_row(source: SourceUsage, result: EvaluationResult) -> list[Cell]:
    shown_at_all = float(np.mean(source.popularity > 0)) if len(source.popularity) else 0.0
    return [
        element("span", source.name, title=source.uid),
        share(source.share),
        number(len(source.popularity) / result.options.database.rate_hz, 1),
        share(shown_at_all),
        Number(source.entries, f"{source.entries:,}"),
    ]


def _by_use(result: EvaluationResult, *, unused: bool = False) -> list[SourceUsage]:
    sources = [source for source in sum_by_source(result.clips, result.usage) if unused or source.ticks]
    return sorted(sources, key=lambda source: (-source.ticks, source.uid))


def _written(result: EvaluationResult, name: str) -> str:
    metric, value = METRICS[name], result.suite.get(name)
    return "–" if value is None else f"{value:.{metric.digits}f} {metric.unit}"


def _mirroring(result: EvaluationResult) -> str:
    return {
        "none": "not mirrored",
        "add": "each also mirrored, counted once",
        "only": "all mirrored",
    }[result.options.database.mirroring]


def _listed(names: Iterable[str], most: int = 12) -> str:
    known = list(names)
    more = f" and {len(known) - most} more" if len(known) > most else ""
    return ", ".join(known[:most]) + more


def notes(result: EvaluationResult) -> Html | None:
    """Write the notes of the evaluation about its clips; return None if there are no notes."""
    if not result.notes:
        return None
    listing = element("ul", [element("li", note) for note in result.notes])
    return joined((element("h3", "Notes"), listing))
