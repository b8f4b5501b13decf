"""Reader and writer of the clip documents that Marey's predecessor stores in its database.

Lengths are centimetres. Stored clips are mirrored in x for a left-handed engine: a translation (x, y, z) is stored as
(-x, y, z) and a rotation (w, x, y, z) as (-w, -x, y, z), so the same conversion serves for reading and writing. The
root's translation is added to the root's offset. A clip document contains the names of the joints, but not their
hierarchy, so reading a clip needs its skeleton document, too.
"""

from __future__ import annotations

from collections import Counter
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.errors import FormatError
from marey_motion.formats.document_fields import field_of, number_array, text_list
from marey_motion.formats.frame_times import frame_rate_of, frame_time_to_write
from marey_motion.formats.predecessor.encoding import Encoding, decode_document, encode_document
from marey_motion.formats.predecessor.skeleton import (
    CENTIMETRE_M,
    MIRROR_ROTATION,
    MIRROR_VECTOR,
    SkeletonForm,
    read_skeleton_document,
    skeleton_document,
    source_of_skeleton,
)
from marey_motion.formats.quaternion_rows import as_rotations
from marey_motion.formats.unpacking import require_unpackable
from marey_motion.importing.source import SourceMotion
from marey_motion.skeleton import Skeleton

ClipForm = Literal["poses", "frames"]


def motion_of_document(
    document: dict[str, Any],
    file: str,
    *,
    skeleton: bytes | Skeleton | None = None,
    skeleton_file: str = "the skeleton document",
    frame_rate_hz: float | None = None,
) -> SourceMotion:
    """Read a clip document together with its skeleton document, or a skeleton document alone.

    Parameters
    ----------
    document : dict    the decoded document
    file : str    name of the file, for messages
    skeleton : bytes or Skeleton, optional    content of the file with the skeleton document, or the skeleton
    skeleton_file : str    name of this file, for messages
    frame_rate_hz : float, optional    replaces the document's rate

    Returns
    -------
    SourceMotion    in centimetres

    Raises
    ------
    FormatError    if a document is invalid (the error names the field, and the joint if there is one), or if a clip
        document is read without a skeleton
    """
    if "poses" not in document and "frames" not in document:
        return read_skeleton_document(document, file)
    if skeleton is None:
        raise FormatError(
            "a clip document contains no hierarchy of its joints; import it together with its skeleton document, "
            "which is called skeleton.json or, for walk_01 in a folder with several, walk_skeleton.json; or name a "
            "skeleton of the project with --skeleton (in requests: skeleton)",
            code="skeleton-missing",
            file=file,
        )
    if isinstance(skeleton, Skeleton):
        source = source_of_skeleton(skeleton)
    else:
        source = read_skeleton_document(decode_document(skeleton, skeleton_file), skeleton_file)
    names, poses, frame_time_s = _clip_fields(document, file)
    _fill_motion(source, names, poses, file)
    source.declared_frame_time_s = frame_time_s
    source.frame_rate_hz = frame_rate_hz or frame_rate_of(frame_time_s, file, source.warnings)
    return source


def write_predecessor(clip: Clip, *, form: ClipForm = "poses", encoding: Encoding = "bson.bz2") -> bytes:
    """Write a clip as a document of Marey's predecessor.

    Parameters
    ----------
    clip : Clip    F frames
    form : str    "poses" for one row of numbers per frame; "frames" for one object per frame, the form that the engine
        reads
    encoding : str    "json", "bson" or "bson.bz2"

    Returns
    -------
    bytes    content of the file

    Raises
    ------
    FormatError    if joints below the root have translations, which the format cannot contain, or if the frame rate is
        less than 1 Hz or more than 100 kHz
    """
    skeleton = clip.skeleton
    if clip.translated_joints:
        raise FormatError(
            "clips in the predecessor's format contain only rotations, but this joint also moves relative to "
            "its parent; choose another format",
            code="translations-unsupported",
            joint=skeleton.joint_names[clip.translated_joints[0]],
        )
    root = (clip.root_translations.astype(np.float64) - skeleton.offsets[0]) / CENTIMETRE_M * MIRROR_VECTOR
    rotations = clip.rotations.astype(np.float64) * MIRROR_ROTATION
    frame_time_s = frame_time_to_write(clip.frame_rate_hz)
    if form == "poses":
        rows = np.concatenate([root, rotations.reshape(clip.frame_count, -1)], axis=1)
        return encode_document(
            {"poses": rows.tolist(), "frame_time": frame_time_s, "joint_sequence": list(skeleton.joint_names)}, encoding
        )
    frames = [
        {
            "rootTranslation": dict(zip("xyz", translation, strict=True)),
            "rotations": [dict(zip("wxyz", rotation, strict=True)) for rotation in pose],
        }
        for translation, pose in zip(root.tolist(), rotations.tolist(), strict=True)
    ]
    document = {"frames": frames, "frameTime": frame_time_s, "jointSequence": list(skeleton.joint_names)}
    return encode_document(document, encoding)


