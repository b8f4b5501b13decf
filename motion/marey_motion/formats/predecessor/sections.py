"""Sections in documents of Marey's predecessor: ranges of frames, `{"start_idx", "end_idx"}`."""

from __future__ import annotations

from typing import Any

from marey_motion.formats.document_fields import field_of
from marey_schemas.formats import EndIndex

SECTIONS = "sections"
LAST_FRAME = -1
"""Number that documents write for the last frame of a clip or model, instead of the number of this frame."""


def section_range(section: Any, frame_count: int, end_index: EndIndex, file: str) -> tuple[int, int]:
    """Read the range of a section.

    Parameters
    ----------
    section : mapping    the section
    frame_count : int    frames of the clip; a section whose `end_idx` is -1 extends to the end of the clip
    end_index : str    "inclusive" if the last frame of a section is `end_idx`, else "exclusive"
    file : str    name of the file, for messages

    Returns
    -------
    (int, int)    frames [start, end), which may be outside the clip

    Raises
    ------
    FormatError    if a field is missing or no whole number
    """
    start, end = (field_of(section, name, int, file) for name in ("start_idx", "end_idx"))
    return start, frame_count if end == LAST_FRAME else end + (end_index == "inclusive")
