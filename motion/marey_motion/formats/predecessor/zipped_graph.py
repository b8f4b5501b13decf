"""Zipped graphs of Marey's predecessor (`*.mg.zip`): a graph with its skeleton, its models and their trees.

Members of the archive, all in one folder or at the top:

    graph_definition.json    transitions between models, start node, definitions of actions
    skeleton.json or skeleton.bvh
    elementary_action_models/elementary_action_<action>/
        <action>_<primitive>_quaternion_mm.json    model, of any layout
        <action>_<primitive>_quaternion_cluster_tree.json    its tree; some programs wrote it as a pickle
        meta_information.json    types of the nodes, and keyframes

Pickles are programs, so they are never read. A transition is written as the names of two nodes, which are action and
primitive joined by `_` or `:`.
"""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

from marey_motion.errors import FormatError, FormatLimit
from marey_motion.formats.document_fields import field_of
from marey_motion.formats.predecessor.encoding import decode_document
from marey_motion.formats.predecessor.graph import GraphNode, Place, PredecessorGraph
from marey_motion.formats.texts import short_name
from marey_schemas.documents.graphs import MOST_PRIMITIVES, NODE_TYPES
from marey_schemas.formats import MOST_UNPACKED_BYTES
from marey_schemas.formats.companions import TREE_ENDINGS, model_name

MARK = b"PK\x03\x04"
"""Beginning of a ZIP archive."""
DEFINITION, META = "graph_definition.json", "meta_information.json"
SKELETONS = ("skeleton.json", "skeleton.bvh")
_ACTION = "elementary_action_"
_STATES = {"start_states": "start", "end_states": "end", "idle_states": "idle", "single_states": "single",
           "cycle_states": "cycle_end"}  # fmt: skip
_MOST_MEMBERS = 4 * MOST_PRIMITIVES
# Methods whose members `zipfile` unpacks only up to the declared size.
_BOUNDED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
# Errors that a damaged or hostile archive can raise; encryption and unknown compression raise RuntimeError.
_ARCHIVE_ERRORS = (
    zipfile.BadZipFile, zlib.error, struct.error, EOFError, IndexError, OSError, OverflowError, RuntimeError,
    ValueError,
)  # fmt: skip


@dataclass(frozen=True)
class ZippedModel:
    """A model of a zipped graph.

    Parameters
    ----------
    name : name of the model, `<action>_<primitive>`
    member : name of the member with the model
    data : content of this member
    tree, tree_member : content of the tree and name of its member; None if there is no tree that can be read
    keyframes : canonical frame by label: a number, "-1" or "lastFrame" for the last frame, or "middle"
    """

    name: str
    member: str
    data: bytes
    tree: bytes | None
    tree_member: str | None
    keyframes: Mapping[str, Any]


@dataclass(frozen=True)
class ZippedGraph:
    """Content of a zipped graph.

    Parameters
    ----------
    graph : nodes by action and name of the model
    models : one for each node
    skeleton, skeleton_member : content and name of the member with the skeleton
    pickled : members with trees that are pickles, and so are not read
    unknown : transitions from or to nodes that do not exist, which the predecessor ignores
    """

    graph: PredecessorGraph
    models: tuple[ZippedModel, ...]
    skeleton: bytes
    skeleton_member: str
    pickled: tuple[str, ...]
    unknown: tuple[str, ...]


