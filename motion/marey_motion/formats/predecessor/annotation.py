"""Annotations of Marey's predecessor: the documents in its database, and the files that it exports.

An annotation has one of three forms:

* a list of sections, `{"sections": [{"start_idx", "end_idx"}]}`;
* sections by label, `{"sections": {label: [{"start_idx", "end_idx"}]}}`;
* the frames of each label, `{"semantic_annotation": {label: [frames]}}`.

In some programs of the predecessor, the last frame of a section is `end_idx`; in other programs, it is the frame before
`end_idx`. The documents do not say which, so `read_predecessor_annotation` has the option `end_index`. If `end_idx` is
-1, the section goes to the end of the clip.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from marey_motion.editing.annotations.layers import Keyframe, Layer, Segment
from marey_motion.errors import AnnotationError, FormatError, FormatLimit
from marey_motion.formats.document_fields import field_of, number_array
from marey_motion.formats.predecessor.encoding import decode_document, encode_document
from marey_motion.formats.predecessor.sections import SECTIONS, section_range
from marey_schemas.formats import DEFAULT_END_INDEX, DEFAULT_FORM, AnnotationForm, EndIndex

SEMANTIC, KEYFRAMES = "semantic_annotation", "keyframes"
MOST_LAYERS = 64
"""Greatest number of annotations that are made from one document with overlapping labels: one for each label."""


def read_predecessor_annotation(
    data: bytes,
    file: str,
    frame_count: int,
    *,
    end_index: EndIndex = DEFAULT_END_INDEX,
    labels: Sequence[str] | None = None,
) -> Layer:
    """Read an annotation of a clip by Marey's predecessor, in any of the three forms.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages
    frame_count : int    frames of the clip
    end_index : str    "inclusive" if the last frame of a section is `end_idx`, as in the predecessor's editor;
        "exclusive" if the last frame is the frame before `end_idx`, as in the predecessor's time warping
    labels : sequence of str, optional    labels to read; all labels by default. If sections of different labels
        overlap, read one label at a time, since a layer has no overlapping segments. Sections without labels are called
        "section 1" and so on.

    Returns
    -------
    Layer    segments and keyframes

    Raises
    ------
    FormatError    if a section is invalid (the error names label and section), overlaps another section, or exceeds the
        clip
    """
    return layer_of_document(decode_document(data, file), file, frame_count, end_index=end_index, labels=labels)


def layer_of_document(
    document: Mapping[str, Any],
    file: str,
    frame_count: int,
    *,
    end_index: EndIndex = DEFAULT_END_INDEX,
    labels: Sequence[str] | None = None,
) -> Layer:
    """Read an annotation of a clip from a decoded document of Marey's predecessor, in any of its three forms.

    Parameters
    ----------
    document : mapping    the document
    file : str    name of the file, for messages
    frame_count : int    frames of the clip
    end_index : str    "inclusive" if `end_idx` is the last frame of a section; "exclusive" if it is the frame after the
        last one
    labels : sequence of str, optional    labels to read; all labels by default

    Returns
    -------
    Layer    segments and keyframes

    Raises
    ------
    FormatError    if a section is invalid (the error names label and section), overlaps another section, or exceeds the
        clip
    """
    if isinstance(document.get(SEMANTIC), dict):
        found = _frames_by_label(document[SEMANTIC], file)
    else:
        sections = document.get(SECTIONS)
        given = _parsed(sections, file) if isinstance(sections, str) else sections
        found = _sections(given, frame_count, end_index, file)
    keyframes = field_of(document, KEYFRAMES, dict, file) if KEYFRAMES in document else {}
    marks = [Keyframe(label, frame) for label, listed in keyframes.items() for frame in _frames(listed, label, file)]
    wanted = [one for one in found if labels is None or one.label in labels]
    try:
        return Layer(frame_count, tuple(wanted), tuple(marks))
    except AnnotationError as error:
        hint = ""
        if end_index == "inclusive" and _only_shares_ends(wanted):
            hint = "; each section ends where the next one starts: set end_index to exclusive"
        raise FormatError(f"{error}{hint}", code=error.code, file=file) from error


def layers_of_document(
    document: Mapping[str, Any], file: str, frame_count: int, *, end_index: EndIndex | None = None
) -> dict[str | None, Layer]:
    """Read an annotation from a decoded document, whose sections of different labels may overlap.

    Parameters
    ----------
    document : mapping    the document
    file : str    name of the file, for messages
    frame_count : int    frames of the clip
    end_index : str, optional    "inclusive" if `end_idx` is the last frame of a section; "exclusive" if it is the frame
        after the last one. By default, "inclusive" is tried first, and "exclusive" only if the document is not valid
        otherwise

    Returns
    -------
    dict of str or None to Layer    one layer with all labels under None, or, if labels overlap, one for each label

    Raises
    ------
    FormatError    if a section is invalid; the error names label and section
    """
    tried: tuple[EndIndex, ...] = (DEFAULT_END_INDEX, "exclusive") if end_index is None else (end_index,)
    refused: FormatError | None = None
    for meaning in tried:
        try:
            return {None: layer_of_document(document, file, frame_count, end_index=meaning)}
        except FormatError as error:
            refused = refused or error
    by_label = document.get(SEMANTIC) if isinstance(document.get(SEMANTIC), Mapping) else document.get(SECTIONS)
    assert refused is not None
    if isinstance(by_label, Mapping) and len(by_label) > MOST_LAYERS:
        raise FormatLimit(
            f"{refused.message}. If labels overlap, each label becomes an annotation of its own, but the file has "
            f"{len(by_label)} labels, more than the limit of {MOST_LAYERS}; correct this section, or split the file",
            file=file,
        )
    if isinstance(by_label, Mapping) and len(by_label) > 1:
        for meaning in tried:
            try:
                return {
                    label: layer_of_document(document, file, frame_count, end_index=meaning, labels=[label])
                    for label in by_label
                }
            except FormatError:
                continue
    raise refused


def is_annotation(document: Mapping[str, Any]) -> bool:
    """Check whether a document is an annotation or an alignment.

    Parameters
    ----------
    document : mapping    the document

    Returns
    -------
    bool    True for an annotation or an alignment
    """
    return (SECTIONS in document or SEMANTIC in document) and not {"poses", "frames"} & document.keys()


def write_predecessor_annotation(
    layer: Layer, *, form: AnnotationForm = DEFAULT_FORM, end_index: EndIndex = DEFAULT_END_INDEX
) -> bytes:
    """Write an annotation as JSON for Marey's predecessor.

    The predecessor has no keyframes; keyframes are written under `keyframes`, which the predecessor ignores. The form
    "list" does not contain the labels. The form "frames" does not contain the boundary between adjacent segments with
    the same label.

    Parameters
    ----------
    layer : Layer    segments and keyframes
    form : str    "labels": sections by label; "list": sections without labels; "frames": frame numbers by label
    end_index : str    "inclusive" to write the last frame of a section as `end_idx`; "exclusive" to write the frame
        after the last frame; without effect in the form "frames"

    Returns
    -------
    bytes    content of the file
    """
    past = 1 if end_index == "inclusive" else 0
    document: dict[str, Any] = {}
    if form == "list":
        document[SECTIONS] = [{"start_idx": one.start, "end_idx": one.end - past} for one in layer.segments]
    elif form == "labels":
        by_label: dict[str, list[dict[str, int]]] = {}
        for one in layer.segments:
            by_label.setdefault(one.label, []).append({"start_idx": one.start, "end_idx": one.end - past})
        document[SECTIONS] = by_label
    else:
        frames: dict[str, list[int]] = {}
        for one in layer.segments:
            frames.setdefault(one.label, []).extend(range(one.start, one.end))
        document[SEMANTIC] = frames
    marks: dict[str, list[int]] = {}
    for keyframe in layer.keyframes:
        marks.setdefault(keyframe.label, []).append(keyframe.frame)
    if marks:
        document[KEYFRAMES] = marks
    return encode_document(document, "json")


def _parsed(text: str, file: str) -> Any:
    """Parse sections that the document contains as a string of JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"field {SECTIONS!r} cannot be read: {error}", code="document-damaged", file=file) from error


