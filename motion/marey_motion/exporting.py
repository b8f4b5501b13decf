"""Clips as files for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marey_motion.clip import Clip
from marey_motion.formats import write_bvh, write_npz, write_predecessor_clip
from marey_motion.importing.source import SourceInfo


@dataclass(frozen=True)
class ExportedFile:
    """The bytes of a file, the ending of its name, and its media type."""

    data: bytes
    suffix: str
    media_type: str


def write_clip_file(
    clip: Clip, file_format: str, *, unit: str | float = "cm", info: Mapping[str, Any] | None = None
) -> ExportedFile:
    """Write a clip as `bvh`, `npz` or `predecessor`.

    Parameters
    ----------
    unit : unit of length of a BVH, by name or in metres
    info : the clip's `info` document; a BVH keeps the rotation orders of the file it came from

    Raises
    ------
    FormatError    where the format cannot hold the clip
    """
    if file_format == "bvh":
        return ExportedFile(write_bvh(clip, unit=unit, source=_source(clip, info or {})), ".bvh", "text/plain")
    if file_format == "npz":
        return ExportedFile(write_npz(clip), ".npz", "application/x-npz")
    if file_format == "predecessor":
        return ExportedFile(write_predecessor_clip(clip), ".bson.bz2", "application/x-bzip2")
    raise ValueError(f"no writer for {file_format!r}")


def _source(clip: Clip, info: Mapping[str, Any]) -> SourceInfo | None:
    """The rotation orders of the file a clip came from, where it is still on that file's skeleton."""
    details = info.get("source", {}).get("details", {})
    channels = tuple(tuple(names) for names in details.get("channels", ()))
    if len(channels) != clip.skeleton.joint_count:
        return None
    return SourceInfo(format="bvh", file="", unit_scale_m=1.0, up_axis="y", channels=channels)
