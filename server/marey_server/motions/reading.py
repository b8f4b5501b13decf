"""Reading of uploaded files in a child process: messages to the child process, and the documents that it returns."""

from __future__ import annotations

from typing import Any, Literal, Self

import orjson

from marey_motion.formats.predecessor.graph import GraphNode, PredecessorGraph
from marey_motion.importing.files import import_file, mapping_part
from marey_motion.importing.items import FileToImport, GivenSkeleton, ImportedGraph, ImportedItem
from marey_motion.importing.plan import PlannedFile
from marey_motion.importing.siblings import AxisFinding
from marey_motion.warm_up import compile_kernels
from marey_schemas.documents.clips import Check
from marey_schemas.encoding.canonical import canonical_json
from marey_schemas.encoding.codecs import MSGPACK, decode_tree, encode_tree
from marey_schemas.imports import Refusal
from marey_schemas.kinds import Kind
from marey_schemas.lru import LruCache
from marey_schemas.options.imports import ImportOptions, UpAxis
from marey_server.motions.child import Message
from marey_server.prepared_documents import PreparedDocument, decoded_tree, document_of_bytes, prepare_document

_SKELETONS_KEPT = 64


class FileOrder(Message):
    """Message that asks a child process to read a file.

    `companion` and `notes` are the contents of two files that accompany it, if they exist. `sibling_axis` is the upward
    axis that other files with the same skeleton show.
    """

    planned: PlannedFile
    content: bytes
    digest: str
    options: ImportOptions
    companion: bytes | None = None
    companion_digest: str | None = None
    skeleton: tuple[str, int, bytes] | None = None
    """Item, revision and hierarchy of the skeleton that the clips must use."""
    sibling_axis: UpAxis | None = None
    notes: bytes | None = None
    notes_digest: str | None = None

    def file(self) -> FileToImport:
        """Return the file with everything that is needed to import it, with the decoded skeleton."""
        given = None
        if self.skeleton is not None:
            item, revision, hierarchy = self.skeleton
            given = GivenSkeleton(item, revision, decode_tree(hierarchy, MSGPACK))
        return FileToImport(
            self.planned, self.content, self.digest, self.options, self.companion, self.companion_digest, given,
            self.sibling_axis, self.notes, self.notes_digest,
        )  # fmt: skip


def packed_skeleton(given: GivenSkeleton | None) -> tuple[str, int, bytes] | None:
    """Return a stored skeleton as the value of the field `skeleton` of `FileOrder`; None for None."""
    if given is None:
        return None
    return given.item, given.revision, encode_tree(given.hierarchy, MSGPACK, arrays="blocks")


class ReadDocument(Message):
    """Message with a document that a child process has checked and encoded; the server computes the digests."""

    schema_name: str
    body: bytes
    arrays: dict[str, bytes]

    @classmethod
    def of(cls, document: PreparedDocument) -> Self:
        """Convert a prepared document to a message."""
        arrays = {pointer: data for pointer, (_, data) in document.arrays.items()}
        return cls(schema_name=document.schema, body=canonical_json(document.body), arrays=arrays)

    def document(self) -> PreparedDocument:
        """Convert the message back to a prepared document."""
        return document_of_bytes(self.schema_name, self.body, self.arrays)


_READ_SKELETONS: LruCache[bytes, ReadDocument] = LruCache(max_entries=_SKELETONS_KEPT)
"""Cache of a child process: encoded hierarchies by their JSON, because files of an upload often share a hierarchy."""
_SKELETONS: LruCache[bytes, PreparedDocument] = LruCache(max_entries=_SKELETONS_KEPT)
"""Cache of the server process: hierarchies by the JSON that a child process has sent."""


