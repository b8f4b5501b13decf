"""Fields that a script logs, such as metrics; their content is not trusted.

The script writes them as one JSON object, or as JSON lines, each with the values of one step.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import TypeAdapter, ValidationError

from marey_schemas.queue.comparisons import LAST_STEP, MOST_CURVES, MOST_POINTS, Curve
from marey_schemas.queue.scripts import LONGEST_TEXT, MOST_FIELDS, STEPWISE, FieldName, ScriptOutput, Value
from marey_schemas.sizes import KIB, MIB
from marey_worker.context import JobRefused

MOST_FIELD_BYTES = MIB
MOST_LINE_BYTES = 64 * KIB
STEP = "step"
"""Key of the step in a line of JSON; the other keys of the line are fields with their values at this step."""

_FIELD_NAME: TypeAdapter[str] = TypeAdapter(FieldName)


class LoggedFields(NamedTuple):
    """Fields of a run with their last values, and the curves of the fields that were logged over steps."""

    fields: dict[str, Value]
    curves: dict[str, Curve]


def read_fields(name: str, declared: ScriptOutput, file: Path) -> LoggedFields:
    """Return the fields that a run has logged in an output. Raises `JobRefused` if the content is not valid."""
    if declared.format == STEPWISE:
        return _read_lines(name, file)
    if file.stat().st_size > MOST_FIELD_BYTES:
        raise _refusal(f"the output {name!r} must have at most {MOST_FIELD_BYTES:,} bytes")
    try:
        document = json.loads(file.read_bytes())
    except (ValueError, RecursionError) as error:
        raise _refusal(f"the output {name!r} is not a JSON document: {error}") from error
    if not isinstance(document, Mapping) or len(document) > MOST_FIELDS:
        raise _refusal(f"the output {name!r} must be a JSON object of at most {MOST_FIELDS} fields")
    for field, value in document.items():
        fault = _fault_of_name(field) or _fault_of_value(value)
        if fault is not None:
            raise _refusal(f"the field {field!r:.100} of the output {name!r}: {fault}")
    return LoggedFields(dict(document), {})


def _read_lines(name: str, file: Path) -> LoggedFields:
    """Read fields from JSON lines, one line at a time, so that a long file needs little memory."""
    fields: dict[str, Value] = {}
    thinned: dict[str, _ThinnedCurve] = {}
    with file.open("rb") as lines:
        number = 0
        while line := lines.readline(MOST_LINE_BYTES + 1):
            number += 1
            if not line.strip():
                continue
            where = f"line {number:,} of the output {name!r}"
            step, values = _parse_line(where, line, number - 1)
            for field, value in values.items():
                _add(where, fields, field, value)
                if isinstance(value, int | float) and not isinstance(value, bool) and _has_room(thinned, field):
                    thinned.setdefault(field, _ThinnedCurve()).add(step, value)
    return LoggedFields(fields, {field: curve.finished() for field, curve in thinned.items() if curve.logged > 1})


def _parse_line(where: str, line: bytes, default_step: int) -> tuple[int, dict[str, Any]]:
    """Return the step of a line, or `default_step` if the line has none, and its values by field.

    Raises `JobRefused` if the line is not a valid JSON object of fields.
    """
    if len(line) > MOST_LINE_BYTES:
        raise _refusal(f"{where} must have at most {MOST_LINE_BYTES:,} bytes")
    try:
        document = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise _refusal(f"{where} is not a JSON document: {error}") from error
    if not isinstance(document, dict):
        raise _refusal(f'{where} must be a JSON object, such as {{"step": 1, "loss": 0.5}}')
    step = document.pop(STEP, default_step)
    if isinstance(step, bool) or not isinstance(step, int) or abs(step) > LAST_STEP:
        raise _refusal(f"the step in {where} must be an integer of at most {LAST_STEP:,}")
    return step, document


def _add(where: str, fields: dict[str, Value], field: str, value: Any) -> None:
    """Set a field to its newest value.

    Numbers that are not finite become the texts NaN, Infinity and -Infinity. If the loss of a run diverges, its result
    is such a text, because the last finite loss would be misleading.
    """
    fault = _fault_of_name(field) if field not in fields else None
    if isinstance(value, float) and not math.isfinite(value):
        value = json.dumps(value)
    fault = fault or _fault_of_value(value)
    if fault is None and field not in fields and len(fields) == MOST_FIELDS:
        fault = f"a run may have at most {MOST_FIELDS} fields"
    if fault is not None:
        raise _refusal(f"the field {field!r:.100} in {where}: {fault}")
    fields[field] = value


def _has_room(curves: Mapping[str, Any], field: str) -> bool:
    return field in curves or len(curves) < MOST_CURVES


class _ThinnedCurve:
    """Curve of a field that keeps every 2^n-th of its values and the last one, so that its length is limited.

    n grows while values are added. So curves of different lengths have many steps in common, and means of replicates
    can be computed.
    """

    def __init__(self) -> None:
        self.logged = 0
        self._every = 1
        self._kept: list[tuple[int, float]] = []
        self._last = (0, 0.0)

    def add(self, step: int, value: float) -> None:
        """Add the value that was logged at a step."""
        self._last = (step, float(value))
        if self.logged % self._every == 0:
            if len(self._kept) == MOST_POINTS - 1:  # one place is for the last value
                self._kept = self._kept[::2]
                self._every *= 2
            if self.logged % self._every == 0:
                self._kept.append(self._last)
        self.logged += 1

    def finished(self) -> Curve:
        """Return the curve in ascending order of steps; if a step has several values, the last one is kept."""
        points = sorted(dict([*self._kept, self._last]).items())
        return Curve(
            steps=tuple(step for step, _ in points),
            values=tuple(value if math.isfinite(value) else None for _, value in points),
            logged=self.logged,
        )


def _fault_of_name(field: str) -> str | None:
    try:
        _FIELD_NAME.validate_python(field)
    except ValidationError:
        return "a name consists of at most 63 letters, digits and _, and begins with a letter"
    return None


def _fault_of_value(value: Any) -> str | None:
    if isinstance(value, str):
        return None if len(value) <= LONGEST_TEXT else f"a text may have at most {LONGEST_TEXT} characters"
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        small = abs(value) < 2**63 if isinstance(value, int) else math.isfinite(value)
        return None if small else "a number must be finite, and an integer must fit into 64 bits"
    return "a value must be a number, a text, true or false"


def _refusal(detail: str) -> JobRefused:
    return JobRefused("bad-fields", detail)
