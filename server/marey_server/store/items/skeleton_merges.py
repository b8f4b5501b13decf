"""Merges of skeletons: clips and models of duplicate skeletons get new revisions that use one skeleton of the rig."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import ColumnElement, and_, exists, func, or_, select

from marey_schemas.access import Role
from marey_schemas.documents.skeleton_merges import (
    MOST_MOVED,
    MOST_RIGS_COMPARED,
    SKELETON_MERGE,
    MergedRig,
    MergedSkeleton,
    NamedSkeleton,
    SkeletonMergeAnswer,
    SkeletonMergeRequest,
)
from marey_schemas.kinds import Kind
from marey_schemas.sizes import batched
from marey_server.errors import ConflictProblem, InvalidProblem, TooLargeProblem
from marey_server.prepared_documents import digest_of_body
from marey_server.store import documents, projects
from marey_server.store.folder_roles.rights import rights_of_caller, rights_shown
from marey_server.store.items.changing import delete_item
from marey_server.store.items.drafts import Draft, Published, StoredDocument
from marey_server.store.items.facets import repeat_facets
from marey_server.store.items.publishing import publish
from marey_server.store.items.reading import item_rows, no_item
from marey_server.store.items.revisions import read_part_digests
from marey_server.store.items.same_rigs import RigDocument, first_of_rig, odd_offsets, rig_difference
from marey_server.store.items.summaries import SKELETON_PARTS
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import item
from marey_server.store.transaction import Transaction, in_lists

Tree = dict[str, Any]

_LOADED_TOGETHER = 50
"""Number of items whose documents are loaded at once. It is small, because often the first item decides the result."""


@dataclass
class _Skeleton:
    """Skeleton of the project, with the number of items of each kind whose newest revision uses it (`users`)."""

    row: Any
    rig: RigDocument
    mapping: Tree | None
    users: Mapping[str, int]
    odd: frozenset[str] = frozenset()
    """Joints whose offsets differ from those of the skeleton that is kept; all motions must replace them."""

    @property
    def named(self) -> dict[str, str]:
        return {"id": self.row.id, "path": f"{self.row.path}/{self.row.name}".lstrip("/")}

    @property
    def is_edited(self) -> bool:
        """Whether somebody made or confirmed the joint map."""
        return self.mapping is not None and self.mapping.get("method") == "manual"

    @property
    def user_count(self) -> int:
        return sum(self.users.values())


@dataclass(frozen=True)
class _UsingItem:
    """Item that uses a skeleton, with the documents of its newest revision."""

    row: Any
    digests: Mapping[str, str]
    bodies: Mapping[str, Tree]

    @property
    def kind(self) -> Kind:
        return Kind(self.row.kind)

    @property
    def moved(self) -> frozenset[str]:
        """Names of the joints whose offsets the motion of the item replaces with translations."""
        return frozenset(self.bodies[SKELETON_PARTS[self.kind]].get("translated_joints", ()))


def merge_skeletons(tx: Transaction, project: str, request: SkeletonMergeRequest) -> SkeletonMergeAnswer:
    """Merge skeletons of one rig, all or none; with `dry_run`, only find them.

    Clips, aligned clips and models of a merged skeleton get a new revision, which differs only in that it refers to the
    newest revision of the kept skeleton. Annotations of the clips get revisions that refer to the new revisions of the
    clips. The merged skeletons are deleted.

    Raises `NotFoundProblem` for an unknown skeleton, and `InvalidProblem` if the named skeletons are not one rig.
    Raises `ConflictProblem` if a joint map that somebody has made or confirmed would be lost, or if another request
    changes the items. Raises `TooLargeProblem` for too many skeletons or items, and `ForbiddenProblem` unless the
    caller is a maintainer of all folders.
    """
    row = projects.require(tx, project)
    if request.dry_run:
        rights_shown(tx, row).require_below("", Role.MAINTAINER)
    else:
        hold_off_purges(tx, row.id)
        rights_of_caller(tx, row).require_below("", Role.MAINTAINER)
        tx.lock(f"content:{row.id}:{Kind.SKELETON}")  # as publication does, so that no import uses a merged skeleton
    rigs = _rigs(tx, row, _find_skeletons(tx, row, request), request)
    if not request.dry_run:
        for kept, merged in rigs:
            for one in merged:
                _move(tx, row, one, kept)
                if one.row.deleted_us is None:
                    delete_item(tx, project, Kind.SKELETON, one.row.id, expected_rev=None)
    shown = [
        MergedRig(
            kept=NamedSkeleton(**kept.named),
            merged=tuple(MergedSkeleton(**one.named, moved=dict(one.users)) for one in merged),
        )
        for kept, merged in rigs
    ]
    return SkeletonMergeAnswer(rigs=tuple(shown), dry_run=request.dry_run)


# -- what is merged ----------------------------------------------------------------------------------------------------


def _find_skeletons(tx: Transaction, project: ProjectRow, request: SkeletonMergeRequest) -> list[_Skeleton]:
    """Return the skeletons to compare; without `dry_run`, lock their rows, so that nobody revises them meanwhile.

    A deleted skeleton is compared if existing items use it. There are such items if a checkout has restored them.
    """
    named = {*request.skeletons, *([request.kept] if request.kept else ())}
    user = item.alias("user")
    is_used = exists().where(user.c.skeleton_id == item.c.id, user.c.deleted_us.is_(None))
    statement = item_rows().where(
        item.c.project_id == project.id, item.c.kind == Kind.SKELETON.value, item.c.purged_us.is_(None),
        or_(item.c.deleted_us.is_(None), is_used),
    )  # fmt: skip
    if request.skeletons:
        statement = statement.where(item.c.id.in_(sorted(named)))
    rows = tx.execute(_locked(statement, request).order_by(item.c.id).limit(MOST_RIGS_COMPARED + 1)).all()
    if len(rows) > MOST_RIGS_COMPARED:
        raise TooLargeProblem(
            f"One merge compares at most {MOST_RIGS_COMPARED} skeletons, and there are more; name skeletons of one rig."
        )
    if absent := sorted(named - {row.id for row in rows}):
        raise no_item(Kind.SKELETON, absent[0])
    digests = read_part_digests(tx, [(row.id, row.head) for row in rows])
    bodies = documents.load_bodies(tx, {digest for parts in digests.values() for digest in parts.values()})
    counts = _count_users(tx, project, [row.id for row in rows])
    found = []
    for row in rows:
        parts = digests[row.id, row.head]
        mapping = bodies[parts["mapping"]] if "mapping" in parts else None
        rig = RigDocument(parts["hierarchy"], bodies[parts["hierarchy"]])
        found.append(_Skeleton(row, rig, mapping, counts.get(row.id, {})))
    return found


def _uses(project: ProjectRow, skeletons: Sequence[str]) -> ColumnElement[bool]:
    """Return the SQL condition for items of the project that use one of the skeletons, so that a merge changes them."""
    return and_(
        item.c.project_id == project.id, item.c.skeleton_id.in_(skeletons), item.c.deleted_us.is_(None),
        item.c.kind.in_([kind.value for kind in SKELETON_PARTS]),
    )  # fmt: skip


def _count_users(tx: Transaction, project: ProjectRow, skeletons: Sequence[str]) -> dict[str, dict[str, int]]:
    counts: defaultdict[str, dict[str, int]] = defaultdict(dict)
    for some in in_lists(skeletons):
        columns = (item.c.skeleton_id, item.c.kind, func.count().label("users"))
        statement = select(*columns).where(_uses(project, some)).group_by(item.c.skeleton_id, item.c.kind)
        for row in tx.execute(statement):
            counts[row.skeleton_id][row.kind] = row.users
    return counts


def _items_using(tx: Transaction, project: ProjectRow, skeleton: str, *, lock: bool) -> Iterator[_UsingItem]:
    """Yield the items whose newest revision uses a skeleton, each with its documents; with `lock`, lock their rows."""
    statement = item_rows().where(_uses(project, [skeleton])).order_by(item.c.id).limit(MOST_MOVED)
    rows = tx.execute(statement.with_for_update(of=item) if lock else statement).all()
    for some in batched(rows, _LOADED_TOGETHER):
        digests = read_part_digests(tx, [(row.id, row.head) for row in some])
        wanted = {*SKELETON_PARTS.values(), "tree"}
        bodies = documents.load_bodies(
            tx, {digest for parts in digests.values() for part, digest in parts.items() if part in wanted}
        )
        for row in some:
            parts = digests[row.id, row.head]
            yield _UsingItem(row, parts, {part: bodies[digest] for part, digest in parts.items() if digest in bodies})


def _locked(statement: Any, request: SkeletonMergeRequest) -> Any:
    return statement if request.dry_run else statement.with_for_update(of=item)


def _rigs(
    tx: Transaction, project: ProjectRow, skeletons: Sequence[_Skeleton], request: SkeletonMergeRequest
) -> list[tuple[_Skeleton, list[_Skeleton]]]:
    """Return each skeleton that is kept, with the skeletons that are merged into it.

    Skeletons may differ in offsets that motions replace. Only in this case, the documents of clips and other items are
    read. Raises `InvalidProblem` if named skeletons are not one rig, `ConflictProblem` if joint maps that somebody
    edited differ, and `TooLargeProblem` if more than `MOST_MOVED` items would change.
    """
    best_first = sorted(
        skeletons,
        key=lambda one: (
            one.row.id != request.kept, one.row.deleted_us is not None, not one.is_edited, -one.user_count, one.row.id
        ),
    )  # fmt: skip
    rigs: list[tuple[_Skeleton, list[_Skeleton]]] = []
    alike: defaultdict[Hashable, list[tuple[_Skeleton, list[_Skeleton]]]] = defaultdict(list)
    for one in best_first:
        same_structure = alike[one.rig.structure]
        place = first_of_rig([kept.rig for kept, _ in same_structure], one.rig, partial(_moved, tx, project, one))
        if place is None:
            rigs.append((one, []))
            same_structure.append(rigs[-1])
        else:
            same = same_structure[place]
            _require_same_mapping(same[0], one, request)
            one.odd = odd_offsets(same[0].rig, one.rig) or frozenset()
            same[1].append(one)
    if request.skeletons and len(rigs) > 1:
        first, other = rigs[0][0], rigs[1][0]
        raise InvalidProblem(
            f"The skeletons {first.named['path']} and {other.named['path']} are not one rig: "
            f"{rig_difference(first.rig, other.rig, _moved(tx, project, other))}. Name skeletons of one rig, or "
            "none to merge all duplicates.",
            code="other-rig",
            unnamed="The skeletons are not one rig. Name skeletons of one rig, or none to merge all duplicates.",
        )
    found = [rig for rig in rigs if rig[1] and (request.kept in (None, rig[0].row.id))]
    if sum(one.user_count for _, merged in found for one in merged) > MOST_MOVED:
        raise TooLargeProblem(
            f"One merge changes at most {MOST_MOVED} clips and models, and more use these skeletons; name the "
            "skeletons to merge, and fewer at a time."
        )
    return found


def _moved(tx: Transaction, project: ProjectRow, skeleton: _Skeleton) -> frozenset[str]:
    """Return the joints whose offsets are replaced by the motion of every item that uses a skeleton.

    The result is empty if no item uses the skeleton, or if more than `MOST_MOVED` items do.
    """
    if skeleton.user_count > MOST_MOVED:
        return frozenset()
    common: frozenset[str] | None = None
    for one in _items_using(tx, project, skeleton.row.id, lock=False):
        common = one.moved if common is None else common & one.moved
        if not common:
            break  # most motions replace no offset, so the first one decides
    return common or frozenset()


def _require_same_mapping(kept: _Skeleton, merged: _Skeleton, request: SkeletonMergeRequest) -> None:
    if merged.is_edited and merged.mapping != kept.mapping and request.kept is None:
        raise ConflictProblem(
            f"The joint map of {kept.named['path']} differs from the joint map of {merged.named['path']}, which "
            "somebody made or confirmed; choose the skeleton that remains with --keep (in requests: kept).",
            code="mappings-differ",
            unnamed="A joint map that somebody made or confirmed differs from the joint map of another skeleton; "
            "choose the skeleton that remains with --keep (in requests: kept).",
        )


# -- moving ------------------------------------------------------------------------------------------------------------


def _move(tx: Transaction, project: ProjectRow, merged: _Skeleton, kept: _Skeleton) -> None:
    """Replace the merged skeleton by the kept one, in new revisions of all items that use the merged skeleton.

    The annotations of clips get revisions that refer to the new revisions of the clips. Raises `ConflictProblem` if
    another request has changed one of the items.
    """
    reference = {"item": kept.row.id, "revision": kept.row.head}
    message = f"The skeleton {merged.named['path']} was merged into {kept.named['path']}"
    found = list(_items_using(tx, project, merged.row.id, lock=True))
    if Counter(one.row.kind for one in found) != merged.users or any(not merged.odd <= one.moved for one in found):
        raise ConflictProblem(
            f"Other requests changed items that use the skeleton {merged.named['path']} at the same time; try again.",
            code="contended",
            unnamed="Other requests changed items that use a skeleton at the same time; try again.",
        )
    _publish(tx, project, [_draft(tx, one, reference, message) for one in found])
    clips = {one.row.id: one.row.head for one in found if one.kind is Kind.CLIP}
    _publish(tx, project, list(_moved_annotations(tx, project, clips, message)))


def _publish(tx: Transaction, project: ProjectRow, drafts: Sequence[Draft]) -> list[Published]:
    made = publish(tx, project, drafts, author_id=tx.principal.user_id, rights=rights_of_caller(tx, project))
    for one in made:
        repeat_facets(tx, one.item, one.revision - 1, one.revision)
    return made


def _draft(tx: Transaction, one: _UsingItem, reference: Tree, message: str) -> Draft:
    """Return the draft of a new revision of an item that refers to another skeleton; its arrays are the same."""
    part = SKELETON_PARTS[one.kind]
    changed = {part: {**one.bodies[part], "skeleton": reference}}
    if "tree" in one.bodies:
        changed["tree"] = {**one.bodies["tree"], "model_digest": digest_of_body(changed["model"])}
    return _revised(tx, one.row, one.digests, changed, message)


def _revised(tx: Transaction, row: Any, digests: Mapping[str, str], changed: Mapping[str, Tree], message: str) -> Draft:
    documents.store_variants(tx, [(digests[part], body) for part, body in changed.items()])
    return Draft(
        name_in_batch=row.id, kind=Kind(row.kind), item_name=row.name, collection=row.path, message=message,
        parts={part: StoredDocument(digest_of_body(body)) for part, body in changed.items()},
        sources={SKELETON_MERGE: [(row.id, row.head)]},
    )  # fmt: skip


def _moved_annotations(tx: Transaction, project: ProjectRow, clips: Mapping[str, int], message: str) -> Iterator[Draft]:
    """Yield drafts in which the annotations of clips refer to the next revisions of the clips.

    `clips` maps the ids of the clips to their newest revisions before the merge. Annotations that refer to earlier
    revisions are left out.
    """
    for some in in_lists(sorted(clips)):
        of_clips = item.c.summary["clip"].as_string().in_(some)
        statement = item_rows().where(
            item.c.project_id == project.id, item.c.kind == Kind.ANNOTATION.value, item.c.deleted_us.is_(None), of_clips
        )
        rows = tx.execute(statement.with_for_update(of=item).order_by(item.c.id)).all()
        digests = read_part_digests(tx, [(row.id, row.head) for row in rows])
        bodies = documents.load_bodies(tx, {parts["annotation"] for parts in digests.values()})
        for row in rows:
            parts = digests[row.id, row.head]
            body = bodies[parts["annotation"]]
            clip = body["clip"]["item"]
            if body["clip"]["revision"] == clips.get(clip):
                moved = {**body, "clip": {"item": clip, "revision": clips[clip] + 1}}
                yield _revised(tx, row, parts, {"annotation": moved}, message)
