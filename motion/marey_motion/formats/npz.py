"""npz: a clip or skeleton as plain numpy arrays without rounding, for scripts.

The file is a zip archive of .npy members, which are never pickled. The same clip always gives the same bytes. The
members are:

    format            "marey/clip-npz@1"
    joint_names, display_names    (J,) text
    parents           (J,) int32, -1 for the root
    offsets           (J, 3) float64, metres
    rest_rotations    (J, 4) float64, w x y z
    end_site_joints, end_site_offsets    (E,) int32, (E, 3) float64
    frame_rate_hz     () float64                              only in a clip
    poses             (F, 3 + 4 J) float32                    only in a clip; as in `Clip`
    translated_joints, translations    (k,) int32, (F, k, 3) float32    only if joints below the root are translated
"""

from __future__ import annotations

import io
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.errors import FormatError, FormatLimit
from marey_motion.formats.numeric_text import excerpt
from marey_motion.formats.quaternion_rows import as_rotations
from marey_motion.formats.text_lines import decode_name
from marey_motion.importing.checks import CheckWarning
from marey_motion.importing.source import SourceMotion
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.skeletons import MAX_JOINTS
from marey_schemas.formats import MOST_UNPACKED_BYTES, ZIP_EPOCH

FORMAT = "npz"
MARK = "marey/clip-npz@1"
_MEMBERS_SHOWN = 12
_SKELETON_MEMBERS = (
    "joint_names",
    "display_names",
    "parents",
    "offsets",
    "rest_rotations",
    "end_site_joints",
    "end_site_offsets",
)
_MOTION_MEMBERS = ("frame_rate_hz", "poses")
_OPTIONAL_MEMBERS = ("translated_joints", "translations")
_STORED_BYTES = 4  # of a number of a clip
# Methods whose members `zipfile` unpacks only up to the declared size.
_BOUNDED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Errors that a damaged or hostile archive can raise; encryption and unknown compression raise RuntimeError.
_ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    OSError,
    OverflowError,
    RuntimeError,
    ValueError,
)


def write_npz(motion: Clip | Skeleton) -> bytes:
    """Write a clip, or only a skeleton.

    Parameters
    ----------
    motion : Clip or Skeleton    the content

    Returns
    -------
    bytes    content of the file
    """
    skeleton = motion.skeleton if isinstance(motion, Clip) else motion
    arrays: dict[str, NDArray[Any]] = {
        "format": np.array(MARK),
        "joint_names": np.array(skeleton.joint_names),
        "display_names": np.array(skeleton.display_names),
        "parents": skeleton.parents,
        "offsets": skeleton.offsets,
        "rest_rotations": skeleton.rest_rotations,
        "end_site_joints": np.array([site.joint for site in skeleton.end_sites], np.int32),
        "end_site_offsets": np.array([site.offset for site in skeleton.end_sites], np.float64).reshape(-1, 3),
    }
    if isinstance(motion, Clip):
        arrays |= {"frame_rate_hz": np.array(motion.frame_rate_hz), "poses": motion.poses}
        if motion.translations is not None:
            joints = np.array(motion.translated_joints, np.int32)
            arrays |= {"translated_joints": joints, "translations": motion.translations}
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as members:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.ascontiguousarray(array).reshape(array.shape), allow_pickle=False)
            members.writestr(zipfile.ZipInfo(f"{name}.npy", ZIP_EPOCH), content.getvalue())
    return archive.getvalue()


def read_npz(data: bytes, file: str, *, frame_rate_hz: float | None = None) -> SourceMotion:
    """Read an archive written by `write_npz`, or any other archive with the same members.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages
    frame_rate_hz : float, optional    replaces the frame rate in the file

    Returns
    -------
    SourceMotion    F frames of J joints, in metres; a source without motion if the archive contains no frames

    Raises
    ------
    FormatError    if a member is missing or invalid (the error names it), or if the content is larger than
        `MOST_UNPACKED_BYTES`
    """
    arrays = _read_members(data, file)
    if "format" not in arrays or str(arrays["format"]) != MARK:
        raise _foreign(data, file)
    needed = _SKELETON_MEMBERS + (_MOTION_MEMBERS if "poses" in arrays else ())
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise FormatError(f"the archive has no member {missing[0]!r}", file=file)
    return _source(arrays, file, frame_rate_hz)