def _sections(sections: Any, frame_count: int, end_index: EndIndex, file: str) -> list[Segment]:
    if isinstance(sections, list):
        named = [(f"section {number}", one) for number, one in enumerate(sections, start=1)]
    elif isinstance(sections, Mapping):
        named = [(label, one) for label in sections for one in field_of(sections, label, list, file)]
    else:
        raise FormatError(
            f"the document must have either the field {SECTIONS!r}, which is a list or an object with labels as "
            f"keys, or the field {SEMANTIC!r}, which is an object with labels as keys",
            code="document-unknown",
            file=file,
        )
    return [Segment(label, *section_range(one, frame_count, end_index, file)) for label, one in named]


def _frames_by_label(by_label: Mapping[str, Any], file: str) -> list[Segment]:
    """Group the frames of each label into runs of consecutive frames."""
    found: list[Segment] = []
    for label, given in by_label.items():
        frames = np.unique(np.array(_frames(given, label, file), dtype=np.int64))
        breaks = np.flatnonzero(np.diff(frames) > 1) + 1
        unbroken = (run for run in np.split(frames, breaks) if len(run))
        found += [Segment(label, int(run[0]), int(run[-1]) + 1) for run in unbroken]
    return found


def _frames(given: Any, label: str, file: str) -> list[int]:
    if not isinstance(given, list) or any(isinstance(one, bool) for one in given):
        raise FormatError(f"field {label!r} must be a list of frame numbers", file=file)
    numbers = number_array(given, file, label)
    if numbers.ndim != 1 or (numbers != np.floor(numbers)).any() or (np.abs(numbers) > 2**53).any():
        raise FormatError(f"field {label!r} must be a list of frame numbers; each must be a whole number", file=file)
    return [int(one) for one in numbers]


def _only_shares_ends(segments: Sequence[Segment]) -> bool:
    """Return whether neighbouring segments overlap by at most one frame."""
    ordered = sorted(segments, key=lambda one: (one.start, one.end))
    return all(before.end - 1 <= after.start for before, after in pairwise(ordered))
