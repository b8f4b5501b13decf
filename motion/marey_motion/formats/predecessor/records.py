"""Records of work with Marey's predecessor: jobs, runs of data transforms, histories of edits, and synthesis inputs.

Marey only stores these files and shows their fields; it does not run the jobs, transforms, edits or syntheses. A record
has one of four forms:

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

from marey_motion.formats.predecessor.credentials import contains_credential, has_text, is_secret_list, is_secret_name
from marey_motion.formats.texts import cut_text, plain_text
from marey_schemas.documents.predecessor_records import HIDDEN, LONGEST_TEXT, MOST_SHOWN, FieldValue, RecordForm

_MEMBERS: dict[RecordForm, tuple[str, ...]] = {
    "job": ("image_name", "job_desc"),
    "transform run": ("data_transform_id", "input_data"),
    "synthesis input": ("elementaryActions",),
}
"""Members that identify the form of a document; the fourth form, a history of edits, is identified as a list."""
_GREATEST_WHOLE = 2**53  # greater ones are not exact in all readers of JSON


@dataclass(frozen=True)
class RecordFields:
    """Fields of a record as they are shown.

    Parameters
    ----------
    shown : values by their JSON Pointers; a list of plain values is shown as one text
    left_out : number of values that are not shown, because there are too many or their pointer is too long
    credentials : JSON Pointers of the values that are hidden, because they contain credentials
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
        return "edit history" if content and all(map(_is_command, content)) else None
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
    RecordFields    the fields to show
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
    """Yield, in the order of the document, each field's pointer, its value, and whether the value is a credential."""
    waiting: list[tuple[str, Any, bool | None]] = [("", content, False)]
    while waiting:
        pointer, value, is_named = waiting.pop()
        if is_named and not has_text(value):
            is_named = None  # nor has what is in it, which is not searched again
        is_secret = is_named or (is_named is False and _is_secret(value))
        if not value or is_secret or not isinstance(value, (Mapping, list)) or _is_row(value):
            yield pointer, value, is_secret
            continue
        members = value.items() if isinstance(value, Mapping) else enumerate(value)
        secrets = _secrets_of(value) if isinstance(value, Mapping) else ()
        below = [
            (_pointer_to(pointer, key), member, None if is_named is None else key in secrets) for key, member in members
        ]
        waiting.extend(reversed(below))


def _secrets_of(value: Mapping[str, Any]) -> set[str]:
    """Return the keys whose values are credentials; for `{"name": "DB_PASSWORD", "value": ...}`, this is "value"."""
    names = {key.lower(): one for key, one in value.items() if isinstance(one, str)}
    is_variable = is_secret_name(names.get("name")) or is_secret_name(names.get("key"))
    return {key for key in value if is_secret_name(key) or (is_variable and key.lower() == "value")}


def _is_secret(value: Any) -> bool:
    """Return whether a text contains a credential, or a list contains one, either in a text or after its name."""
    if isinstance(value, str):
        return contains_credential(value)
    if not isinstance(value, list):
        return False
    return is_secret_list(value) or (
        _is_row(value) and any(isinstance(one, str) and contains_credential(one) for one in value)
    )


def _is_row(value: Any) -> bool:
    return isinstance(value, list) and not any(isinstance(one, (Mapping, list)) for one in value)


def _pointer_to(pointer: str, key: object) -> str:
    """Return the JSON Pointer of a member; a pointer that is too long to be shown is cut off."""
    name = plain_text(str(key)[:LONGEST_TEXT]).replace("~", "~0").replace("/", "~1")
    return f"{pointer}/{name}"[: LONGEST_TEXT + 1]


def _shown(value: Any) -> FieldValue:
    """Return a value that JSON can represent exactly; any other value is converted to text."""
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int) and abs(value) <= _GREATEST_WHOLE:
        return int(value)
    if isinstance(value, float) and math.isfinite(value):
        return value
    if isinstance(value, (Mapping, list)):
        value = json.dumps(value, ensure_ascii=False, default=str)
    return cut_text(str(value), LONGEST_TEXT)
