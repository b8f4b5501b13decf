"""Alignment of a clip by Marey's predecessor: sections in canonical frames, and a time function (time warp).

The time function gives a whole frame number of the source clip for each canonical frame, so it is constant where
several canonical frames correspond to one frame of the source. Some programs wrote the time function as a string of
JSON within the document.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from marey_motion.alignment.warp import LEAST_SLOPE
from marey_motion.arrays import Floats
from marey_motion.errors import FormatError
from marey_motion.formats.document_fields import number_array
from marey_motion.formats.predecessor.encoding import decode_document, encode_document
from marey_motion.formats.predecessor.sections import SECTIONS, section_range
from marey_schemas.sizes import MOST_INTEGER

TIME_FUNCTION = "time_function"


@dataclass(frozen=True, eq=False)
class PredecessorAlignment:
    """An alignment read from a document of Marey's predecessor.

    Parameters
    ----------
    frames : (N,) int64    frame of the source at each canonical frame, unchanged from the document
    sections : canonical frames [start, end) of each section
    """

    frames: NDArray[np.int64]
    sections: tuple[tuple[int, int], ...]


def read_predecessor_alignment(data: bytes, file: str) -> PredecessorAlignment:
    """Read the alignment of a clip from a document of Marey's predecessor.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages

    Returns
    -------
    PredecessorAlignment    time function and sections

    Raises
    ------
    FormatError    if a field is missing or invalid; the error names it
    """
    return alignment_of_document(decode_document(data, file), file)


def alignment_of_document(document: Mapping[str, Any], file: str) -> PredecessorAlignment:
    """Read the alignment of a clip from a decoded document of Marey's predecessor.

    Parameters
    ----------
    document : mapping    the document
    file : str    name of the file, for messages

    Returns
    -------
    PredecessorAlignment    time function and sections

    Raises
    ------
    FormatError    if a field is missing or invalid; the error names it
    """
    frames = number_array(_list(document, TIME_FUNCTION, file), file, TIME_FUNCTION)
    if frames.ndim != 1 or len(frames) < 2 or (frames != np.floor(frames)).any() or (frames < 0).any():
        raise FormatError(f"field {TIME_FUNCTION!r} must be a list of at least two frames", file=file)
    if frames.max() > MOST_INTEGER:
        message = f"field {TIME_FUNCTION!r} contains frame {frames.max():g}; the limit is {MOST_INTEGER:g}"
        raise FormatError(message, code="time-function-invalid", file=file)
    if (np.diff(frames) < 0).any():
        place = int(np.argmax(np.diff(frames) < 0)) + 1
        message = f"field {TIME_FUNCTION!r} decreases at canonical frame {place}"
        raise FormatError(message, code="time-function-invalid", file=file)
    sections = [
        section_range(one, len(frames), "exclusive", file)
        for one in (_list(document, SECTIONS, file) if SECTIONS in document else [])
    ]
    for start, end in sections:
        if not 0 <= start < end <= len(frames):
            message = f"section {start}:{end} is not a range of the {len(frames)} canonical frames"
            raise FormatError(message, file=file)
    return PredecessorAlignment(frames.astype(np.int64), tuple(sections))


def write_predecessor_alignment(time_function: Floats, sections: Sequence[tuple[int, int]] = ()) -> bytes:
    """Write an alignment for Marey's predecessor: sections, and a time function that is rounded to whole frames.

    Parameters
    ----------
    time_function : (N,) float64    source frame of each canonical frame
    sections : sequence of (int, int)    canonical frames [start, end) of each section

    Returns
    -------
    bytes    content of the file
    """
    return encode_document(
        {
            SECTIONS: [{"start_idx": start, "end_idx": end} for start, end in sections],
            TIME_FUNCTION: np.rint(time_function).astype(np.int64).tolist(),
        },
        "json",
    )


def as_increasing(frames: NDArray[np.int64], source_frames: int) -> Floats:
    """Make a time function of whole frames strictly increasing.

    If several canonical frames have the same source frame, only their middle keeps this source frame. Between these
    middles, source frames are interpolated linearly. The first and the last canonical frame get the first and the last
    frame of the source.

    Parameters
    ----------
    frames : (N,) int64    source frame of each canonical frame
    source_frames : int    frames of the source

    Returns
    -------
    (N,) float64    strictly increasing from 0 to the last frame of the source

    Raises
    ------
    FormatError    if a source frame is beyond the last frame of the source
    """
    if frames.max() >= source_frames:
        message = f"the time function contains frame {int(frames.max())}, but the source has {source_frames} frames"
        raise FormatError(message, code="time-function-invalid")
    places = np.arange(len(frames), dtype=np.float64)
    values, inverse = np.unique(frames, return_inverse=True)
    middles = np.bincount(inverse, weights=places) / np.bincount(inverse)
    times = np.interp(places, middles, values.astype(np.float64))
    times[0], times[-1] = 0.0, source_frames - 1.0
    least = LEAST_SLOPE * places
    forward = np.maximum.accumulate(times - least) + least
    from_end = times[-1] - least[::-1]
    increasing = np.minimum(forward, from_end)
    increasing[0] = 0.0
    return np.asarray(np.maximum(increasing, least))


def _list(document: Mapping[str, Any], name: str, file: str) -> list[Any]:
    """Read a list, which may be encoded once or twice as a string of JSON."""
    value = document.get(name)
    for _ in range(2):
        if isinstance(value, str):
            try:
                value = json.loads(value)
            except (ValueError, RecursionError) as error:
                raise FormatError(
                    f"field {name!r} cannot be read: {error}", code="document-damaged", file=file
                ) from error
    if not isinstance(value, list):
        raise FormatError(f"field {name!r} must be a list", file=file)
    return value
