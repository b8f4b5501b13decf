"""What lists show and filter by, taken from the documents of a revision."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marey_schemas.kinds import Kind


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
