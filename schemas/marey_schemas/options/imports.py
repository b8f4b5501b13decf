"""Options of imports: facts that the files do not contain."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from marey_schemas.base import Options
from marey_schemas.formats import UNITS_M, EndIndex, LengthUnit
from marey_schemas.names import MOST_TAGS, ReceivingPath, Tag

UpAxis = Literal["x", "y", "z", "-x", "-y", "-z"]
Handedness = Literal["right", "left"]


class ImportOptions(Options):
    """Facts that the user knows about the files to import, and choices for the import.

    If unit, upward axis or frame rate is absent, it is inferred from the file; the file is refused if unit or upward
    axis is ambiguous. Handedness is not inferred: absent means right-handed. `marey_motion.read_motion` uses the facts
    about the content of a file: unit, axes, frame rate, rest pose and floor.

    Examples
    --------
    >>> from marey_motion import ImportOptions, generate_gait, read_motion, write_motion
    >>> walk = write_motion(generate_gait(1.2, 0.0, 2.0), "bvh")
    >>> read_motion(walk, "walk.bvh", options=ImportOptions(frame_rate_hz=30.0)).clip.duration_s
    4.0
    """

    collection: ReceivingPath = Field("", description="Folder of the project that receives the clips.")
    skeleton: str | None = Field(
        None,
        description="Item id of the skeleton that the clips must use. `marey upload` also accepts its address "
        "(project/folder/name), and Python its path. Absent: the skeleton of the file is used; it is created if "
        "the project does not have it.",
    )
    unit: LengthUnit | None = Field(
        None, description="Unit of length of the files; cmu is 1/0.45 inch. Absent: inferred."
    )
    unit_scale_m: float | None = Field(
        None,
        gt=1e-6,
        lt=1e3,
        description="Metres per unit of length, for units without a name; an alternative to `unit`. Absent: inferred.",
    )
    up_axis: UpAxis | None = Field(None, description="Axis that points up in the files. Absent: inferred.")
    handedness: Handedness = Field(
        "right", description="Handedness of the axes in the files. left: the motion is mirrored."
    )
    align_floor: bool = Field(
        False, description="Shift each clip vertically, so that its feet are on the ground at height 0."
    )
    frame_rate_hz: float | None = Field(
        None, gt=0, le=100_000, description="Frame rate of the clips, in hertz. Absent: the rate in the files."
    )
    trust_options: bool = Field(
        False,
        description="Use unit, up axis and frame rate as given, even if the motion contradicts them; otherwise, "
        "files with a contradiction are refused.",
    )
    end_index: EndIndex | None = Field(
        None,
        description="Meaning of `end_idx`, the last index of a section in annotation files of Marey's "
        "predecessor. inclusive: the section includes this frame, as in the predecessor's editor; "
        "exclusive: it ends before this frame, as in the predecessor's time warping. Absent: "
        "exclusive if sections would overlap otherwise, else inclusive.",
    )
    replace_skeleton: bool = Field(
        False,
        description="Make a new revision of a clip or model of the same name, even if the file has another skeleton; "
        "otherwise, a file with another skeleton is refused.",
    )
    trim_rest_pose: bool = Field(False, description="Remove rest poses at the beginning and at the end of each clip.")
    tags: tuple[Tag, ...] = Field((), max_length=MOST_TAGS, description="Tags that every clip gets.")
    subject: str | None = Field(None, max_length=255, description="Performer, under a pseudonym.")
    licence: str | None = Field(None, max_length=255, description="Licence of the data.")
    capture_system: str | None = Field(None, max_length=255, description="The device or system that recorded the data.")

    @property
    def metres_per_unit(self) -> float | None:
        """Metres per unit of length: `unit_scale_m` if given, else the size of `unit`, else None."""
        if self.unit_scale_m is not None or self.unit is None:
            return self.unit_scale_m
        return UNITS_M[self.unit]
