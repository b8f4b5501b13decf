"""Differences between two revisions, which are read in one transaction and compared in a child process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from marey_schemas.documents.annotations import Annotation
from marey_schemas.documents.clips import MotionDocument
from marey_schemas.documents.differences import (
    Change,
    ComparedRevision,
    Difference,
    DifferenceOptions,
    DifferenceRequest,
    FieldChange,
    SkeletonDifference,
)
from marey_schemas.documents.skeletons import SkeletonHierarchy, SkeletonMapping
from marey_schemas.items import Item, PartSummary
from marey_schemas.kinds import Kind
from marey_server.errors import NotFoundProblem, TooLargeProblem
from marey_server.motions.child import AnswerEncoding, Message, pack_tree, unpack_tree
from marey_server.store import items
from marey_server.store.transaction import Transaction

if TYPE_CHECKING:  # numeric modules are loaded by children alone
    from marey_motion.clip import Clip
    from marey_motion.skeleton import Skeleton

Tree = dict[str, Any]

MAKE_DIFFERENCE = "marey_server.motions.comparing:make_difference"
"""Function that child processes run."""
MOST_NUMBERS = 20_000_000
"""Greatest number of values in the poses of both revisions, so that a child can compare them within its time limit."""
MOST_FIELDS = 1000
"""Greatest number of changed values in an answer."""


@dataclass(frozen=True, slots=True)
class ComparedSide:
    """Revision on one side of a comparison, with the documents of the parts that differ.

    `hierarchy` is the skeleton of the motion, if the part `motion` differs.
    """

    place: ComparedRevision
    parts: Mapping[str, PartSummary]
    trees: dict[str, Tree]
    hierarchy: Tree | None


@dataclass(frozen=True, slots=True)
class DifferenceSource:
    """The two revisions of a comparison, with the documents to compare."""

    kind: Kind
    before: ComparedSide
    after: ComparedSide


class SideOrder(Message):
    """Part of a `DifferenceOrder`: the revision on one side of the comparison, with its documents as bytes."""

    place: ComparedRevision
    parts: dict[str, bytes]
    hierarchy: bytes | None


class DifferenceOrder(Message):
    """Message that asks a child process to compare two revisions."""

    kind: Kind
    before: SideOrder
    after: SideOrder
    options: DifferenceOptions
    plot: bool
    encoding: AnswerEncoding


def read_difference(
    tx: Transaction, project: str, kind: Kind, item_id: str, request: DifferenceRequest
) -> DifferenceSource:
    """Read two revisions and the documents of the parts that differ between them.

    Raises `NotFoundProblem` if an item or a revision does not exist, and `TooLargeProblem` if the motions have too many
    values to be compared at once.
    """
    item = items.read_item(tx, project, kind, item_id)
    other = item if request.to_item is None else items.read_item(tx, project, kind, request.to_item)
    after = request.to or other.revision
    before = request.from_ or (after - 1 if other.id == item.id else item.revision)
    if before < 1:
        raise NotFoundProblem(
            "The item has no revision before revision 1; compare it with another item, or compare two other revisions.",
            code="no-revision",
        )
    numbers = {"after": (other, after), "before": (item, before)}  # a revision that was asked for is missed first
    parts = {side: items.read_revision(tx, project, kind, one.id, n).parts for side, (one, n) in numbers.items()}
    digests = {side: {(name, part.document) for name, part in found.items()} for side, found in parts.items()}
    differing = {name for name, _ in digests["before"] ^ digests["after"]}
    sides = {side: _side(tx, project, one, n, parts[side], differing) for side, (one, n) in numbers.items()}
    found = DifferenceSource(kind, **sides)
    _require_room(found)
    return found


def _side(
    tx: Transaction, project: str, item: Item, revision: int, parts: Mapping[str, PartSummary], differing: set[str]
) -> ComparedSide:
    trees = {
        name: items.read_part(tx, project, item.kind, item.id, name, revision=revision).tree
        for name in sorted(differing & parts.keys())
    }
    hierarchy = None
    if "motion" in trees:
        ref = trees["motion"]["skeleton"]
        hierarchy = items.read_part(tx, project, Kind.SKELETON, ref["item"], "hierarchy", revision=ref["revision"]).tree
    place = ComparedRevision(item=item.id, name=item.name, revision=revision)
    return ComparedSide(place, parts, trees, hierarchy)


def _require_room(source: DifferenceSource) -> None:
    motions = [side.trees["motion"] for side in (source.before, source.after) if "motion" in side.trees]
    if sum(int(motion["poses"].shape[0] * motion["poses"].shape[1]) for motion in motions) > MOST_NUMBERS:
        raise TooLargeProblem(
            f"The motions have more than {MOST_NUMBERS:,} values together, which is too much to compare at once; "
            "download both revisions, or compare shorter clips.",
            code="difference-too-large",
        )


def difference_order(source: DifferenceSource, request: DifferenceRequest, encoding: AnswerEncoding) -> bytes:
    """Return the packed message that asks a child process to compare two revisions."""
    return DifferenceOrder(
        kind=source.kind,
        before=_side_order(source.before),
        after=_side_order(source.after),
        options=DifferenceOptions.of(request),
        plot=request.plot,
        encoding=encoding,
    ).pack()


def _side_order(side: ComparedSide) -> SideOrder:
    return SideOrder(
        place=side.place,
        parts={name: pack_tree(tree) for name, tree in side.trees.items()},
        hierarchy=None if side.hierarchy is None else pack_tree(side.hierarchy),
    )


# -- in the child ------------------------------------------------------------------------------------------------------


def make_difference(packed: bytes) -> bytes:
    """Compare two revisions, in a child process. `packed` is a `DifferenceOrder` as bytes.

    Return the document of the difference, encoded for the client. Raises `TooLargeProblem` if the parts cannot be
    compared.
    """
    from marey_motion.errors import MotionError

    order = DifferenceOrder.unpack(packed)
    try:
        difference = _difference(order)
    except MotionError as error:
        raise TooLargeProblem(f"The revisions cannot be compared: {error}.", code="difference-too-large") from error
    return order.encoding.encode(difference.model_dump(by_alias=True, exclude_none=True))


def _difference(order: DifferenceOrder) -> Difference:
    before = {name: unpack_tree(part) for name, part in order.before.parts.items()}
    after = {name: unpack_tree(part) for name, part in order.after.parts.items()}
    fields = _changed_fields(before, after)
    return Difference(
        kind=order.kind,
        before=order.before.place,
        after=order.after.place,
        options=order.options,
        parts={name: _part_change(before, after, name) for name in sorted({*before, *after})},
        fields=tuple(fields[:MOST_FIELDS]),
        more_fields=max(0, len(fields) - MOST_FIELDS),
        **_described(order, before, after),
    )


def _part_change(before: Mapping[str, Tree], after: Mapping[str, Tree], name: str) -> Change:
    if name not in before:
        return "added"
    return "changed" if name in after else "removed"


DESCRIBED: dict[str, frozenset[str]] = {
    "motion": frozenset({"frame_rate_hz", "joints", "poses", "translations", "translated_joints"}),
    "hierarchy": frozenset({"joints", "end_sites"}),
    "mapping": frozenset({"joints", "axes"}),
    "annotation": frozenset({"segments", "keyframes"}),
}
"""Members of parts that a difference does not list field by field, but describes in other ways."""


def _changed_fields(before: Mapping[str, Tree], after: Mapping[str, Tree]) -> list[FieldChange]:
    """List the values that differ between the revisions, in the parts that both have.

    Members in `DESCRIBED` are left out, because `_described` compares them.
    """
    from marey_motion.difference.fields import changed_values

    found: list[FieldChange] = []
    for part in sorted(before.keys() & after.keys()):
        left_out = DESCRIBED.get(part, frozenset())
        old, new = (
            {name: value for name, value in tree[part].items() if name not in left_out} for tree in (before, after)
        )
        found += (FieldChange(part=part, **value._asdict()) for value in changed_values(old, new))
    return found


def _described(order: DifferenceOrder, before: Mapping[str, Tree], after: Mapping[str, Tree]) -> dict[str, Any]:
    """Compare parts that have their own comparison, such as motions; return the results as members of `Difference`."""
    from marey_motion.difference import fields, layers, skeletons

    found: dict[str, Any] = {}
    for part in before.keys() & after.keys():
        old, new = before[part], after[part]
        if part == "motion":
            found |= _compared_motions(order, old, new)
        elif part == "hierarchy":
            found["skeleton"] = _compared_skeletons(old, new)
        elif part == "mapping":
            pair = [SkeletonMapping.model_validate(tree) for tree in (old, new)]
            found["mapping"] = skeletons.compare_mappings(*pair)
        elif part == "annotation":
            annotations = [Annotation.model_validate(tree) for tree in (old, new)]
            found["annotation"] = layers.compare_annotations(*annotations)
            found["annotations"] = tuple(annotations) if order.plot else None
        elif part == "model":
            found["model"] = fields.compare_models(old, new)
    return found


def _compared_motions(order: DifferenceOrder, before: Tree, after: Tree) -> dict[str, Any]:
    from marey_motion.difference.clips import compare_clips

    clips = [_clip(tree, side.hierarchy) for tree, side in ((before, order.before), (after, order.after))]
    motion, plot = compare_clips(clips[0], clips[1], order.options, plot=order.plot)
    return {"motion": motion, "plot": plot}


def _compared_skeletons(before: Tree, after: Tree) -> SkeletonDifference | None:
    from marey_motion.difference.skeletons import compare_skeletons

    return compare_skeletons(_skeleton(before), _skeleton(after))


def _clip(motion: Tree, hierarchy: bytes | None) -> Clip:
    from marey_motion.documents import clip_from_document

    assert hierarchy is not None
    return clip_from_document(MotionDocument.model_validate(motion), _skeleton(unpack_tree(hierarchy)))


def _skeleton(hierarchy: Tree) -> Skeleton:
    from marey_motion.documents import skeleton_from_document

    return skeleton_from_document(SkeletonHierarchy.model_validate(hierarchy))
