"""Input and output of the conversion of a file: the content in the file's units, and the record of the changes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.importing.checks import CheckWarning
from marey_motion.skeleton import Skeleton
from marey_schemas.options.imports import Handedness, UpAxis

Subject = Literal["model", "tree", "graph", "notes", "skeleton model", "zipped graph", "record"]


@dataclass(eq=False)
class SourceMotion:
    """A motion in the unit of length and the axes of its file, with rotations already as quaternions.

    Parameters
    ----------
    format : str    name of the format
    joint_names, display_names, parents, offsets, rest_rotations    as in `Skeleton`, in the file's unit and axes
    end_sites : tuple of (int, (3,) float64)    joint and offset of each
    root_positions : (F, 3) float64, optional    in the file's unit; None if the file holds no motion
    rotations : (F, J, 4) float32, optional    local unit quaternions (w, x, y, z), continuous in sign over time
    translations : (F, k, 3) float64, optional    local positions of joints below the root that replace their offsets,
        in the file's unit
    translated_joints : tuple of int    indices of the k joints with translations
    frame_rate_hz, declared_frame_time_s : float, optional    rate to use, and the frame time as written
    unit_scale_m : float, optional    metres per unit of the file; None if format and file do not state it
    up_axis : str, optional    axis that points up; None if format and file do not state it
    declared : tuple of str    sentences that say where the file states its unit; they become evidence in `SourceInfo`
    channels : tuple of tuples of str    names of each joint's channels in the file's order
    warnings : list of CheckWarning    defects that the reader tolerated
    """

    format: str
    joint_names: tuple[str, ...]
    display_names: tuple[str, ...]
    parents: NDArray[np.int32]
    offsets: NDArray[np.float64]
    rest_rotations: NDArray[np.float64]
    end_sites: tuple[tuple[int, NDArray[np.float64]], ...]
    root_positions: NDArray[np.float64] | None = None
    rotations: NDArray[np.float32] | None = None
    translations: NDArray[np.float64] | None = None
    translated_joints: tuple[int, ...] = ()
    frame_rate_hz: float | None = None
    declared_frame_time_s: float | None = None
    unit_scale_m: float | None = None
    up_axis: UpAxis | None = None
    declared: tuple[str, ...] = ()
    channels: tuple[tuple[str, ...], ...] = ()
    warnings: list[CheckWarning] = field(default_factory=list)

    @cached_property
    def rig_digest(self) -> str:
        """Digest of names, hierarchy and bones; equal for all takes of one rig.

        The digest ignores the root's offset, and the offsets of joints whose positions the motion contains, because
        these offsets differ from take to take. It also ignores the size of the body.
        """
        bones = self.offsets.copy()
        bones[[0, *self.translated_joints]] = 0.0
        size = float(np.abs(bones).sum()) or 1.0
        numbers = np.concatenate((bones / size, self.rest_rotations), axis=1).round(4) + 0.0
        content = repr((self.joint_names, self.parents.tolist(), numbers.tolist()))
        return hashlib.sha256(content.encode("utf-8", "surrogatepass")).hexdigest()

    @cached_property
    def skeleton(self) -> Skeleton:
        """The skeleton in the file's unit and axes."""
        return Skeleton(
            self.joint_names, self.parents, self.offsets, self.rest_rotations, display_names=self.display_names
        )


@dataclass(frozen=True)
class SourceDocument:
    """A decoded file of the predecessor that holds no motion.

    `subject` names the content: a model, a tree over the samples of a model, a graph of models, an annotation or an
    alignment of a motion, a skeleton model, a zipped graph, or a record of work. `document` is the decoded content. For
    a record of work, it has the members `form` and `content`. For a zipped graph (an archive of a graph with its
    models), it is empty, because the archive is decoded later.
    """

    subject: Subject
    document: Mapping[str, Any]


@dataclass(frozen=True)
class SourceInfo:
    """Record of the findings and changes of an import, stored with the clip.

    Parameters
    ----------
    format, file : str    name of the format and of the file
    unit_scale_m : float    metres per unit of the file
    up_axis, handedness : str    axes of the file
    frame_rate_hz, declared_frame_time_s : float, optional    the rate used and the frame time as written
    channels : tuple of tuples of str    names of each joint's channels in the file's order; empty for formats without
        channels
    trimmed_frames : (int, int)    frames dropped at the start and at the end
    floor_shift_m : float    metres added to every height
    evidence : tuple of str    reasons for the unit and the axes, as sentences
    """

    format: str
    file: str
    unit_scale_m: float
    up_axis: UpAxis
    handedness: Handedness = "right"
    frame_rate_hz: float | None = None
    declared_frame_time_s: float | None = None
    channels: tuple[tuple[str, ...], ...] = ()
    trimmed_frames: tuple[int, int] = (0, 0)
    floor_shift_m: float = 0.0
    evidence: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Convert the record to plain JSON types.

        Returns
        -------
        dict    one member per field
        """
        return {
            **{member.name: getattr(self, member.name) for member in fields(self)},
            "channels": [list(names) for names in self.channels],
            "trimmed_frames": list(self.trimmed_frames),
            "evidence": list(self.evidence),
        }


@dataclass(frozen=True, eq=False)
class ImportedMotion:
    """Content of a file, converted to Marey's convention: metres, Y up, right-handed.

    Parameters
    ----------
    clip : Clip, optional    the motion; None if the file holds a skeleton alone
    skeleton : Skeleton    its joints
    source : SourceInfo    record of the import
    warnings : tuple of CheckWarning    findings of the checks
    axis_is_clear : bool    true if the upward axis was inferred from a body that stands along it

    Examples
    --------
    >>> from marey_motion import generate_gait, read_motion, write_motion
    >>> read = read_motion(write_motion(generate_gait(1.2, 0.0, 2.0), "bvh"), "walk.bvh")
    >>> read.skeleton.joint_names[0], read.source.up_axis, read.source.format
    ('Hips', 'y', 'bvh')
    """

    clip: Clip | None
    skeleton: Skeleton
    source: SourceInfo
    warnings: tuple[CheckWarning, ...] = ()
    axis_is_clear: bool = False