class ReadDraft(Message):
    """Message with an item that is to be created from a file, and its parts."""

    name: str
    kind: Kind
    item_name: str
    collection: str
    parts: dict[str, ReadDocument]
    tags: tuple[str, ...]
    reuse: Literal["by_name", "by_content"]
    same_skeleton: bool

    def documents(self) -> dict[str, PreparedDocument]:
        """Return the parts of the item as prepared documents, by name."""
        if self.kind is not Kind.SKELETON:
            return {part: read.document() for part, read in self.parts.items()}
        return {part: _SKELETONS.get_or_make(read.body, read.document) for part, read in self.parts.items()}


class ReadGraph(Message):
    """Message with a graph of models, read from a file of Marey's predecessor.

    Each node is a tuple: action, name, id of the model, type, and transitions as pairs of action and name.
    """

    name: str
    collection: str
    tags: tuple[str, ...]
    file: str
    digest: str
    nodes: tuple[tuple[str, str, str, str, tuple[tuple[str, str], ...]], ...]
    start: tuple[str, str]

    @classmethod
    def of(cls, graph: ImportedGraph) -> Self:
        """Convert an imported graph to a message."""
        nodes = tuple((*place, node.model_id, node.type, node.transitions) for place, node in graph.graph.nodes.items())
        return cls(
            name=graph.name, collection=graph.collection, tags=tuple(graph.tags), file=graph.file, digest=graph.digest,
            nodes=nodes, start=graph.graph.start,
        )  # fmt: skip

    def graph(self) -> ImportedGraph:
        """Convert the message back to an imported graph."""
        nodes = {(action, name): GraphNode(model, form, onwards) for action, name, model, form, onwards in self.nodes}
        graph = PredecessorGraph(nodes, self.start)
        return ImportedGraph(self.name, self.collection, self.tags, graph, self.file, self.digest)


class ReadFile(Message):
    """Message with the items that a child process has read from a file, or the reason why the file was refused."""

    items: tuple[ReadDraft, ...] = ()
    checks: tuple[Check, ...] = ()
    frames: int | None = None
    graph: ReadGraph | None = None
    refusal: Refusal | None = None
    axis: AxisFinding | None = None


# -- in the child ------------------------------------------------------------------------------------------------------


def load_kernels() -> None:
    """Load the kernels that child processes need.

    The kernels are loaded in advance, because compiling missing kernels takes far longer than reading a file.
    """
    compile_kernels(["files", "editing", "searches", "coverage", "similarity"])


def read_file(order: bytes) -> bytes:
    """Read a file, in a child process. `order` is a `FileOrder`, and the result a `ReadFile`, both as bytes.

    Raises `InvalidProblem` if a document of the file cannot be stored.
    """
    found = import_file(FileOrder.unpack(order).file())
    return ReadFile(
        items=tuple(map(_read_item, found.items)),
        checks=tuple(map(Check.model_validate, found.checks)),
        frames=found.frames,
        graph=None if found.graph is None else ReadGraph.of(found.graph),
        refusal=found.refusal,
        axis=found.axis,
    ).pack()


def find_mapping(order: bytes) -> bytes:
    """Find the joint mapping and the axes of a skeleton, in a child process.

    `order` is the part `hierarchy` as a `ReadDocument`, as bytes. Return the part `mapping` in the same form.
    """
    hierarchy = decoded_tree(ReadDocument.unpack(order).document())
    return ReadDocument.of(prepare_document(mapping_part(hierarchy))).pack()


def _read_item(item: ImportedItem) -> ReadDraft:
    return ReadDraft(
        name=item.name, kind=item.kind, item_name=item.item_name, collection=item.collection,
        parts={part: _read_document(item.kind, tree) for part, tree in item.parts.items()},
        tags=tuple(item.tags), reuse=item.reuse, same_skeleton=item.same_skeleton,
    )  # fmt: skip


def _read_document(kind: Kind, tree: dict[str, Any]) -> ReadDocument:
    def read() -> ReadDocument:
        return ReadDocument.of(prepare_document(tree, schema=tree["schema"]))

    # A hierarchy has no arrays, so that orjson alone writes it.
    return _READ_SKELETONS.get_or_make(orjson.dumps(tree), read) if kind is Kind.SKELETON else read()
