"""Content of the charts of a comparison: names of settings, and the numbers of fields.

A setting consists of the runs with the same command, inputs and parameters. Of several runs with the same seed, only
the newest is counted.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from marey_reports.drawing.paper import shortened
from marey_schemas.documents.evaluations import CONFIDENCE
from marey_schemas.documents.replicates import LEAST_REPLICATES
from marey_schemas.queue.comparisons import ComparedColumn, ComparedRun, FieldSummary, RunComparison, number_of

LONGEST_LABEL, LONGEST_VALUE = 46, 24
COMMIT_SIGNS = 8
MOST_DECIMALS = 6
MOST_MISSING = 4
"""Greatest number of settings without a mean that a caption lists by name."""
LARGEST, SMALLEST = 1e150, 1e-150
"""Greatest magnitude of a drawn number, and least number on a logarithmic axis. With these bounds, differences and
ratios stay finite.
"""


class Point(NamedTuple):
    """Values of one field in one setting: index of the setting, summary, and the field's value in each counted run."""

    setting: int
    summary: FieldSummary
    numbers: tuple[float, ...]

    @property
    def ends(self) -> tuple[float, float]:
        """The least and the greatest of the numbers."""
        return min(self.numbers), max(self.numbers)


@dataclass(frozen=True, eq=False)
class ComparedSubject:
    """Comparison of runs, with the names and numbers that charts show.

    Parameters
    ----------
    comparison : the comparison, as the server returns it
    log : whether axes of fields with positive values are logarithmic
    """

    comparison: RunComparison
    log: bool

    @cached_property
    def varied(self) -> tuple[ComparedColumn, ...]:
        """The inputs, the parameters and the commit, as far as they differ between the runs."""
        return tuple(column for column in self.comparison.columns if column.of != "field" and column.differs)

    @cached_property
    def fields(self) -> tuple[ComparedColumn, ...]:
        """The fields with means, sorted.

        Fields with a goal come before fields without a goal. In each of these two groups, fields whose values differ
        come first.
        """
        own = {name for setting in self.comparison.settings for name in setting.fields}
        found = [column for column in self.comparison.columns if column.of == "field" and column.name in own]
        return tuple(sorted(found, key=lambda column: (column.goal is None, not column.differs)))

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """The name of each setting: the values of the columns `varied` in its first run. Equal names get a number."""
        titles = self.comparison.titles(self.varied)
        named = [
            shortened(", ".join(_parts(self.first_run(place), self.varied, titles)) or "all runs", LONGEST_LABEL)
            for place in range(len(self.comparison.settings))
        ]
        counts, seen = Counter(named), Counter[str]()
        for place, name in enumerate(named):
            seen[name] += 1
            if counts[name] > 1:
                named[place] = f"{name} ({seen[name]})"
        return tuple(named)

    def order_of(self, field: str) -> list[int]:
        """Return the settings in the order in which charts show them: the best first if the field has a goal."""
        settings = self.comparison.settings
        goal = next((one.goal for one in self.comparison.columns if (one.of, one.name) == ("field", field)), None)
        if goal is None:
            return list(range(len(settings)))
        sign = -1.0 if goal == "highest" else 1.0
        known = {place: sign * one.fields[field].mean for place, one in enumerate(settings) if field in one.fields}
        return [*sorted(known, key=known.__getitem__), *(set(range(len(settings))) - known.keys())]

    def left_out(self, field: str) -> list[str]:
        """Return the names of the settings for which `points` returns no point."""
        drawn = {point.setting for point in self.points(field)}
        return [name for place, name in enumerate(self.labels) if place not in drawn]

    def first_run(self, setting: int) -> ComparedRun:
        """Return the first counted run of a setting."""
        return self.comparison.runs[self.comparison.settings[setting].runs[0]]

    def points(self, field: str) -> list[Point]:
        """Return a point for each setting in which all counted runs have a number for `field` of at most `LARGEST`.

        The points are in the order of `order_of`.
        """
        found = []
        for place in self.order_of(field):
            setting = self.comparison.settings[place]
            given = [number_of(self.comparison.runs[run].fields.get(field)) for run in setting.runs]
            numbers = tuple(one for one in given if one is not None and abs(one) <= LARGEST)
            if field in setting.fields and len(numbers) == len(given):
                found.append(Point(place, setting.fields[field], numbers))
        return found

    def is_log(self, numbers: Sequence[float]) -> bool:
        """Return whether an axis with these numbers of a field is logarithmic."""
        return self.log and bool(numbers) and min(numbers) >= SMALLEST


def _parts(run: ComparedRun, columns: Sequence[ComparedColumn], titles: Sequence[str]) -> Iterator[str]:
    for column, title in zip(columns, titles, strict=True):
        yield f"{title}={written(column, run)}"


def written(column: ComparedColumn, run: ComparedRun) -> str:
    """Write the value of a run in a column, shortened."""
    cell = run.cell(column)
    if cell is None:
        return "–"
    if column.of == "commit":
        return str(cell)[:COMMIT_SIGNS]
    if isinstance(cell, bool):
        return str(cell).lower()
    return shortened(cell, LONGEST_VALUE) if isinstance(cell, str) else short(cell)


def short(number: float) -> str:
    """Write a number with at most five digits."""
    return f"{number:.5g}"


def ends(low: float, high: float) -> str:
    """Write an interval with three digits of its width, because further digits of its ends say nothing."""
    width = high - low
    digits = max(0, 2 - math.floor(math.log10(width))) if 0.0 < width < math.inf else 0
    if not 0 < digits <= MOST_DECIMALS:
        return f"{short(low)} to {short(high)}"
    first, last = (round(end, digits) + 0.0 for end in (low, high))  # not -0.00
    return f"{first:.{digits}f} to {last:.{digits}f}"


def interval_words() -> str:
    """Return the part of a caption that says what the drawn intervals are."""
    return f"{CONFIDENCE:.0%} confidence intervals of the means (from n = {LEAST_REPLICATES})".replace("%", " %")


def missing_words(names: Sequence[str]) -> list[str]:
    """Return a part of a caption that names the settings that are left out, if there are any."""
    if not names:
        return []
    more = f" and {len(names) - MOST_MISSING} more" if len(names) > MOST_MISSING else ""
    shown = ", ".join(f"({name})" for name in names[:MOST_MISSING])
    return [f"left out, because a run gave no number that can be drawn: {shown}{more}"]