def read_zipped_graph(data: bytes, file: str) -> ZippedGraph:
    """Read a zipped graph; the models themselves are not decoded.

    Parameters
    ----------
    data : bytes    content of the file
    file : str    name of the file, for messages

    Returns
    -------
    ZippedGraph    the graph with its models

    Raises
    ------
    FormatError    if the archive is damaged or lacks a member, or if a member is invalid; the error names it
    FormatLimit    if the archive unpacks to more than `MOST_UNPACKED_BYTES`, or has too many members or models
    """
    members = _members(data, file)
    definition = _document(members, DEFINITION, file)
    skeleton = next((name for name in SKELETONS if name in members), None)
    if skeleton is None:
        raise FormatError(f"the archive has no member {' or '.join(map(repr, SKELETONS))}", file=file)
    models = {place: model for action, names in _actions(members) for place, model in _models(action, names)}
    if not models:
        example = f"elementary_action_models/{_ACTION}walk/walk_left_quaternion_mm.json"
        raise FormatError(f"the archive contains no models, such as {example}", file=file)
    if len(models) > MOST_PRIMITIVES:
        raise FormatLimit(f"the graph has {len(models)} nodes; the limit is {MOST_PRIMITIVES}", file=file)
    names = Counter("_".join(place) for place in models)
    if (repeated := max(names, key=names.__getitem__)) and names[repeated] > 1:
        message = f"two models are called {short_name(repeated)!r}, in different actions; rename one"
        raise FormatError(message, file=file)
    known = _Nodes(members, definition, list(models), file)
    onwards, unknown = known.transitions()
    nodes = {
        (action, f"{action}_{mp}"): GraphNode(f"{action}_{mp}", known.type_of((action, mp)), onwards[action, mp])
        for action, mp in models
    }
    trees, pickles = _trees(members)
    read = [
        _model(members, place, member, trees.get(_whole_name(member)), known.keyframes(place))
        for place, member in models.items()
    ]
    pickled = [found for member in models.values() if (found := pickles.get(_whole_name(member)))]
    graph = PredecessorGraph(nodes, known.start())
    return ZippedGraph(graph, tuple(read), members[skeleton], skeleton, tuple(pickled), tuple(unknown))


def _members(data: bytes, file: str) -> dict[str, bytes]:
    """Unpack the documents of an archive; the names are relative to the folder of the graph's definition."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            listed = {one.filename: one for one in archive.infolist() if not one.filename.endswith("/")}
            if "" in listed:  # also if the name begins with NUL, where zipfile ends names
                raise FormatError("a member of the archive has no name", code="not-a-graph", file=file)
            total = sum(one.file_size for one in listed.values())
            if len(listed) > _MOST_MEMBERS or total > MOST_UNPACKED_BYTES:
                raise FormatLimit(
                    f"the archive unpacks to {total:,} bytes in {len(listed):,} files; at most {MOST_UNPACKED_BYTES:,} "
                    f"bytes in {_MOST_MEMBERS:,} files are accepted",
                    file=file,
                )
            foreign = next((name for name, one in listed.items() if one.compress_type not in _BOUNDED), None)
            if foreign is not None:
                message = (
                    f"member {short_name(foreign)!r} is compressed by an unusual method; use the ordinary one (deflate)"
                )
                raise FormatError(message, code="not-a-graph", file=file)
            top = next((name.removesuffix(DEFINITION) for name in listed if _base(name) == DEFINITION), None)
            if top is None:
                message = f"the archive is no graph of the predecessor, because it has no member {DEFINITION!r}"
                raise FormatError(message, code="not-a-graph", file=file)
            return {
                name.removeprefix(top): _unpacked(archive, one) for name, one in listed.items() if name.startswith(top)
            }
    except _ARCHIVE_ERRORS as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(f"the archive is damaged: {error}", code="not-a-graph", file=file) from error


def _unpacked(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    if not member.filename.endswith((".json", ".bvh")):
        return b""  # a pickle, or nothing that the graph needs
    with archive.open(member) as content:
        return content.read(member.file_size)  # without a number, it would unpack more than the archive declares


def _base(name: str) -> str:
    return PurePosixPath(name).name


def _document(members: Mapping[str, bytes], name: str, file: str) -> dict[str, Any]:
    return decode_document(members[name], f"{file}: {name}")


def _actions(members: Mapping[str, bytes]) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of each action, and the names of the members in its folder."""
    folders: dict[str, list[str]] = {}
    for name in members:
        folders.setdefault(PurePosixPath(name).parent.as_posix(), []).append(name)
    for folder, names in folders.items():
        if _base(folder).startswith(_ACTION):
            yield _base(folder).removeprefix(_ACTION), names


def _models(action: str, names: Sequence[str]) -> Iterator[tuple[Place, str]]:
    """Yield action and primitive of each model in the folder of an action, and the name of its member."""
    for name in names:
        stem = _base(name).removesuffix(".json")
        if model_name(stem) != stem:
            yield (action, model_name(stem).removeprefix(f"{action}_")), name


def _whole_name(member: str) -> str:
    """Return the name of the model in a member, with the folder of the member."""
    base = _base(member)
    return member.removesuffix(base) + model_name(base.removesuffix(".json"))


