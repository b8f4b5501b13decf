"""Content of items, described without ids and digests, and the documents that have this content."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from tests.support.store_fixtures import motion_tree, skeleton_tree

from marey_schemas.encoding.canonical import document_digest
from marey_schemas.kinds import Kind

FRAMES, JOINTS = 12, 2
Parts = tuple[tuple[str, Hashable], ...]
"""Parts of a revision or an entry, as pairs (name, description of the part)."""


class Content(NamedTuple):
    """Content of a revision: the kind of the item, and a description of each part."""

    kind: Kind
    parts: Parts

    @classmethod
    def of(cls, kind: Kind, parts: Mapping[str, Hashable]) -> Content:
        return cls(kind, tuple(sorted(parts.items())))

    def replaced(self, part: str, value: Hashable) -> Content:
        return Content.of(self.kind, {**dict(self.parts), part: value})


class Hierarchy(NamedTuple):
    """Part of a skeleton."""

    bone_cm: int


class Motion(NamedTuple):
    """Part of a clip: random poses of a skeleton."""

    seed: int
    skeleton: Content


class Info(NamedTuple):
    """Part of a clip: a comment, and perhaps the file from which the clip was imported."""

    comment: str
    file: str | None = None


class Segment(NamedTuple):
    """Labelled frames from `start` up to, but not including, `end`."""

    start: int
    end: int
    label: str


class Keyframe(NamedTuple):
    """Labelled frame."""

    frame: int
    label: str


class Labels(NamedTuple):
    """Part of an annotation."""

    clip: Content
    segments: frozenset[Segment]
    keyframes: frozenset[Keyframe]


def references_of(content: Content) -> set[Content]:
    """Return all contents to which a content refers, directly or through other contents."""
    direct = {value.skeleton for _, value in content.parts if isinstance(value, Motion)}
    direct |= {value.clip for _, value in content.parts if isinstance(value, Labels)}
    return direct.union(*(references_of(one) for one in direct))


def files_of(content: Content) -> set[str]:
    """Return the digests of all files that are named in a content, or in contents to which this content refers."""
    found = {value.file for _, value in content.parts if isinstance(value, Info) and value.file is not None}
    return found.union(*(files_of(one) for one in references_of(content)))


def document(value: Hashable, reference: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the document of a part; `reference` is the document's reference to a revision, if it needs one."""
    match value:
        case Hierarchy(bone_cm):
            return skeleton_tree(JOINTS, bone_m=bone_cm / 128)
        case Motion(seed, _):
            assert reference is not None
            return motion_tree(reference, frames=FRAMES, joints=JOINTS, seed=seed)
        case Info(comment, file):
            source = {} if file is None else {"source": {"file": file, "file_name": "take.bvh"}}
            return {"schema": "marey/clip-info@1", "comment": comment, **source}
        case Labels(_, segments, keyframes):
            return {
                "schema": "marey/annotation@1",
                "clip": reference,
                "segments": [one._asdict() for one in sorted(segments)],
                "keyframes": [one._asdict() for one in sorted(keyframes)],
            }
    raise TypeError(value)


def same_document(found: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Return whether the document `found` has all members of the document `wanted`, arrays included."""
    return all(
        np.array_equal(found.get(name, ()), value) if isinstance(value, np.ndarray) else found.get(name) == value
        for name, value in wanted.items()
    )


@cache
def part_digest(value: Hashable) -> str:
    """Return the content digest of a part: the digest of its document, in which references are digests, not ids."""
    return document_digest(portable(value))


@cache
def content_digest(content: Content) -> str:
    """Return the content digest of a revision."""
    return document_digest({"kind": content.kind.value, "parts": part_digests(content.parts)})


def part_digests(parts: Parts) -> dict[str, str]:
    """Return the content digest of each part."""
    return {name: part_digest(value) for name, value in parts}


def portable(value: Hashable) -> dict[str, Any]:
    """Return the document of a part in the form that servers exchange."""
    reference = value.skeleton if isinstance(value, Motion) else value.clip if isinstance(value, Labels) else None
    return document(value, None if reference is None else {"content": content_digest(reference)})
