"""Imported files in the formats of Marey's predecessor.

A file is exported again byte for byte as long as the part that the import created from it is unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.encoding.canonical import document_digest
from marey_schemas.names import Digest, base_name

CONTENT = {
    "model": (
        "name", "joints", "frame_rate_hz", "spatial", "temporal", "temporal_weight", "mixture", "keyframes",
    ),
    "time": ("temporal", "temporal_weight"),
    "tree": ("samples", "sizes", "children"),
    "graph": ("actions", "start"),
    "hierarchy": ("joints", "end_sites"),
    "mapping": ("joints", "axes"),
    "motion": ("joints", "frame_rate_hz", "poses", "translations", "translated_joints"),
    "alignment": ("time_function", "source_frames", "frame_rate_hz", "keyframes"),
    "annotation": ("segments", "keyframes"),
    "record": ("form", "fields", "fields_left_out"),
}  # fmt: skip
"""Names of the members whose values come from the imported file, by part.

`time` is the time function of a model, `alignment` the part `info` of an aligned clip.
"""


class StoredOriginal(Request):
    """Imported file from which a revision was read.

    `content` is the digest of those members of a part whose values were read from this file.
    """

    name: str = Field("", max_length=1024, description="Name of the file without its folders.")
    blob: Digest
    content: Digest


def content_digest(part: str, document: Mapping[str, Any]) -> str:
    """Return the digest of the members of a part that `CONTENT` lists: those that an import takes from a file.

    Arrays in `document` may be references.
    """
    return document_digest({name: document.get(name) for name in CONTENT[part]})


def original_of(part: str, document: Mapping[str, Any], file: str, digest: str) -> dict[str, Any]:
    """Return a `StoredOriginal`, as a dictionary, for a part that was imported from a file with the given digest."""
    content = content_digest(part, document)
    return StoredOriginal(name=base_name(file), blob=digest, content=content).model_dump()
