"""Merges of skeletons: clips and models of duplicate skeletons get new revisions that use one skeleton of the rig."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import or_

from marey_schemas.access import Role
from marey_schemas.documents.skeleton_merges import (
    MOST_MOVED,
    SKELETON_MERGE,
    MergedRig,
    MergedSkeleton,
    NamedSkeleton,
    SkeletonMergeAnswer,
    SkeletonMergeRequest,
)
from marey_schemas.kinds import Kind
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
from marey_server.store.items.same_rigs import RigDocument, is_same_rig, rig_difference
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.tables import item
from marey_server.store.transaction import Transaction, in_lists

Tree = dict[str, Any]

_MOVING = {Kind.CLIP: "motion", Kind.PROCESSED: "motion", Kind.MODEL: "model"}
"""Kinds of items that use a skeleton, with the part that refers to it."""


@dataclass
class _Used:
    """Skeleton of the project, with the items whose newest revision uses it."""

    row: Any
    hierarchy: Tree
    digest: str
    mapping: Tree | None
    users: list[_User] = field(default_factory=list)

    @property
    def named(self) -> dict[str, str]:
        return {"id": self.row.id, "path": f"{self.row.path}/{self.row.name}".lstrip("/")}

    @property
    def is_edited(self) -> bool:
        """Whether somebody made or confirmed the joint map."""
        return self.mapping is not None and self.mapping.get("method") == "manual"

    @property
    def rig(self) -> RigDocument:
        """The hierarchy, with the joints whose offsets the motions of all users replace."""
        replaced = [set(one.bodies[one.part].get("translated_joints", ())) for one in self.users]
        return RigDocument(self.digest, self.hierarchy, frozenset(set.intersection(*replaced) if replaced else ()))


@dataclass(frozen=True)
class _User:
    """Item that uses a skeleton, with the documents of its newest revision."""

    row: Any
    digests: Mapping[str, str]
    bodies: Mapping[str, Tree]

    @property
    def kind(self) -> Kind:
        return Kind(self.row.kind)

    @property
    def part(self) -> str:
        return _MOVING[self.kind]


def merge_skeletons(tx: Transaction, project: str, request: SkeletonMergeRequest) -> SkeletonMergeAnswer:
    """Merge skeletons of one rig, all or none; with `dry_run`, only find them.

    Clips, aligned clips and models of a merged skeleton get a revision that refers to the newest revision of the kept
    one, and is otherwise the same; annotations of the clips move with them. The merged skeletons are deleted.

    Raises `NotFoundProblem` for an unknown skeleton, `InvalidProblem` for named skeletons that are not the same rig,
    `ConflictProblem` for a joint map made by hand that would be lost, `TooLargeProblem`, and `ForbiddenProblem` unless
    the caller is a maintainer of all folders.
    """
    row = projects.require(tx, project)
    if request.dry_run:
        rights_shown(tx, row).require_below("", Role.MAINTAINER)
    else:
        hold_off_purges(tx, row.id)
        rights_of_caller(tx, row).require_below("", Role.MAINTAINER)
        tx.lock(f"content:{row.id}:{Kind.SKELETON}")  # as publication does, so that no import uses a merged skeleton
    rigs = _rigs(_find_used(tx, row, request), request)
    if not request.dry_run:
        for kept, merged in rigs:
            for one in merged:
                _move(tx, row, one, kept)
                delete_item(tx, project, Kind.SKELETON, one.row.id, expected_rev=None)
    shown = [
        MergedRig(
            kept=NamedSkeleton(**kept.named),
            merged=tuple(
                MergedSkeleton(**one.named, moved=dict(Counter(user.row.kind for user in one.users))) for one in merged
            ),
        )
        for kept, merged in rigs
    ]
    return SkeletonMergeAnswer(rigs=tuple(shown), dry_run=request.dry_run)


# -- what is merged ----------------------------------------------------------------------------------------------------


def _find_used(tx: Transaction, project: ProjectRow, request: SkeletonMergeRequest) -> list[_Used]:
    named = {*request.skeletons, *([request.kept] if request.kept else ())}
    whole = not request.skeletons
    statement = item_rows().where(
        item.c.project_id == project.id, item.c.kind == Kind.SKELETON.value, item.c.deleted_us.is_(None)
    )
    if not whole:
        statement = statement.where(item.c.id.in_(sorted(named)))
    rows = tx.execute(_locked(statement, request).order_by(item.c.id).limit(MOST_MOVED + 1)).all()
    if absent := sorted(named - {row.id for row in rows}):
        raise no_item(Kind.SKELETON, absent[0])
    _require_few(len(rows), "skeletons")
    digests = read_part_digests(tx, [(row.id, row.head) for row in rows])
    bodies = documents.load_bodies(tx, {digest for parts in digests.values() for digest in parts.values()})
    skeletons = {}
    for row in rows:
        parts = digests[row.id, row.head]
        mapping = bodies[parts["mapping"]] if "mapping" in parts else None
        skeletons[row.id] = _Used(row, bodies[parts["hierarchy"]], parts["hierarchy"], mapping)
    for user in _users(tx, project, sorted(skeletons), request):
        skeletons[user.row.skeleton_id].users.append(user)
    return list(skeletons.values())


def _users(
    tx: Transaction, project: ProjectRow, skeletons: Sequence[str], request: SkeletonMergeRequest
) -> Iterator[_User]:
    """Yield the items whose newest revision uses one of the skeletons, each with its documents."""
    for some in in_lists(skeletons):
        statement = item_rows().where(
            item.c.project_id == project.id, item.c.skeleton_id.in_(some), item.c.deleted_us.is_(None),
            item.c.kind.in_([kind.value for kind in _MOVING]),
        )  # fmt: skip
        for rows in in_lists(tx.execute(_locked(statement, request).order_by(item.c.id)).all()):
            digests = read_part_digests(tx, [(row.id, row.head) for row in rows])
            bodies = documents.load_bodies(
                tx, {parts[part] for parts in digests.values() for part in ("motion", "model", "tree") if part in parts}
            )
            for row in rows:
                parts = digests[row.id, row.head]
                yield _User(row, parts, {part: bodies[digest] for part, digest in parts.items() if digest in bodies})


def _locked(statement: Any, request: SkeletonMergeRequest) -> Any:
    """Lock the rows of items that are merged or moved, so that nobody revises them meanwhile."""
    return statement if request.dry_run else statement.with_for_update(of=item)


def _rigs(skeletons: Sequence[_Used], request: SkeletonMergeRequest) -> list[tuple[_Used, list[_Used]]]:
    """Return each skeleton that is kept, with those that are merged into it."""
    best_first = sorted(
        skeletons, key=lambda one: (one.row.id != request.kept, not one.is_edited, -len(one.users), one.row.id)
    )
    rigs: list[tuple[_Used, list[_Used]]] = []
    for one in best_first:
        same = next((found for found in rigs if is_same_rig(found[0].rig, one.rig)), None)
        if same is None:
            rigs.append((one, []))
        else:
            _require_same_mapping(same[0], one, request)
            same[1].append(one)
    if request.skeletons and len(rigs) > 1:
        first, other = rigs[0][0], rigs[1][0]
        raise InvalidProblem(
            f"The skeletons {first.named['path']} and {other.named['path']} are not one rig: "
            f"{rig_difference(first.rig, other.rig)}. Name skeletons of one rig, or none to merge all duplicates.",
            code="other-rig",
        )
    found = [rig for rig in rigs if rig[1] and (request.kept in (None, rig[0].row.id))]
    _require_few(sum(len(one.users) for _, merged in found for one in merged), "clips and models")
    return found


def _require_same_mapping(kept: _Used, merged: _Used, request: SkeletonMergeRequest) -> None:
    if merged.is_edited and merged.mapping != kept.mapping and request.kept is None:
        raise ConflictProblem(
            f"Somebody made or confirmed the joint maps of {kept.named['path']} and {merged.named['path']}, and they "
            "differ; choose the skeleton that remains with --keep (in requests: kept).",
            code="mappings-differ",
        )


def _require_few(count: int, what: str) -> None:
    if count > MOST_MOVED:
        raise TooLargeProblem(
            f"One merge handles at most {MOST_MOVED} {what}, and there are more; name some of the skeletons to merge."
        )


# -- moving ------------------------------------------------------------------------------------------------------------


def _move(tx: Transaction, project: ProjectRow, merged: _Used, kept: _Used) -> None:
    """Give the users of a skeleton revisions that use the kept one, and move the annotations of clips to them."""
    reference = {"item": kept.row.id, "revision": kept.row.head}
    message = f"The skeleton {merged.named['path']} was merged into {kept.named['path']}"
    drafts = [_draft(tx, user, reference, message) for user in merged.users]
    _publish(tx, project, drafts)
    clips = {user.row.id: user.row.head for user in merged.users if user.kind is Kind.CLIP}
    _publish(tx, project, list(_moved_annotations(tx, project, clips, message)))


def _publish(tx: Transaction, project: ProjectRow, drafts: Sequence[Draft]) -> list[Published]:
    made = publish(tx, project, drafts, author_id=tx.principal.user_id, rights=rights_of_caller(tx, project))
    for one in made:
        repeat_facets(tx, one.item, one.revision - 1, one.revision)
    return made


def _draft(tx: Transaction, user: _User, reference: Tree, message: str) -> Draft:
    """Return the draft of an item's revision with another skeleton; the arrays of its documents are the same."""
    changed = {user.part: {**user.bodies[user.part], "skeleton": reference}}
    if "tree" in user.bodies:
        changed["tree"] = {**user.bodies["tree"], "model_digest": digest_of_body(changed["model"])}
    return _revised(tx, user.row, user.digests, changed, message)


def _revised(tx: Transaction, row: Any, digests: Mapping[str, str], changed: Mapping[str, Tree], message: str) -> Draft:
    documents.store_variants(tx, [(digests[part], body) for part, body in changed.items()])
    return Draft(
        name_in_batch=row.id, kind=Kind(row.kind), item_name=row.name, collection=row.path, message=message,
        parts={part: StoredDocument(digest_of_body(body)) for part, body in changed.items()},
        sources={SKELETON_MERGE: [(row.id, row.head)]},
    )  # fmt: skip


def _moved_annotations(tx: Transaction, project: ProjectRow, clips: Mapping[str, int], message: str) -> Iterator[Draft]:
    """Yield drafts of the annotations of clips; `clips` are the revisions of the clips before the merge.

    Annotations of earlier revisions stay as they are.
    """
    for some in in_lists(sorted(clips)):
        of_clips = or_(*(item.c.summary["clip"].as_string() == clip for clip in some))
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
