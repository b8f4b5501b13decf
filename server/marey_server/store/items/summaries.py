"""Summaries of revisions, shown in lists and used by their filters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marey_schemas.documents.clips import TakeRecord
from marey_schemas.kinds import Kind

SKELETON_PARTS = {Kind.CLIP: "motion", Kind.PROCESSED: "motion", Kind.MODEL: "model"}
"""Kinds of items that use a skeleton, with the part that refers to it."""
LABELS_SHOWN = 32
"""Greatest number of labels in the summary of an annotation; the labels with the most segments are kept."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of an item (`shown`), and those of its values that are also columns of the table `item`."""

    shown: dict[str, Any]
    frames: int = 0
    skeleton_id: str | None = None


def skeleton_of(kind: Kind, bodies: Mapping[str, dict[str, Any]]) -> dict[str, Any] | None:
    """Return the reference to the skeleton of an item, given the documents of its parts; None if it has none."""
    reference: dict[str, Any] | None = bodies.get(SKELETON_PARTS.get(kind, ""), {}).get("skeleton")
    return reference


def summarise(kind: Kind, bodies: Mapping[str, dict[str, Any]]) -> Summary:
    """Return the summary of a revision from the documents of its parts, which have references in place of arrays."""
    skeleton = (skeleton_of(kind, bodies) or {}).get("item")
    if kind is Kind.SKELETON:
        return Summary({"joints": len(bodies["hierarchy"]["joints"])})
    if kind is Kind.EVALUATION:
        return Summary({"verdict": bodies["evaluation"]["verdict"], **bodies["evaluation"]["headline"]})
    if kind is Kind.MODEL:
        model = bodies["model"]
        shown = {"verdict": model.get("verdict", ""), "skeleton": skeleton, **model.get("headline", {})}
        return Summary(shown, skeleton_id=skeleton)
    if kind is Kind.INDEX:
        return Summary({name: bodies["index"].get(name, 0) for name in ("clips", "rows", "left_out")})
    if kind is Kind.ANNOTATION:
        return Summary(_said(bodies["annotation"]))
    if kind is Kind.CLIP:
        info = bodies.get("info", {})
        warnings = sorted({check["code"] for check in info.get("checks", ())})
        return _moved(bodies["motion"], skeleton, {"warnings": warnings, **take_record(info)})
    if kind is Kind.PROCESSED:
        return _moved(bodies["motion"], skeleton, _aligned(bodies["info"]))
    if kind is Kind.RECORD:
        record = bodies["record"]
        return Summary({"form": record["form"], "fields": len(record.get("fields", {}))})
    if kind is Kind.STUDY:
        study = bodies["study"]
        return Summary({"title": study["title"], "motions": len(study["motions"])})
    return Summary({})


def take_record(info: Mapping[str, Any]) -> dict[str, Any]:
    """Return those fields of the take record (facts about the recording) that are set in the part `info` of a clip."""
    return {name: info[name] for name in TakeRecord.model_fields if info.get(name)}


def _moved(motion: Mapping[str, Any], skeleton: str | None, known: Mapping[str, Any]) -> Summary:
    """Return the summary of a motion: its length, rate, joints and skeleton, and the members of `known`."""
    frames = motion["poses"]["shape"][0]
    shown = {
        "frames": frames,
        "frame_rate_hz": motion["frame_rate_hz"],
        "duration_s": frames / motion["frame_rate_hz"],
        "joints": len(motion["joints"]),
        "skeleton": skeleton,
        **known,
    }
    return Summary(shown, frames, skeleton)


def _aligned(info: Mapping[str, Any]) -> dict[str, Any]:
    clip, reference = (info.get(name) or {} for name in ("clip", "reference"))
    return {
        "clip": clip.get("item"),
        "clip_revision": clip.get("revision"),
        "mirrored": bool(clip.get("mirrored")),
        "reference": reference.get("item"),
        "set": info.get("set"),
        "source_frames": info["source_frames"],
        "cost": info.get("cost", 0.0),
        "keyframes": len(info.get("keyframes", {})),
    }


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