def _foreign(data: bytes, file: str) -> FormatError:
    """Make the error for an npz archive of another kind, such as AMASS."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [excerpt(name.removesuffix(".npy").encode()) for name in archive.namelist()[:_MEMBERS_SHOWN]]
    if {"poses", "trans"} <= set(members):
        message = (
            "the archive holds parameters of a body model (SMPL, as in AMASS): rotations without a skeleton's bones; "
            "pose the model and export its joints as BVH, for instance with Blender's SMPL add-on"
        )
    else:
        listed = f"the members {', '.join(members)}" if members else "no members"
        message = f"member 'format' must contain the text {MARK}; the archive has {listed}"
    return FormatError(message, code="not-npz", file=file)


def _source(arrays: dict[str, NDArray[Any]], file: str, frame_rate_hz: float | None) -> SourceMotion:
    joints = arrays["joint_names"].size
    if not 1 <= joints <= MAX_JOINTS:
        raise FormatLimit(f"the file has {joints} joints; 1 to {MAX_JOINTS} are accepted", file=file)
    names = _names(arrays, "joint_names", joints, file)
    sites = _array(arrays, "end_site_joints", "i", (arrays["end_site_joints"].size,), file)
    tips = _array(arrays, "end_site_offsets", "f", (len(sites), 3), file).astype(np.float64)
    source = SourceMotion(
        format=FORMAT,
        joint_names=names,
        display_names=_names(arrays, "display_names", joints, file),
        parents=_array(arrays, "parents", "i", (joints,), file).astype(np.int32),
        offsets=_array(arrays, "offsets", "f", (joints, 3), file).astype(np.float64),
        rest_rotations=_array(arrays, "rest_rotations", "f", (joints, 4), file).astype(np.float64),
        end_sites=tuple((int(joint), tip) for joint, tip in zip(sites, tips, strict=True)),
        unit_scale_m=1.0,
        up_axis="y",
    )
    frames = len(np.atleast_1d(arrays["poses"])) if "poses" in arrays else 0
    if "poses" in arrays and not frames:
        message = "the file contains no frames; only its skeleton was read"
        source.warnings.append(CheckWarning("no-frames", message))
    if frames:
        poses = _array(arrays, "poses", "f", (frames, 3 + 4 * joints), file)
        if (size := poses.size * _STORED_BYTES) > MOST_UNPACKED_BYTES:  # in half precision, the archive has less
            raise FormatLimit(f"the poses need {size} bytes; at most {MOST_UNPACKED_BYTES} are accepted", file=file)
        source.root_positions = poses[:, :3].astype(np.float64)
        source.rotations = as_rotations(poses[:, 3:], names, file, source.warnings)
        source.frame_rate_hz = frame_rate_hz or float(_array(arrays, "frame_rate_hz", "f", (), file))
    if frames and "translations" in arrays and "translated_joints" in arrays:
        moved = _array(arrays, "translated_joints", "i", (arrays["translated_joints"].size,), file)
        if moved.size and not 1 <= moved.min() <= moved.max() < joints:
            raise FormatError(f"member 'translated_joints' must contain indices from 1 to {joints - 1}", file=file)
        source.translated_joints = tuple(moved.tolist())
        translations = _array(arrays, "translations", "f", (frames, len(moved), 3), file)
        source.translations = translations.astype(np.float64)
    return source


def _names(arrays: dict[str, NDArray[Any]], name: str, count: int, file: str) -> tuple[str, ...]:
    array = arrays[name]
    if array.dtype.kind not in "US" or array.shape != (count,):
        raise FormatError(
            f"member {name!r} has the type {array.dtype} and the shape {array.shape}, but must have text in the shape "
            f"({count},)",
            file=file,
        )
    return tuple(decode_name(one) if isinstance(one, bytes) else one for one in array.tolist())


def _array(arrays: dict[str, NDArray[Any]], name: str, kind: str, shape: tuple[int, ...], file: str) -> NDArray[Any]:
    array = arrays[name]
    if array.dtype.kind != kind or array.shape != shape:
        raise FormatError(
            f"member {name!r} has the type {array.dtype} and the shape {array.shape}, but must have "
            f"{('integers' if kind == 'i' else 'floating point numbers')} in the shape {shape}",
            file=file,
        )
    if kind == "f" and not np.isfinite(array).all():
        raise FormatError(f"member {name!r} contains numbers that are not finite", code="bad-number", file=file)
    return array


def _read_members(data: bytes, file: str) -> dict[str, NDArray[Any]]:
    known = {"format", *_SKELETON_MEMBERS, *_MOTION_MEMBERS, *_OPTIONAL_MEMBERS}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [info for info in archive.infolist() if info.filename.removesuffix(".npy") in known]
            foreign = next((info for info in members if info.compress_type not in _BOUNDED), None)
            if foreign is not None:
                raise FormatError(
                    f"member {foreign.filename!r} is compressed by a method that numpy does not use; save the arrays "
                    "with numpy.savez_compressed",
                    code="not-npz",
                    file=file,
                )
            total = sum(info.file_size for info in members)
            if total > MOST_UNPACKED_BYTES or len(members) > len(known):
                raise FormatLimit(
                    f"the archive unpacks to {total} bytes in {len(members)} files; at most {MOST_UNPACKED_BYTES} "
                    f"bytes in {len(known)} files are accepted",
                    file=file,
                )
            return {info.filename.removesuffix(".npy"): _read_member(archive, info) for info in members}
    except _ARCHIVE_ERRORS as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(
            f"the archive is damaged ({error}); copy or export the file again", code="not-npz", file=file
        ) from error


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> NDArray[Any]:
    """Read one array, and check that its data have the size given in its header."""
    with archive.open(info) as member:
        content = member.read(info.file_size)  # without a number, it would unpack more than the archive declares
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"member {info.filename} has .npy version {version}, but 1.0 is needed")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    size = dtype.itemsize
    for length in shape:
        size *= length
    if dtype.hasobject or size != len(content) - stream.tell():
        raise ValueError(f"member {info.filename} declares {size} bytes, but contains {len(content) - stream.tell()}")
    stream.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    return array
