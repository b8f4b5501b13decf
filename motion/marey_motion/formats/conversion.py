"""Conversion of a file's unit and axes to metres and right-handed axes with Y up."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.errors import ClipError, ContradictedOption, FormatError, SkeletonError
from marey_motion.importing import checks
from marey_motion.importing.anatomy import Anatomy, anatomy_of
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.landmarks import KEPT_SKELETONS
from marey_motion.importing.source import ImportedMotion, SourceInfo, SourceMotion
from marey_motion.importing.units import infer_conversion
from marey_motion.skeleton import EndSite, Skeleton
from marey_schemas.documents.clips import MAX_FRAME_RATE_HZ, MIN_FRAME_RATE_HZ
from marey_schemas.lru import LruCache
from marey_schemas.options.imports import ImportOptions, UpAxis

Real = TypeVar("Real", np.float32, np.float64)

_LARGEST_LENGTH = 1e12
_FASTEST_BODY_M_S = 30.0
"""Greatest plausible median speed of a body, in metres per second; no animal on the ground is faster for long."""
_USUAL_RATES_HZ = (10.0, 1000.0)

# Rows are the file's axes that become x, y, z; each matrix is a rotation.
_TO_Y_UP: dict[UpAxis, list[list[int]]] = {
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}

_CONVERTED: LruCache[tuple[Anatomy, tuple[tuple[int, bytes], ...], bytes, float], Skeleton] = LruCache(
    max_entries=KEPT_SKELETONS
)
"""Cache of converted skeletons, by their inputs: the skeleton, end sites, axes and unit of the file."""


def convert(
    source: SourceMotion, file: str, options: ImportOptions, sibling_axis: UpAxis | None = None
) -> ImportedMotion:
    """Convert a motion from the unit and axes of its file to a clip, and record the import.

    Parameters
    ----------
    source : SourceMotion    the file in its own unit and axes; the function sets its motion to None to save memory
    file : str    name of the file, for messages
    options : ImportOptions    facts given by the user
    sibling_axis : str, optional    upward axis of other files with this skeleton; used if the file does not determine
        its own upward axis

    Returns
    -------
    ImportedMotion    clip and skeleton in metres, Y up

    Raises
    ------
    AmbiguousUnits    if neither the file nor the options state the unit or the upward axis, and the size and pose of
        the body do not determine it
    ContradictedOption    if the motion clearly contradicts a given unit, upward axis or frame rate
    FormatError    if a length or the frame rate is out of range, or if the numbers are not a valid skeleton or clip
    """
    _check_range(source, file)
    try:
        anatomy = anatomy_of(source)
        found = infer_conversion(source, anatomy, file, options, sibling_axis)
        axes = np.array(_TO_Y_UP[found.up_axis], np.float64)
        if found.handedness == "left":
            axes[0] = -axes[0]
        tips = tuple((joint, offset.tobytes()) for joint, offset in source.end_sites)
        skeleton = _CONVERTED.get_or_make(
            (anatomy, tips, axes.tobytes(), found.unit_scale_m),
            lambda: anatomy_of(_converted_skeleton(source, axes, found.unit_scale_m)).skeleton,
        )
        warnings = [*source.warnings, *found.warnings, *_notices(source, found.up_axis)]
        clip = _converted_clip(source, skeleton, axes, found.unit_scale_m)
        if options.frame_rate_hz is not None and clip is not None and not options.trust_options:
            _compare_rate_with_speed(clip, file)
    except (SkeletonError, ClipError) as error:
        raise FormatError(str(error), code=error.code, file=file) from error
    trimmed, floor_shift_m = (0, 0), 0.0
    if clip is not None:
        if options.trim_rest_pose:
            clip, trimmed = checks.without_rest_pose(clip)
        if options.align_floor:
            clip, floor_shift_m = checks.on_the_floor(clip)
        warnings += checks.check_clip(clip, anatomy.landmarks)  # last: of the clip that is kept
    info = SourceInfo(
        format=source.format,
        file=file,
        unit_scale_m=found.unit_scale_m,
        up_axis=found.up_axis,
        handedness=found.handedness,
        frame_rate_hz=source.frame_rate_hz if clip is not None else None,
        declared_frame_time_s=source.declared_frame_time_s,
        channels=source.channels,
        trimmed_frames=trimmed,
        floor_shift_m=floor_shift_m,
        evidence=found.evidence,
    )
    return ImportedMotion(clip, skeleton, info, tuple(warnings), found.axis_is_clear)


def _check_range(source: SourceMotion, file: str) -> None:
    """Refuse frame rates that no clip may have, and lengths so large that their squares or float32 values overflow."""
    rate_hz = source.frame_rate_hz
    if rate_hz is not None and not MIN_FRAME_RATE_HZ <= rate_hz <= MAX_FRAME_RATE_HZ:
        message = (
            f"the frame rate is {rate_hz:.6g} Hz, but must be from {MIN_FRAME_RATE_HZ} to {MAX_FRAME_RATE_HZ:.0f} Hz; "
            "set the rate with --fps (frame_rate_hz)"
        )
        raise FormatError(message, code="value-range", file=file)
    tips = np.array([offset for _, offset in source.end_sites])
    for values in (source.offsets, tips, source.root_positions, source.translations):
        if values is not None and np.abs(values).max(initial=0.0) > _LARGEST_LENGTH:
            largest = np.abs(values).max()
            message = (
                f"the file contains a length of {largest:.3g} units; the limit is {_LARGEST_LENGTH:.0e}; correct this "
                "length in the file"
            )
            raise FormatError(message, code="value-range", file=file)


def _compare_rate_with_speed(clip: Clip, file: str) -> None:
    """Refuse a frame rate given by the user if the median speed of the body would be greater than any animal's."""
    speeds_m_s = np.linalg.norm(np.diff(clip.root_translations, axis=0), axis=1) * clip.frame_rate_hz
    if len(speeds_m_s) and (typical := float(np.median(speeds_m_s))) > _FASTEST_BODY_M_S:
        raise ContradictedOption(
            f"the frame rate of {clip.frame_rate_hz:g} Hz contradicts the motion: the body would move at "
            f"{typical:.0f} m/s or faster half of the time; give the right rate with --fps (frame_rate_hz), or confirm "
            "this rate with --trust-options (trust_options)",
            file=file,
        )