def write_predecessor_skeleton(
    skeleton: Skeleton, *, form: SkeletonForm = "database", encoding: Encoding = "json"
) -> bytes:
    """Write a skeleton document of Marey's predecessor.

    Parameters
    ----------
    skeleton : Skeleton    J joints
    form : str    "database": a list of joints, mirrored in x; "file": nested nodes
    encoding : str    "json", "bson" or "bson.bz2"

    Returns
    -------
    bytes    content of the file
    """
    return encode_document(skeleton_document(skeleton, form=form), encoding)


def _clip_fields(document: dict[str, Any], file: str) -> tuple[list[str], NDArray[np.float64], float]:
    """Read the joint names, the poses and the frame time of a clip document of either form ("poses" or "frames").

    The rows of the poses (F, 3 + 4·J) contain the root's translation and quaternions w, x, y, z.
    """
    if "poses" in document:
        names = text_list(document, "joint_sequence", file)
        poses = number_array(document["poses"], file, "poses")
        frame_time_s = field_of(document, "frame_time", (int, float), file)
    else:
        names = text_list(document, "jointSequence", file)
        poses = _engine_rows(field_of(document, "frames", list, file), file)
        frame_time_s = field_of(document, "frameTime", (int, float), file)
    repeated = next((name for name, count in Counter(names).items() if count > 1), None)
    if repeated is not None:
        raise FormatError("the joint sequence contains this joint twice; remove one entry", file=file, joint=repeated)
    width = 3 + 4 * len(names)
    if poses.ndim != 2 or len(poses) == 0 or poses.shape[1] < width:
        raise FormatError(
            f"the poses have the shape {poses.shape}, but {len(names)} joints need rows of {width} numbers", file=file
        )
    # Some writers counted the tips of chains as joints and filled their columns with zeros.
    if poses[:, width:].any():
        raise FormatError(
            f"the poses have {poses.shape[1]} columns, but {len(names)} joints need {width} columns", file=file
        )
    return names, poses[:, :width], float(frame_time_s)


def _engine_rows(frames: list[Any], file: str) -> NDArray[np.float64]:
    try:
        rows = [
            [frame["rootTranslation"][axis] for axis in "xyz"]
            + [rotation[part] for rotation in frame["rotations"] for part in "wxyz"]
            for frame in frames
        ]
    except (KeyError, TypeError) as error:
        message = f"a frame needs rootTranslation {{x, y, z}} and rotations [{{x, y, z, w}}]: {error!r}"
        raise FormatError(message, file=file) from error
    return number_array(rows, file, "frames")


def _fill_motion(source: SourceMotion, names: list[str], poses: NDArray[np.float64], file: str) -> None:
    """Set the rotations and root positions of `source`, which already has its skeleton, from the poses of a clip.

    Joints that are missing from the clip get their rest rotation.
    """
    indices = {name: joint for joint, name in enumerate(source.joint_names)}
    unknown = next((name for name in names if name not in indices), None)
    if unknown is not None:
        raise FormatError(
            "the skeleton has no joint of this name; check that it is the skeleton of this clip",
            file=file,
            joint=unknown,
        )
    require_unpackable(len(poses), len(indices), poses.size, file)
    given = poses[:, 3:].reshape(len(poses), len(names), 4) * MIRROR_ROTATION
    rotations = np.tile(source.rest_rotations, (len(poses), 1, 1))
    rows = given.reshape(len(poses), 4 * len(names))
    rotations[:, [indices[name] for name in names]] = as_rotations(rows, tuple(names), file, source.warnings)
    source.rotations = rotations.astype(np.float32)
    source.root_positions = poses[:, :3] * MIRROR_VECTOR + source.offsets[0]
