"""Comparison of skeletons: takes of one rig share a skeleton, although the numbers in their files differ slightly."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import and_, select

from marey_schemas.documents.skeleton_merges import MOST_RIGS_COMPARED
from marey_schemas.kinds import Kind
from marey_server.prepared_documents import PreparedDocument
from marey_server.store import documents
from marey_server.store.items.drafts import StoredDocument
from marey_server.store.items.loaded_drafts import LoadedDraft
from marey_server.store.projects import ProjectRow
from marey_server.store.tables import item, revision_part
from marey_server.store.transaction import Transaction

Tree = dict[str, Any]

SAME_NUMBER = 1e-5
"""Difference, caused by rounding in files, up to which offsets (in metres) or quaternion components count as equal."""

_UNTURNED = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class RigDocument:
    """Document `hierarchy` of a skeleton, with the values that comparisons use."""

    digest: str
    body: Tree

    @cached_property
    def names(self) -> list[str]:
        """Names of the joints."""
        return [joint["name"] for joint in self.body["joints"]]

    @cached_property
    def structure(self) -> Hashable:
        """Names and parents of the joints, and the joints with end sites: equal for all skeletons of one rig."""
        joints = tuple((joint["name"], joint["parent"], joint.get("display_name")) for joint in self.body["joints"])
        return joints, tuple(site["joint"] for site in self.body.get("end_sites", ()))

    @cached_property
    def offsets(self) -> NDArray[np.float64]:
        """Offsets of the joints in metres, (joints, 3). They are 0 for roots, because clips contain root positions."""
        return np.array(
            [joint["offset"] if joint["parent"] >= 0 else (0, 0, 0) for joint in self.body["joints"]], float
        ).reshape(-1, 3)

    @cached_property
    def others(self) -> NDArray[np.float64]:
        """Numbers that the motions of clips never replace: rest rotations of the joints, and offsets of end sites."""
        rotations = (joint.get("rest_rotation", _UNTURNED) for joint in self.body["joints"])
        sites = (site["offset"] for site in self.body.get("end_sites", ()))
        return np.array([*chain.from_iterable(rotations), *chain.from_iterable(sites)], float)


def on_known_rigs(tx: Transaction, project: ProjectRow, loaded: list[LoadedDraft]) -> list[LoadedDraft]:
    """Replace the hierarchies of new skeletons by existing hierarchies of the same rig (`is_same_rig`).

    Only drafts of skeletons with `reuse="by_content"` are changed. Returns all drafts, in the same order.
    """
    moved: dict[str, set[str]] = {}
    for one in loaded:
        joints = set(one.bodies.get("motion", {}).get("translated_joints", ()))
        for name in one.refers:
            moved[name] = moved.get(name, joints) & joints
    new = {
        one.draft.name_in_batch: RigDocument(one.contents["hierarchy"].digest, one.bodies["hierarchy"])
        for one in loaded
        if one.draft.kind is Kind.SKELETON and one.draft.reuse == "by_content" and "hierarchy" in one.contents
    }
    known = _known_rigs(tx, project, new, moved) if new else {}
    brought = {rig.digest: one.contents["hierarchy"] for one in loaded if (rig := new.get(one.draft.name_in_batch))}

    def on_known(one: LoadedDraft) -> LoadedDraft:
        rig = known.get(one.draft.name_in_batch)
        return one if rig is None else on_rig(one, rig, brought.get(rig.digest))

    return [on_known(one) for one in loaded]


def on_rig(one: LoadedDraft, rig: RigDocument, brought: PreparedDocument | StoredDocument | None = None) -> LoadedDraft:
    """Return the draft of a skeleton with the hierarchy `rig` in place of its own.

    `brought` is the document of this hierarchy, or None if the document is stored already.
    """
    kept = brought or StoredDocument(rig.digest)
    return replace(one, contents={**one.contents, "hierarchy": kept}, bodies={**one.bodies, "hierarchy": rig.body})


def _known_rigs(
    tx: Transaction, project: ProjectRow, new: Mapping[str, RigDocument], moved: Mapping[str, Collection[str]]
) -> dict[str, RigDocument]:
    """Find, for each new skeleton by name, an existing hierarchy of the same rig that it can use instead of its own.

    The hierarchy belongs to a skeleton of the project, or to an earlier skeleton in `new`. New skeletons whose own
    hierarchy the project has already are left out. `moved` names the joints of each new skeleton whose offsets the
    motions replace. The offset of the root is ignored, because every clip contains the root's position.
    """
    if {rig.digest for rig in new.values()} <= _stored_digests(tx, project).keys():
        return {}
    tx.lock(f"content:{project.id}:{Kind.SKELETON}")  # as publication does, so that two imports see each other
    stored = _stored_digests(tx, project)
    unknown = {name: rig for name, rig in new.items() if rig.digest not in stored}
    compared = list(stored)[-MOST_RIGS_COMPARED:]
    bodies = documents.load_bodies(tx, compared)
    candidates = [RigDocument(digest, bodies[digest]) for digest in compared]
    found = {}
    for name, rig in unknown.items():
        same = next((one for one in candidates if is_same_rig(one, rig, moved.get(name, ()))), None)
        if same is None:
            candidates.append(rig)
        elif same.digest != rig.digest:
            found[name] = same
    return found


def _stored_digests(tx: Transaction, project: ProjectRow) -> dict[str, str]:
    """Return the digests of the hierarchies of a project's skeletons, oldest first, each with the id of a skeleton."""
    statement = (
        select(revision_part.c.document_digest, item.c.id)
        .join(item, and_(item.c.id == revision_part.c.item_id, item.c.head == revision_part.c.number))
        .where(
            item.c.project_id == project.id, item.c.kind == Kind.SKELETON.value, item.c.deleted_us.is_(None),
            revision_part.c.part == "hierarchy",
        )
        .order_by(item.c.id)
    )  # fmt: skip
    return {row.document_digest: row.id for row in tx.execute(statement)}


