"""Two runs of the benchmarks in one Markdown table: `python -m benchmarks.compare before.json after.json`."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from benchmarks.timing import Row

_HEADINGS = ("job", "size", "peer", "before", "ratio", "after", "ratio", "goal", "")
_VERDICTS = {True: "met", False: "**missed**", None: ""}
_NUMBER = re.compile(r"\d[\d.,]*")


def main() -> int:
    """Print a table of the two runs; return the exit status 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.compare", description=__doc__)
    parser.add_argument("before", type=Path, help="JSON of the earlier run (python -m benchmarks --json FILE)")
    parser.add_argument("after", type=Path, help="JSON of the later run")
    arguments = parser.parse_args()
    try:
        before, after = _rows_of(arguments.before), _rows_of(arguments.after)
    except (OSError, ValueError, TypeError) as error:
        parser.error(f"not the JSON of a run of the benchmarks: {error}")
    print(as_markdown(before, after))
    return 0


def _rows_of(path: Path) -> list[Row]:
    return [Row(**row) for row in json.loads(path.read_text(encoding="utf-8"))]


def as_markdown(before: Sequence[Row], after: Sequence[Row]) -> str:
    """Return a table of both runs in the order of the later run, then the rows that only the earlier run has."""
    lines = [_line(_HEADINGS), _line(["---"] * len(_HEADINGS))]
    lines += [_line(_cells(*pair)) for pair in matched(before, after)]
    return "\n".join(lines)


def matched(before: Sequence[Row], after: Sequence[Row]) -> Iterator[tuple[Row | None, Row | None]]:
    """Pair the rows of two runs that have the same job and size; a row without a counterpart is paired with None.

    A size may contain measurements of the run, such as processor time. So rows of the same job are also paired if their
    sizes differ only in numbers.
    """
    left = list(before)
    pairs = [(_take(left, row, str), row) for row in after]
    for earlier, row in pairs:
        yield earlier or _take(left, row, _without_numbers), row
    for row in left:
        yield row, None


def _without_numbers(size: str) -> str:
    return _NUMBER.sub("", size)


def _take(left: list[Row], row: Row, form: Callable[[str], str]) -> Row | None:
    """Remove the first row with the job and size of `row` from `left`, and return it, or None if there is none.

    The sizes are compared after conversion by `form`.
    """
    found = next((one for one in left if one.job == row.job and form(one.size) == form(row.size)), None)
    if found is not None:
        left.remove(found)
    return found


def _cells(before: Row | None, after: Row | None) -> list[str]:
    row = after or before
    assert row is not None
    return [
        row.job,
        row.size if before is None or before.size == row.size else f"{row.size} (before: {before.size})",
        row.peer,
        before.ours if before else "(new)",
        _ratio(before),
        after.ours if after else "(absent)",
        _ratio(after),
        row.goal,
        _VERDICTS[after.met] if after else "",
    ]


def _ratio(row: Row | None) -> str:
    return "" if row is None or row.ratio is None else f"{row.ratio:.1f}x"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


if __name__ == "__main__":
    sys.exit(main())