def _converted_skeleton(source: SourceMotion, axes: NDArray[np.float64], scale: float) -> Skeleton:
    return Skeleton(
        joint_names=source.joint_names,
        parents=source.parents,
        offsets=_moved(source.offsets, axes, scale),
        rest_rotations=_turned(source.rest_rotations, axes),
        end_sites=tuple(EndSite(joint, _moved(offset, axes, scale)) for joint, offset in source.end_sites),
        display_names=source.display_names,
    )


def _converted_clip(source: SourceMotion, skeleton: Skeleton, axes: NDArray[np.float64], scale: float) -> Clip | None:
    if source.rotations is None or source.root_positions is None or source.frame_rate_hz is None:
        return None
    frames = len(source.rotations)
    poses = np.empty((frames, 3 + 4 * skeleton.joint_count), np.float32)
    poses[:, :3] = _moved(source.root_positions, axes, scale)
    poses[:, 3:] = _turned(source.rotations, axes).reshape(frames, -1)
    # The source is not needed any more; a long file must not be held three times.
    source.rotations = source.root_positions = None
    translations = None
    if source.translations is not None:
        translations = _moved(source.translations, axes, scale).astype(np.float32)
        source.translations = None
    return Clip(skeleton, source.frame_rate_hz, poses, translations, source.translated_joints)


def _moved(vectors: NDArray[np.float64], axes: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Convert vectors (..., 3) to metres, by the factor `scale`, and to Marey's axes.

    The rows of `axes` (3, 3) are Marey's axes in the axes of the file. If neither the unit nor the axes change, the
    result equals the input exactly.
    """
    turned = vectors if _same_axes(axes) else vectors @ axes.T
    return turned if scale == 1.0 else turned * scale


def _same_axes(axes: NDArray[np.float64]) -> bool:
    return bool(axes.tolist() == _TO_Y_UP["y"])


def _turned(rotations: NDArray[Real], axes: NDArray[np.float64]) -> NDArray[Real]:
    """Convert rotations to other axes, exactly. A mirrored axis also reverses the direction of rotation."""
    if _same_axes(axes):
        return rotations
    sense = np.rint(np.linalg.det(axes))
    result = np.empty_like(rotations)
    result[..., 0] = rotations[..., 0]
    for row, old in enumerate(np.abs(axes).argmax(axis=1)):
        result[..., 1 + row] = rotations[..., 1 + old] * (sense * axes[row, old])
    return result


def _notices(source: SourceMotion, up_axis: UpAxis) -> list[CheckWarning]:
    """List warnings: changes that reader and conversion made to the data, and unusual properties of the file."""
    notices = []
    if up_axis != "y":
        message = f"the file has {up_axis} up; it was turned to y up"
        notices.append(CheckWarning("up-axis-converted", message, values={"up_axis": up_axis}))
    rate_hz = source.frame_rate_hz
    if source.rotations is not None and rate_hz is not None and not _USUAL_RATES_HZ[0] <= rate_hz <= _USUAL_RATES_HZ[1]:
        message = f"the frame rate is {rate_hz:g} Hz, so the motion takes {len(source.rotations) / rate_hz:.4g} s"
        notices.append(CheckWarning("frame-rate-doubtful", message, values={"frame_rate_hz": rate_hz}))
    listed = _rotation_orders(source.channels)
    if len(listed) > 1:
        message = f"rotation orders differ between joints ({', '.join(listed)}); each joint is read in its own order"
        notices.append(CheckWarning("mixed-rotation-orders", message, values={"orders": list(listed)}))
    repeated = [name for name, shown in zip(source.joint_names, source.display_names, strict=True) if name != shown]
    if repeated:
        message = f"{len(repeated)} joint names occur more than once; the parent's name was put before each of them"
        notices.append(CheckWarning("duplicate-joint-names", message, joints=tuple(repeated)))
    return notices


@lru_cache(maxsize=KEPT_SKELETONS)
def _rotation_orders(channels: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """List the rotation orders of the joints with more than one rotation channel."""
    orders = {"".join(name[0] for name in names if name.endswith("rotation")) for names in channels}
    return tuple(sorted(order for order in orders if len(order) > 1))
