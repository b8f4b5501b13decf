"""Values of an import: the file with its options, and the resulting items, graph or refusal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from marey_motion.documents import skeleton_from_document
from marey_motion.formats.predecessor.graph import PredecessorGraph
from marey_motion.importing.anatomy import Anatomy, anatomy_of
from marey_motion.importing.plan import PlannedFile
from marey_motion.importing.siblings import AxisFinding
from marey_motion.skeleton import Skeleton
from marey_schemas.documents.skeletons import SkeletonHierarchy
from marey_schemas.imports import Refusal, skeleton_output
from marey_schemas.kinds import Kind
from marey_schemas.options.imports import ImportOptions, UpAxis

SKELETON_COLLECTION = "skeletons"

Tree = dict[str, Any]


@dataclass(frozen=True)
class GivenSkeleton:
    """A stored skeleton that imported clips must use: a reference to its revision, and its document `hierarchy`."""

    item: str
    revision: int
    hierarchy: Mapping[str, Any]

    @property
    def ref(self) -> Tree:
        """Reference to the stored skeleton, as documents contain it."""
        return {"item": self.item, "revision": self.revision}


@dataclass(frozen=True)
class FileToImport:
    """A file with everything that its import needs.

    Parameters
    ----------
    planned : plan for the file
    data, digest : bytes of the file and their digest, which is recorded as the origin of a clip
    companion, companion_digest : bytes and digest of the companion file that the plan names
    options : import options given by the user
    notes, notes_digest : bytes and digest of the file with the annotation or alignment of the motion
    skeleton : stored skeleton that the clips must use
    sibling_axis : upward axis of other files with this skeleton, if the file is read a second time because it does not
        clearly show its own axis; otherwise None
    """

    planned: PlannedFile
    data: bytes | memoryview
    digest: str
    options: ImportOptions = field(default_factory=ImportOptions)
    companion: bytes | memoryview | None = None
    companion_digest: str | None = None
    skeleton: GivenSkeleton | None = None
    sibling_axis: UpAxis | None = None
    notes: bytes | memoryview | None = None
    notes_digest: str | None = None

    @property
    def collection(self) -> str:
        """Collection in which the items made from the file are stored."""
        return "/".join(part for part in (self.options.collection, self.planned.folder) if part)


@dataclass(frozen=True)
class ImportedItem:
    """An item to store: its name, collection, tags and documents.

    `name` identifies the item within the import: other items refer to it as `{"output": name}` until it is stored.
    If `reuse` is "by_name", the item becomes a new revision of the project's item with this name; if "by_content", an
    item of the project with equal required documents is used instead. Without such an item, a new one is stored.
    If `same_skeleton` is true, the item is not stored when the project's item with this name has another skeleton.
    """

    name: str
    kind: Kind
    item_name: str
    collection: str
    parts: Mapping[str, Tree]
    tags: Sequence[str] = ()
    reuse: Literal["by_name", "by_content"] = "by_name"
    same_skeleton: bool = False


@dataclass(frozen=True)
class ImportedGraph:
    """Graph whose nodes are not linked to models of the project yet (`importing.graphs` links them)."""

    name: str
    collection: str
    tags: Sequence[str]
    graph: PredecessorGraph
    file: str
    digest: str


@dataclass(frozen=True)
class ImportedFile:
    """Items of one file, or the reason for its refusal.

    Parameters
    ----------
    items : a skeleton, a clip or a model, or else a skeleton followed by a clip or model that uses it. A zipped graph
        gives a skeleton and several models. A skeleton has no document `mapping` yet (see `mapping_part`), unless it
        comes from a file of the predecessor
    checks : findings about the motion, as documents
    frames : number of frames of the clip
    graph : graph in the file, whose item is made after `items` are stored
    axis : evidence of the file about its upward axis; None if the axis was given or fixed by the format
    """

    name: str
    items: tuple[ImportedItem, ...] = ()
    checks: tuple[Tree, ...] = ()
    frames: int | None = None
    graph: ImportedGraph | None = None
    refusal: Refusal | None = None
    axis: AxisFinding | None = None


def given_skeleton(given: GivenSkeleton) -> Skeleton:
    """Make the skeleton of a stored hierarchy.

    Parameters
    ----------
    given : GivenSkeleton    the stored skeleton

    Returns
    -------
    Skeleton    J joints
    """
    return skeleton_from_document(SkeletonHierarchy.model_validate(given.hierarchy))


def skeleton_item(file: FileToImport, skeleton: Skeleton) -> ImportedItem:
    """Make the item of a file's own skeleton, which is to be stored only if the project has no equal skeleton.

    Parameters
    ----------
    file : FileToImport    the file
    skeleton : Skeleton    its joints

    Returns
    -------
    ImportedItem    item with the document `hierarchy`
    """
    anatomy = anatomy_of(skeleton)
    parts = {"hierarchy": anatomy.hierarchy}
    name = skeleton_output(file.planned.name)
    return ImportedItem(name, Kind.SKELETON, _skeleton_name(anatomy), SKELETON_COLLECTION, parts, reuse="by_content")


def _skeleton_name(anatomy: Anatomy) -> str:
    """Return the name of a new skeleton, such as `mixamo (178 cm)`: the rig, with the stature if it can be measured."""
    mapping = anatomy.mapping
    if mapping.is_animal:
        return "animal"
    if mapping.rig is None:
        return "skeleton"
    return mapping.rig if anatomy.stature is None else f"{mapping.rig} ({round(100 * anatomy.stature)} cm)"


def main_item(file: FileToImport, kind: Kind, item_name: str, parts: Mapping[str, Tree]) -> ImportedItem:
    """Make the main item of a file, with the tags of the import options.

    The item is stored in the collection of the import options or, if the file has a folder, below this collection.

    Parameters
    ----------
    file : FileToImport    the file
    kind : Kind    kind of the item
    item_name : str    name of the item
    parts : mapping of str to tree    documents of the item, by part

    Returns
    -------
    ImportedItem    the item
    """
    return ImportedItem(
        file.planned.name, kind, item_name, file.collection, parts, file.options.tags,
        same_skeleton=not file.options.replace_skeleton,
    )  # fmt: skip
