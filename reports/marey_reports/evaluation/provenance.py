"""Part of a report that names the data, options and code version of its numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from marey_motion.evaluation.result import EvaluationResult
from marey_reports.drawing.markup import Html, element, joined
from marey_reports.drawing.tables import Cell, folded, table
from marey_schemas.base import Options

DIGESTS = ("dataset", "normaliser", "options", "scenarios")


def provenance(results: Sequence[EvaluationResult], labels: Sequence[str]) -> Html:
    """Write digests, versions and options of one result, or of two results side by side with marked differences."""
    heads = ("name", *labels)
    digests = [_row(name, [getattr(result.provenance, name) for result in results], code=True) for name in DIGESTS]
    versions = _row("version of the code", [result.provenance.code_version for result in results], code=True)
    options = [dict(_flat("", result.options)) for result in results]
    names = list(dict.fromkeys(name for each in options for name in each))
    rows = [_row(name, [each.get(name, "") for each in options], code=False) for name in names]
    digests_of_clips = [
        table(
            f"Clips{f' of {label}' if label and len(labels) > 1 else ''}",
            ("clip", "name", "content"),
            [(element("code", clip.uid), clip.name, element("code", contents.get(clip.uid, "")))
             for clip in result.clips],
            numbers=(),
        )
        for label, result, contents in zip(labels, results, (one.provenance.clips for one in results), strict=True)
    ]  # fmt: skip
    return joined(
        (
            element("p", "The same clips, options and version of the code give the same numbers, bit for bit."),
            table("Digests", heads, [*digests, versions], numbers=(), sortable=False),
            folded("All options", table("Options", heads, rows, numbers=(), sortable=False)),
            folded("Digest of every clip", digests_of_clips),
        )
    )


def _row(name: str, values: Sequence[str], *, code: bool) -> list[Cell]:
    differ = len(set(values)) > 1
    row: list[Cell] = [name]
    row += [element("code" if code else "span", value, class_="bad" if differ else None) for value in values]
    return row


def _flat(prefix: str, value: object) -> Iterator[tuple[str, str]]:
    """Yield the dotted name of each option, and its value as text."""
    if isinstance(value, Options):
        for name, member in value:
            yield from _flat(f"{prefix}.{name}" if prefix else name, member)
    elif isinstance(value, tuple):
        yield prefix, ", ".join(f"{entry:g}" if isinstance(entry, float) else str(entry) for entry in value) or "none"
    elif isinstance(value, float):
        yield prefix, f"{value:g}"
    else:
        yield prefix, str(value)
