"""Writing of clips as files for other programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from marey_motion.alignment.aligned_documents import restored_clip
from marey_motion.clip import Clip
from marey_motion.documents import clip_from_document, skeleton_from_document
from marey_motion.errors import MotionError
from marey_motion.formats import write_motion
from marey_motion.importing.source import SourceInfo
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.alignments import AlignmentInfo
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.formats import DEFAULT_UNIT, format_named
from marey_schemas.item_files import ItemToExport
from marey_schemas.options.exporting import MotionFileOptions
from marey_schemas.validation.reasons import first_reason

_CHANNELS: TypeAdapter[tuple[tuple[str, ...], ...]] = TypeAdapter(tuple[tuple[str, ...], ...])


@dataclass(frozen=True)
class ExportedFile:
    """A written file.

    Parameters
    ----------
    data : bytes    the content
    suffix : str    suffix for the name of the file, with the dot
    media_type : str    media type for HTTP
    """

    data: bytes
    suffix: str
    media_type: str


def write_clip_file(
    clip: Clip,
    file_format: str,
    *,
    unit: str | float = DEFAULT_UNIT,
    info: Mapping[str, Any] | None = None,
    fold_positions: bool = False,
) -> ExportedFile:
    """Write a clip in one of `marey_schemas.formats.MOTION_FORMATS`.

    Parameters
    ----------
    clip : Clip    the motion
    file_format : str    name of the format
    unit : str or float    unit of length, by name or in metres; used by formats without a fixed unit
    info : mapping, optional    the clip's `info` document, which contains the rotation orders of the imported file;
        Euler angles get these orders
    fold_positions : bool    in formats with position channels, give positions to the root alone

    Returns
    -------
    ExportedFile    the file with its suffix and media type

    Raises
    ------
    FormatError    if the format cannot hold the clip
    """
    row = format_named(file_format)
    options: dict[str, Any] = {}
    if len(row.units) > 1:
        options["unit"] = unit
    if row.euler:
        options |= {"source": _source(clip, info or {}), "fold_positions": fold_positions}
    return ExportedFile(write_motion(clip, file_format, **options), row.endings[0], row.media_type)


def write_motion_file(
    source: ItemToExport,
    options: MotionFileOptions,
    *,
    time: Literal["canonical", "source"] = "canonical",
    skeleton: Skeleton | None = None,
) -> ExportedFile:
    """Write the motion of a clip, or of an aligned clip, as a file.

    Parameters
    ----------
    source : ItemToExport    the item's documents; `hierarchy` is needed unless `skeleton` is given
    options : MotionFileOptions    format, one of `marey_schemas.formats.MOTION_FORMATS`, and its options
    time : str    for an aligned clip: "canonical" writes the aligned frames, "source" the restored original clip
    skeleton : Skeleton, optional    the skeleton, if it was already made from `hierarchy`

    Returns
    -------
    ExportedFile    the file with its suffix and media type

    Raises
    ------
    MotionError    if the documents are not valid, or the format cannot hold the motion
    """
    try:
        if skeleton is None:
            skeleton = skeleton_from_document(SkeletonHierarchy.model_validate(source.hierarchy))
        clip = clip_from_document(MotionDocument.model_validate(source.parts["motion"]), skeleton)
        if time == "source":
            clip = restored_clip(clip, AlignmentInfo.model_validate(source.parts["info"]).model_dump())
    except ValidationError as error:
        raise MotionError(first_reason(error), code="bad-document") from error
    return write_clip_file(
        clip, options.format, unit=options.unit, info=source.parts.get("info"), fold_positions=options.fold_positions
    )


def _source(clip: Clip, info: Mapping[str, Any]) -> SourceInfo | None:
    """Return the channels of the file from which a clip was imported, as stored in its document `info`.

    Returns None if `info`, which users may write, does not contain the channels, or if the number of joints has changed
    since the import.
    """
    details = (info.get("source") or {}).get("details") or {}
    try:
        channels = _CHANNELS.validate_python(details.get("channels"))
    except ValidationError:
        return None
    if len(channels) != clip.skeleton.joint_count:
        return None
    return SourceInfo(format="bvh", file="", unit_scale_m=1.0, up_axis="y", channels=channels)
