"""What lists show and filter by, taken from the documents of a revision."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marey_schemas.kinds import Kind

LABELS_SHOWN = 32
"""Of an annotation, those of most segments."""


@dataclass(frozen=True, slots=True)
class Summary:
    """The summary of an item, and those of its facts that are columns."""

    shown: dict[str, Any]
    frames: int = 0
    skeleton_id: str | None = None


def summarise(kind: Kind, bodies: Mapping[str, dict[str, Any]]) -> Summary:
    """Summary of a revision from its parts' bodies (arrays as references)."""
    if kind is Kind.SKELETON:
        return Summary({"joints": len(bodies["hierarchy"]["joints"])})
    if kind is Kind.EVALUATION:
        return Summary({"verdict": bodies["evaluation"]["verdict"], **bodies["evaluation"]["headline"]})
    if kind is Kind.ANNOTATION:
        return Summary(_said(bodies["annotation"]))
    if kind is not Kind.CLIP:
        return Summary({})
    motion, info = bodies["motion"], bodies.get("info", {})
    frames = motion["poses"]["shape"][0]
    shown = {
        "frames": frames,
        "frame_rate_hz": motion["frame_rate_hz"],
        "duration_s": frames / motion["frame_rate_hz"],
        "joints": len(motion["joints"]),
        "skeleton": motion["skeleton"]["item"],
        "warnings": sorted({check["code"] for check in info.get("checks", ())}),
    }
    return Summary(shown, frames, motion["skeleton"]["item"])


def _said(annotation: Mapping[str, Any]) -> dict[str, Any]:
    clip, segments = annotation["clip"], annotation.get("segments", ())
    labels = Counter(segment["label"] for segment in segments)
    return {
        "clip": clip["item"],
        "clip_revision": clip["revision"],
        "layer": annotation.get("layer", "default"),
        "made_by": annotation.get("made_by", "person"),
        "segments": len(segments),
        "keyframes": len(annotation.get("keyframes", ())),
        "labels": dict(labels.most_common(LABELS_SHOWN)),
    }
