"""Fields that queries refer to, and the operators that compare them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

FieldType = Literal["text", "number", "date"]
FACET_PREFIX = "facet."
"""Beginning of the names of facets in queries and lists: `facet.usage > 0.01`."""
OPERATORS: dict[FieldType, tuple[str, ...]] = {
    "text": ("=", "!=", "~", "in", "has"),
    "number": ("=", "!=", "<", "<=", ">", ">=", "in", "has"),
    "date": ("=", "!=", "<", "<=", ">", ">=", "in", "has"),
}
"""Operators by the type of a field."""


@dataclass(frozen=True, slots=True)
class QueryField:
    """Field of items that queries refer to by name."""

    type: FieldType
    description: str


FIELDS: dict[str, QueryField] = {
    "name": QueryField("text", "Name of the item."),
    "path": QueryField("text", "Folder and name, as in `walks/take-01`."),
    "folder": QueryField("text", "Folder that contains the item, or a folder above it."),
    "tag": QueryField("text", "Any tag of the item."),
    "revision": QueryField("number", "Number of the newest revision."),
    "created": QueryField("date", "Day or time, in UTC, at which the item was created."),
    "updated": QueryField("date", "Day or time, in UTC, of the last change of the item."),
    "frames": QueryField("number", "Number of frames."),
    "duration": QueryField("number", "Duration in seconds."),
    "rate": QueryField("number", "Frames per second."),
    "joints": QueryField("number", "Number of joints."),
    "skeleton": QueryField("text", "Name or id of the skeleton."),
    "warning": QueryField("text", "Code of any of the item's warnings from the import checks."),
    "subject": QueryField("text", "Performer, under a pseudonym."),
    "action": QueryField("text", "What the performer does."),
    "take": QueryField("text", "Take, as the studio numbers it."),
    "shoot_day": QueryField("date", "Day of the recording."),
    "select": QueryField("text", "Choice of the director: `best`, `good` or `no good`."),
    "licence": QueryField("text", "Licence of the recording."),
    "capture_system": QueryField("text", "System that recorded the motion."),
    "consent_until": QueryField("date", "Last day of the performer's consent."),
}
"""All fields by name, except facets."""


@cache
def declared_facets() -> dict[str, str]:
    """Return the meanings of the facets that the installed job kinds declare, by name."""
    from marey_schemas.queue.job_kinds import job_kinds  # which takes longer to import than most queries to parse

    return {name: meaning for kind in job_kinds().values() for name, meaning in kind.facets.items()}


def find_field(name: str) -> QueryField | None:
    """Return the field or facet called `name`, or None if there is none."""
    if not name.startswith(FACET_PREFIX):
        return FIELDS.get(name)
    meaning = declared_facets().get(name.removeprefix(FACET_PREFIX))
    return None if meaning is None else QueryField("number", meaning)


def field_names() -> list[str]:
    """Return the names of all fields and of all declared facets (published numbers) that queries can use."""
    return [*FIELDS, *(f"{FACET_PREFIX}{name}" for name in declared_facets())]
