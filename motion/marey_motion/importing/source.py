"""Input and output of an import: options, the content of a file in its own units, and the record of what was done."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from marey_motion.clip import Clip
from marey_motion.importing.checks import CheckWarning
from marey_motion.skeleton import Skeleton

UpAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
Handedness = Literal["right", "left"]
Subject = Literal["model", "tree", "graph"]
UP_AXES: tuple[UpAxis, ...] = ("x", "y", "z", "-x", "-y", "-z")


@dataclass(frozen=True)
class ImportOptions:
    """Facts that the user knows better than the file; None means "infer, and record how".

    Parameters
    ----------
    unit_scale_m : metres per unit of length of the file
    up_axis : the axis of the file that points up
    handedness : "left" mirrors a left-handed file in x
    frame_rate_hz : replaces the file's rate
    trim_rest_pose : drop a rest pose before or after the motion, where `checks` finds one
    align_floor : lift or lower the motion so that its lowest contacts lie on y = 0
    """

    unit_scale_m: float | None = None
    up_axis: UpAxis | None = None
    handedness: Handedness = "right"
    frame_rate_hz: float | None = None
    trim_rest_pose: bool = False
    align_floor: bool = False

    def __post_init__(self) -> None:
        for name in ("unit_scale_m", "frame_rate_hz"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}, a positive number is needed")
        if self.up_axis is not None and self.up_axis not in UP_AXES:
            raise ValueError(f"up_axis is {self.up_axis!r}, one of {', '.join(UP_AXES)} is needed")
        if self.handedness not in ("right", "left"):
            raise ValueError(f"handedness is {self.handedness!r}, 'right' or 'left' is needed")


@dataclass(eq=False)
class SourceMotion:
    """A motion as its file has it: the file's unit of length and axes, rotations already quaternions.

    Parameters
    ----------
    format : name of the format
    joint_names, display_names, parents, offsets, rest_rotations : as in `Skeleton`, in the file's unit and axes
    end_sites : (joint, (3,) offset) pairs
    root_positions : (F, 3) float64, or None where the file holds no motion
    rotations : (F, J, 4) float32    unit, sign-continuous in time
    translations, translated_joints : local positions of joints below the root that replace their offsets, float64
    frame_rate_hz, declared_frame_time_s : rate to use, and what the file says
    unit_scale_m, up_axis, declared : what the format itself fixes, with the words for the record
    channels : per joint the names of its channels in the file's order
    warnings : what the reader had to overlook
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
    def skeleton(self) -> Skeleton:
        """The joints in the file's unit and axes."""
        return Skeleton(
            self.joint_names, self.parents, self.offsets, self.rest_rotations, display_names=self.display_names
        )


@dataclass(frozen=True)
class SourceDocument:
    """A decoded file that holds no motion: a model, a tree over the samples of a model, or a graph of models."""

    subject: Subject
    document: Mapping[str, Any]


@dataclass(frozen=True)
class SourceInfo:
    """Record of what an import found and did, kept with the clip.

    Parameters
    ----------
    format, file : name of the format and of the file
    unit_scale_m : metres per unit of the file
    up_axis, handedness : of the file
    frame_rate_hz, declared_frame_time_s : the rate used and the frame time as written
    channels : per joint the file's channel names in their order; empty for formats without channels
    trimmed_frames : frames dropped at the start and at the end
    floor_shift_m : what was added to every height
    evidence : why the unit and the axes are what they are
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
        """Plain JSON types."""
        return {
            **asdict(self),
            "channels": [list(names) for names in self.channels],
            "trimmed_frames": list(self.trimmed_frames),
            "evidence": list(self.evidence),
        }


@dataclass(frozen=True, eq=False)
class ImportedMotion:
    """A file in Marey's convention. `clip` is None where the file holds a skeleton alone."""

    clip: Clip | None
    skeleton: Skeleton
    source: SourceInfo
    warnings: tuple[CheckWarning, ...] = ()
