"""Readers and writers for documents of Marey's predecessor, the system of Herrmann et al. (2019)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from marey_motion.errors import FormatError
from marey_motion.formats.predecessor.annotation import is_annotation
from marey_motion.formats.predecessor.clips import motion_of_document, write_predecessor, write_predecessor_skeleton
from marey_motion.formats.predecessor.encoding import decode_content
from marey_motion.formats.predecessor.graph import is_graph
from marey_motion.formats.predecessor.model_layouts import layout_of
from marey_motion.formats.predecessor.records import form_of_record
from marey_motion.formats.predecessor.skeleton_model import is_skeleton_model
from marey_motion.formats.predecessor.tree import is_tree
from marey_motion.formats.predecessor.zipped_graph import MARK
from marey_motion.importing.source import SourceDocument, SourceMotion, Subject
from marey_motion.skeleton import Skeleton

__all__ = ["read_predecessor", "write_predecessor", "write_predecessor_skeleton"]


def read_predecessor(
    data: bytes,
    file: str,
    *,
    companion: bytes | None = None,
    companion_name: str = "the skeleton document",
    skeleton: Skeleton | None = None,
    frame_rate_hz: float | None = None,
) -> SourceMotion | SourceDocument:
    """Read a file of Marey's predecessor: a motion, which stays in its own unit and axes, or a document without motion.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages
    companion : bytes, optional    the skeleton document of a clip
    companion_name : str    name of the file of the skeleton document, for messages
    skeleton : Skeleton, optional    the skeleton of a clip, in place of the skeleton document
    frame_rate_hz : float, optional    replaces the document's rate

    Returns
    -------
    SourceMotion or SourceDocument    motion or skeleton in centimetres; or the document of a model, tree, graph,
        annotation, alignment, skeleton model or record; or an empty document for a zipped graph

    Raises
    ------
    FormatError    if a document is invalid (the error names the field, and the joint if there is one), or if a clip is
        read without its skeleton
    """
    if data.startswith(MARK):
        return SourceDocument("zipped graph", {})
    document = decode_content(data, file)
    if isinstance(document, dict) and (subject := _subject_of(document)) is not None:
        return SourceDocument(subject, document)
    if (form := form_of_record(document)) is not None:
        return SourceDocument("record", {"form": form, "content": document})
    if isinstance(document, list):
        message = "the file contains a list, but is no history of edits, whose entries are [command, parameters]"
        raise FormatError(message, code="document-unknown", file=file)
    return motion_of_document(
        document,
        file,
        skeleton=companion if skeleton is None else skeleton,
        skeleton_file=companion_name,
        frame_rate_hz=frame_rate_hz,
    )


def _subject_of(document: Mapping[str, Any]) -> Subject | None:
    if layout_of(document) is not None:
        return "model"
    if is_tree(document):
        return "tree"
    if is_graph(document):
        return "graph"
    if is_annotation(document):
        return "notes"
    return "skeleton model" if is_skeleton_model(document) else None
