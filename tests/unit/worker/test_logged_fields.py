"""Fields that scripts log as JSON lines: last values, thinned curves, and lines that are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from marey_schemas.queue.comparisons import MOST_CURVE_BYTES, MOST_CURVES, MOST_POINTS, Curve, Curves
from marey_schemas.queue.scripts import MOST_FIELDS, ScriptOutput
from marey_worker.context import JobRefused
from marey_worker.scripts.fields import MOST_LINE_BYTES, LoggedFields, read_fields

LINES = ScriptOutput(kind="fields", format="jsonl")


def read(folder: Path, text: str | bytes) -> LoggedFields:
    file = folder / "log.jsonl"
    file.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_fields("log", LINES, file)


def lines(*rows: dict[str, Any]) -> str:
    return "".join(f"{json.dumps(row)}\n" for row in rows)


def test_the_last_value_is_the_field_and_numbers_over_steps_are_curves(tmp_path: Path) -> None:
    text = lines(
        {"step": 10, "loss": 2, "phase": "warm"}, {"loss": 1.5}, {"step": 5, "loss": 3.5}, {"step": 10, "loss": 4}
    )
    found = read(tmp_path, text + "\n" + lines({"best": 1, "phase": "end", "step": 2**53}, {"ok": True}).strip())
    assert found.fields == {"loss": 4, "phase": "end", "best": 1, "ok": True}
    assert found.curves == {"loss": Curve(steps=(1, 5, 10), values=(1.5, 3.5, 4.0), logged=4)}
    assert read(tmp_path, "") == LoggedFields({}, {})


def test_a_run_that_diverges_has_a_text_as_field_and_gaps_in_its_curve(tmp_path: Path) -> None:
    found = read(tmp_path, lines({"a": 1.0, "b": 1.0}, {"a": float("nan"), "b": float("-inf")}, {"b": 2.0}))
    assert found.fields == {"a": "NaN", "b": 2.0}
    assert [curve.values for curve in found.curves.values()] == [(1.0, None), (1.0, None, 2.0)]
    assert read(tmp_path, '{"a": 1e999}').fields == {"a": "Infinity"}


@pytest.mark.parametrize("count", [2, MOST_POINTS - 1, MOST_POINTS, MOST_POINTS + 1, 1000, 5000])
def test_long_curves_keep_evenly_spaced_steps_and_the_last_one(count: int, tmp_path: Path) -> None:
    (curve,) = read(tmp_path, lines(*({"a": number} for number in range(count)))).curves.values()
    assert (curve.logged, curve.steps[0], curve.steps[-1], len(curve.steps) <= MOST_POINTS) == (
        count,
        0,
        count - 1,
        True,
    )
    assert curve.values == curve.steps
    every = curve.steps[1]
    assert every & (every - 1) == 0, "a power of two, so that curves of other lengths have these steps, too"
    assert set(range(0, count, every)) | {count - 1} == set(curve.steps)


def test_the_file_of_the_curves_has_a_bounded_size(tmp_path: Path) -> None:
    row = {f"{field:02}".rjust(62, "x"): -1.2345678901234567e-300 for field in range(MOST_FIELDS)}
    found = read(tmp_path, lines(*({"step": 2**52 + step, **row} for step in range(400))))
    assert (len(found.fields), len(found.curves)) == (MOST_FIELDS, MOST_CURVES)
    assert len(Curves(curves=found.curves).model_dump_json()) < MOST_CURVE_BYTES


WRONG: dict[str, tuple[str | bytes, str]] = {
    "no JSON": (lines({"a": 1}) + "{'a': 2}", "line 2 of the output 'log' is not a JSON document"),
    "half a line": ('{"a": 1}\n{"a":', "line 2"),
    "no text": (b"\xff\xfe", "line 1"),
    "list": ("[1]", "must be a JSON object"),
    "deep": ("[" * 5000, "line 1"),
    "long line": (b'{"a": "' + b"x" * MOST_LINE_BYTES + b'"}', "at most 65,536 bytes"),
    "nested": ('{"a": {"b": 1}}', "a number, a text, true or false"),
    "null": ('{"a": null}', "a number, a text, true or false"),
    "name": ('{"<b>": 1}', "a name consists of at most 63 letters"),
    "huge integer": ('{"a": 1' + "0" * 30 + "}", "64 bits"),
    "long text": (json.dumps({"a": "x" * 501}), "at most 500 characters"),
    "fraction as step": ('{"step": 0.5, "a": 1}', "the step in line 1"),
    "text as step": ('{"step": "1", "a": 1}', "the step in line 1"),
    "huge step": ('{"step": 1' + "0" * 30 + "}", "the step in line 1"),
    "many fields": (lines(*({f"a{number}": 1} for number in range(MOST_FIELDS + 1))), "at most 100 fields"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_line_of_another_form_fails_the_job_with_its_number(what: str, tmp_path: Path) -> None:
    text, reason = WRONG[what]
    with pytest.raises(JobRefused) as refused:
        read(tmp_path, text)
    assert refused.value.code == "bad-fields"
    assert reason in refused.value.detail


def test_only_fields_can_be_stepwise() -> None:
    assert LINES.ending == ".jsonl"
    for kind, format_ in (("fields", "csv"), ("file", "jsonl")):
        with pytest.raises(ValueError, match="format"):
            ScriptOutput.model_validate({"kind": kind, "format": format_})