def _trees(members: Collection[str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return two mappings from model names, with their folders, to the members with their trees.

    The first mapping contains the trees in JSON, the second one the trees in other encodings, which are not read.
    """
    readable: dict[str, str] = {}
    pickled: dict[str, str] = {}
    for name in members:
        base = _base(name)
        found = readable if name.endswith(".json") else pickled
        for ending in TREE_ENDINGS:
            stem, mark, _ = base.rpartition(f"{ending}.")
            if mark:
                found.setdefault(name.removesuffix(base) + stem, name)
    return readable, pickled


def _model(
    members: Mapping[str, bytes], place: Place, member: str, tree: str | None, keyframes: Mapping[str, Any]
) -> ZippedModel:
    return ZippedModel("_".join(place), member, members[member], members[tree] if tree else None, tree, keyframes)


class _Nodes:
    """Types, transitions and keyframes of nodes, from the definition of a graph and the information about actions."""

    def __init__(
        self, members: Mapping[str, bytes], definition: Mapping[str, Any], places: Sequence[Place], file: str
    ) -> None:
        self._definition = definition
        self._places = places
        self._file = file
        self._named = {f"{action}{mark}{mp}": (action, mp) for action, mp in places for mark in "_:"}
        self._types: dict[str, dict[str, str]] = {}
        self._meta: dict[str, dict[str, Any]] = {}
        for action, names in _actions(members):
            found = next((name for name in names if _base(name) == META), None)
            self._meta[action] = {} if found is None else _document(members, found, file)

    def type_of(self, place: Place) -> str:
        """Return the type of a node: "standard" if the archive does not state the type."""
        action, mp = place
        if action not in self._types:
            self._types[action] = self._types_of(action)
        return self._types[action].get(mp, "standard")

    def _types_of(self, action: str) -> dict[str, str]:
        """Return the type of each primitive of an action; if the archive states several types, the first is used."""
        found: dict[str, str] = {}
        for field, kind in _STATES.items():
            for mp in _list_of(self._meta[action], field, self._file):
                if isinstance(mp, str):
                    found.setdefault(mp, kind)
        actions = self._definition.get("actionDefinitions")
        described = actions.get(action) if isinstance(actions, dict) else None
        sequence = described.get("node_sequence") if isinstance(described, dict) else None
        for entry in sequence if isinstance(sequence, list) else []:
            if isinstance(entry, list) and len(entry) == 2 and all(isinstance(one, str) for one in entry):
                kind = entry[1].removesuffix("_primitive")
                if kind in NODE_TYPES:
                    found.setdefault(entry[0], kind)
        return found

    def keyframes(self, place: Place) -> dict[str, Any]:
        """Return the keyframes of a model, as the file about its action lists them; empty if it lists none."""
        annotations = self._meta[place[0]].get("annotations")
        found = annotations.get(place[1]) if isinstance(annotations, dict) else None
        return found if isinstance(found, dict) else {}

    def transitions(self) -> tuple[dict[Place, tuple[Place, ...]], list[str]]:
        """Return the nodes that follow each node, and the transitions from or to nodes that do not exist."""
        follows: dict[Place, dict[Place, None]] = {place: {} for place in self._places}
        unknown = []
        for key, targets in field_of(self._definition, "transitions", dict, self._file).items():
            if not isinstance(targets, (dict, list)):
                message = f"the transitions of {short_name(key)!r} must be a list or an object"
                raise FormatError(message, file=self._file)
            for target in map(str, targets):
                start, end = self._named.get(key), self._named.get(target)
                if start is None or end is None:
                    unknown.append(f"{short_name(key)} to {short_name(target)}")
                else:
                    follows[start][end[0], "_".join(end)] = None
        return {place: tuple(found) for place, found in follows.items()}, unknown

    def start(self) -> Place:
        """Return the start node of the definition or, without one, the first idle node of `walk`.

        The predecessor does the same.
        """
        given = self._definition.get("startNode")
        if given is None:
            idle = _list_of(self._meta.get("walk", {}), "idle_states", self._file)
            given = ["walk", idle[0]] if idle else None
        if not isinstance(given, list) or len(given) != 2:
            message = "field 'startNode' must be a list of two names: an action and a primitive"
            raise FormatError(message, file=self._file)
        action, mp = map(str, given)
        found = self._named.get(f"{action}:{mp}") or self._named.get(mp)
        if found is None or found[0] != action:
            message = f"field 'startNode' refers to the node {short_name(given)}, which does not exist"
            raise FormatError(message, file=self._file)
        return found[0], "_".join(found)


def _list_of(document: Mapping[str, Any], name: str, file: str) -> list[Any]:
    return field_of(document, name, list, file) if name in document else []
