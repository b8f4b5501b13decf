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
from typing import Any, NamedTuple

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
    for field in _fields(content):
        if field.is_secret and len(credentials) < MOST_SHOWN:
            credentials.append(field.pointer)
        if len(shown) == MOST_SHOWN or len(field.pointer) > LONGEST_TEXT:
            left_out += 1
        else:
            shown[field.pointer] = HIDDEN if field.is_secret else _shown(field.value)
    return RecordFields(shown, left_out, tuple(credentials))


def _is_command(entry: Any) -> bool:
    return isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str)


class _Container:
    """Object or list of a document, whose members are searched one after another.

    `above` is the parent container, whose member `key` is this container; None for the whole document. `searched`
    states whether the members of this container are searched for credentials.
    """

    __slots__ = ("_above", "_key", "_pointer", "members", "searched", "secrets")

    def __init__(self, above: _Container | None, key: object, value: Any, *, searched: bool) -> None:
        self._above, self._key = above, key
        self._pointer: str | None = "" if above is None else None
        members = value.items() if isinstance(value, dict) else enumerate(value)
        self.members: Iterator[tuple[object, Any]] = iter(members)
        self.searched = searched
        self.secrets = _secrets_of(value) if isinstance(value, dict) and searched else frozenset[str]()

    @property
    def pointer(self) -> str:
        """The JSON Pointer of the container. It is made when it is needed: a file may contain a million containers."""
        unnamed, one = [], self
        while (pointer := one._pointer) is None:
            unnamed.append(one)
            assert one._above is not None, "the whole document has the empty pointer"
            one = one._above
        for one in reversed(unnamed):  # without recursion: a document may be nested a thousand times
            pointer = one._pointer = _pointer_to(pointer, one._key)
        return pointer


class _RecordField(NamedTuple):
    """Value of a document that is shown as one field, and whether it contains a credential."""

    container: _Container | None
    key: object
    value: Any
    is_secret: bool

    @property
    def pointer(self) -> str:
        """The JSON Pointer of the value."""
        return "" if self.container is None else _pointer_to(self.container.pointer, self.key)


def _fields(content: Any) -> Iterator[_RecordField]:
    """Yield the fields of a document in its order."""
    if not _is_divided(content) or _is_secret(content):
        yield _RecordField(None, "", content, _is_secret(content))
        return
    open_: list[_Container] = [_Container(None, "", content, searched=True)]
    while open_:
        container = open_[-1]
        for key, value in container.members:
            if not value or isinstance(value, (int, float)):  # no credential; a file may contain a million of these
                yield _RecordField(container, key, value, is_secret=False)
                continue
            is_named = key in container.secrets
            is_secret = container.searched and (has_text(value) if is_named else _is_secret(value))
            if not is_secret and _is_divided(value):
                # below the name of a credential, what has no text contains none
                open_.append(_Container(container, key, value, searched=container.searched and not is_named))
                break
            yield _RecordField(container, key, value, is_secret)
        else:
            open_.pop()


def _secrets_of(value: Mapping[str, Any]) -> set[str]:
    """Return the keys whose values are credentials; for `{"name": "DB_PASSWORD", "value": ...}`, this is "value"."""
    names = {key.lower(): one for key, one in value.items() if isinstance(one, str)}
    is_variable = is_secret_name(names.get("name")) or is_secret_name(names.get("key"))
    return {key for key in value if is_secret_name(key) or (is_variable and key.lower() == "value")}


def _is_secret(value: Any) -> bool:
    """Return whether a text contains a credential, or a list contains one, either in a text or after its name."""
    if isinstance(value, str):
        return contains_credential(value)
    if not isinstance(value, list) or not _has_member_of(value, str):
        return False
    return is_secret_list(value) or (
        not _is_divided(value) and any(isinstance(one, str) and contains_credential(one) for one in value)
    )


def _is_divided(value: Any) -> bool:
    """Return whether the members of a value are fields of their own.

    This is the case for an object with members, and for a list that contains an object or a list.
    """
    if isinstance(value, dict):
        return bool(value)
    return isinstance(value, list) and _has_member_of(value, dict, list)


def _has_member_of(value: list[Any], *kinds: type) -> bool:
    """Return whether a list contains a value of one of the types, without a look at each number of a long list."""
    for found in set(map(type, value)):  # noqa: SIM110 - `any` makes a generator for each of a million lists
        if issubclass(found, kinds):
            return True
    return False


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