def is_same_rig(known: RigDocument, new: RigDocument, moved: Collection[str]) -> bool:
    """Return whether the clips of a new skeleton have the same poses on a known skeleton.

    The skeletons may differ only in the offsets of the joints `moved`: the joints for which the motions of all clips of
    the new skeleton contain translations, which replace the offsets.
    """
    if known.digest == new.digest:
        return True
    odd = odd_offsets(known, new)
    return odd is not None and odd.issubset(moved)


def first_of_rig(known: Sequence[RigDocument], new: RigDocument, moved: Callable[[], Collection[str]]) -> int | None:
    """Return the index of the first skeleton in `known` that is the same rig as a new skeleton, or None.

    All skeletons must have the same `structure`. Skeletons with the same offsets are preferred. Only if there are none,
    `moved` is called; it returns the joints whose offsets the motions of all clips of the new skeleton replace.
    """
    if not known:
        return None
    alike = np.all(np.abs(np.stack([rig.others for rig in known]) - new.others) <= SAME_NUMBER, axis=1)
    odd = np.any(np.abs(np.stack([rig.offsets for rig in known]) - new.offsets) > SAME_NUMBER, axis=2)
    equal = alike & ~odd.any(axis=1)
    if alike.any() and not equal.any():
        replaced = set(moved())
        equal = alike & ~odd[:, [name not in replaced for name in new.names]].any(axis=1)
    return int(equal.argmax()) if equal.any() else None


def odd_offsets(known: RigDocument, new: RigDocument) -> frozenset[str] | None:
    """Return the names of the joints whose offsets differ.

    Returns None if the structures, the rest rotations or the end sites differ: then the rigs are different.
    """
    if known.structure != new.structure or np.any(np.abs(known.others - new.others) > SAME_NUMBER):
        return None
    odd = np.any(np.abs(known.offsets - new.offsets) > SAME_NUMBER, axis=1)
    return frozenset(new.names[index] for index in np.flatnonzero(odd))


def rig_difference(known: RigDocument, new: RigDocument, moved: Collection[str]) -> str:
    """Return a clause for an error text that states how two rigs differ.

    The offsets of the joints `moved` are ignored.
    """
    if odd := sorted(set(known.names) ^ set(new.names)):
        return f"only one of them has {', '.join(odd[:5])}{', ...' if len(odd) > 5 else ''}"
    if known.structure != new.structure:
        return "their joints have other parents, or another order"
    counted = [name not in moved for name in new.names]
    farthest = max(
        np.abs(known.offsets - new.offsets)[counted].max(initial=0), np.abs(known.others - new.others).max(initial=0)
    )
    return f"their offsets or rest rotations differ by up to {farthest:.2g}"
