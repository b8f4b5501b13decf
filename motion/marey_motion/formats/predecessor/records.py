"""Records of work with Marey's predecessor: jobs, runs of data transforms, histories of edits, and synthesis inputs.

Marey carries none of them out. It keeps the files, and shows their fields. The forms are

* a job on a cluster, `{"image_name", "job_name", "job_desc", "resources", "user", "token"}`;
* a run of a data transform, `{"data_transform_id", "exp_name", "input_data", "hparams", ...}`;
* a history of edits, `[[command, parameters or null], ...]`;
* an input of the offline synthesis, `{"session", "startPose", "elementaryActions": [{"action", "constraints"}]}`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from marey_schemas.documents.predecessor_records import HIDDEN, LONGEST_TEXT, MOST_SHOWN, RecordForm

FieldValue = str | bool | int | float | None

_MEMBERS: dict[RecordForm, tuple[str, ...]] = {
    "job": ("image_name", "job_desc"),
    "transform run": ("data_transform_id", "input_data"),
    "synthesis input": ("elementaryActions",),
}
"""Members by which a document of each form is recognised; a history of edits is a list."""
_CREDENTIALS = ("token", "password", "secret", "access_key", "api_key")
_GREATEST_WHOLE = 2**53  # greater ones are not exact in all readers of JSON


@dataclass(frozen=True)
class RecordFields:
    """Fields of a record as they are shown.

    Parameters
    ----------
    shown : values by their JSON Pointers; a list of plain values is one text
    left_out : number of further values
    credentials : JSON Pointers of the values that are hidden
    """

    shown: Mapping[str, FieldValue]
    left_out: int
    credentials: tuple[str, ...]


def form_of_record(content: Any) -> RecordForm | None:
    """Find the form of a record.

    Parameters
    ----------
    content : object    decoded content of a file

    Returns
    -------
    str or None    the form; None if the content is no record
    """
    if isinstance(content, list):
        return "edit history" if all(map(_is_command, content)) else None
    if not isinstance(content, Mapping):
        return None
    return next((form for form, names in _MEMBERS.items() if all(name in content for name in names)), None)


def fields_of_record(content: Any) -> RecordFields:
    """List the fields of a record, with credentials hidden, up to `MOST_SHOWN` of them.

    Parameters
    ----------
    content : object    decoded content of a file

    Returns
    -------
    RecordFields    what is shown of it
    """
    shown: dict[str, FieldValue] = {}
    credentials: list[str] = []
    left_out = 0
    for pointer, value, is_secret in _values(content):
        if is_secret:
            credentials.append(pointer)
        if len(shown) == MOST_SHOWN or len(pointer) > LONGEST_TEXT:
            left_out += 1
        else:
            shown[pointer] = HIDDEN if is_secret else _shown(value)
    return RecordFields(shown, left_out, tuple(credentials[:MOST_SHOWN]))


def _is_command(entry: Any) -> bool:
    return isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str)


def _values(content: Any) -> Iterator[tuple[str, Any, bool]]:
    """Yield pointer and value of each field in the order of the document, and whether it is a credential."""
    waiting: list[tuple[str, Any, bool]] = [("", content, False)]
    while waiting:
        pointer, value, is_secret = waiting.pop()
        if not value or is_secret or not isinstance(value, (Mapping, list)) or _is_row(value):
            yield pointer, value, is_secret and bool(value)
            continue
        members = value.items() if isinstance(value, Mapping) else enumerate(value)
        below = [(_pointer_to(pointer, key), member, _is_credential(key)) for key, member in members]
        waiting.extend(reversed(below))


def _is_row(value: Any) -> bool:
    return isinstance(value, list) and not any(isinstance(one, (Mapping, list)) for one in value)


def _is_credential(key: object) -> bool:
    return isinstance(key, str) and any(word in key.lower() for word in _CREDENTIALS)


def _pointer_to(pointer: str, key: object) -> str:
    return f"{pointer}/{_plain(str(key)).replace('~', '~0').replace('/', '~1')}"


def _shown(value: Any) -> FieldValue:
    """Return a value as JSON can contain it; a value that it cannot contain is shown as text."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int) and abs(value) <= _GREATEST_WHOLE:
        return int(value)
    if isinstance(value, float) and math.isfinite(value):
        return value
    if isinstance(value, (Mapping, list)):
        value = json.dumps(value, ensure_ascii=False, default=str)
    text = _plain(str(value))
    return text if len(text) <= LONGEST_TEXT else f"{text[: LONGEST_TEXT - 1]}…"


def _plain(text: str) -> str:
    """Replace halves of surrogate pairs, which JSON can name but UTF-8 cannot contain."""
    return text.encode("utf-8", "replace").decode()
