"""Datasets, their branches and tags, and the commits to which names of versions refer."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from sqlalchemy import CTE, Row, delete, func, insert, literal_column, null, select

from marey_schemas.access import Role
from marey_schemas.datasets.naming import MAIN, CheckedOut, Dataset, DatasetCreate, Ref, RefCreate, RefKind, RefMove
from marey_schemas.datasets.protection import ProtectionRule
from marey_schemas.event_kinds import AuditKind, OrdinaryEventKind
from marey_schemas.items import Page
from marey_server.errors import ConflictProblem, InvalidProblem, NotFoundProblem
from marey_server.store import collections, listing, projects
from marey_server.store.database.clock import datetime_of
from marey_server.store.database.violations import taken
from marey_server.store.datasets.manifests import FolderManifest, read_manifests
from marey_server.store.datasets.protection import (
    require_deletable,
    require_no_protected_branch,
    require_reset,
    rule_of,
)
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.ids import new_id
from marey_server.store.projects import ProjectRow
from marey_server.store.purge_lock import hold_off_purges
from marey_server.store.revs import ExpectedRev, change_row
from marey_server.store.tables import collection, dataset, dataset_commit, dataset_ref
from marey_server.store.transaction import Transaction
from marey_versions.tree.chunks import DamagedChunk

MOST_DATASETS = 1000
"""Greatest number of datasets in a project."""
MOST_REFS = 10_000
"""Greatest number of branches and tags in a dataset."""
BRANCH_MOVED = "branch-moved"
"""Code of the error for a branch whose newest commit is not the commit that the request expects."""

_VERSION = re.compile(r"([A-Za-z0-9][A-Za-z0-9._:-]{0,127})(?:~([0-9]{1,4}))?")
_DIGITS = re.compile(r"(?:sha256:)?([0-9a-f]{8,64})")
_ALIVE = dataset.c.deleted_us.is_(None)


def find_dataset(tx: Transaction, project_row: ProjectRow, name: str) -> Row[Any]:
    """Return the row of a dataset, with the path of its folder as `path`.

    Raises `NotFoundProblem` if there is no such dataset.
    """
    row = tx.execute(_shown_rows(project_row).where(dataset.c.name == name)).first()
    if row is None:
        raise NotFoundProblem(f"There is no dataset {name!r} in this project.", code="no-dataset")
    return row


def _shown_rows(project_row: ProjectRow) -> Any:
    return (
        select(dataset, collection.c.path, collection.c.deleted_us.label("folder_deleted_us"))
        .select_from(dataset.outerjoin(collection, collection.c.id == dataset.c.collection_id))
        .where(dataset.c.project_id == project_row.id, _ALIVE)
    )


def _shown(tx: Transaction, rows: Sequence[Row[Any]]) -> tuple[Dataset, ...]:
    try:
        manifests = read_manifests(tx, rows)
    except DamagedChunk:  # which `marey db fsck` finds; the damage of one dataset must not hide the others
        manifests = {}
    return tuple(_shown_dataset(row, manifests.get(row.id)) for row in rows)


def _shown_dataset(row: Row[Any], manifest: FolderManifest | None) -> Dataset:
    return Dataset(
        id=row.id, name=row.name, description=row.description, collection=row.path,
        checked_out=None if manifest is None else CheckedOut.model_validate(manifest.shown),
        created_at=datetime_of(row.created_us), updated_at=datetime_of(row.updated_us), rev=row.rev,
    )  # fmt: skip


# -- datasets ---------------------------------------------------------------------------------------------------------


def create_dataset(tx: Transaction, project: str, request: DatasetCreate) -> Dataset:
    """Create a dataset with the branch `main`, which has no commits yet.

    Raises `ConflictProblem` if the name is taken, or if the project has too many datasets.
    """
    project_row = projects.require(tx, project)
    held = tx.execute(select(func.count()).where(dataset.c.project_id == project_row.id, _ALIVE)).scalar_one()
    _require_room(held, MOST_DATASETS, "datasets in a project", "too-many-datasets")
    if request.collection is not None:
        rights_of_caller(tx, project_row).require(request.collection, Role.CONTRIBUTOR)
    folder = None if request.collection is None else collections.ensure(tx, project_row, request.collection)
    dataset_id = new_id("dataset")
    row = {
        "id": dataset_id, "project_id": project_row.id, "name": request.name,
        "description": request.description, "collection_id": folder,
        "created_us": tx.now_us, "updated_us": tx.now_us, "rev": 1,
    }  # fmt: skip
    name_taken = f"There is already a dataset {request.name!r}; choose another name."
    with taken(ConflictProblem(name_taken, code="name-taken")):
        tx.execute(insert(dataset).values(**row))
    tx.execute(insert(dataset_ref).values(**new_ref(tx, dataset_id, MAIN, RefKind.BRANCH, None)))
    tx.emit("dataset.created", dataset_id, project_id=project_row.id, name=request.name)
    return _shown(tx, [find_dataset(tx, project_row, request.name)])[0]


def _require_room(held: int, most: int, of_what: str, code: str) -> None:
    if held >= most:
        raise ConflictProblem(f"There can be at most {most:,} {of_what}; delete one first.", code=code)


def read_dataset(tx: Transaction, project: str, name: str) -> Dataset:
    """Return a dataset as a document."""
    return _shown(tx, [find_dataset(tx, projects.require(tx, project), name)])[0]


def list_datasets(tx: Transaction, project: str, *, cursor: str | None, limit: int) -> Page:
    """List the datasets of a project in the order of their names."""
    project_row = projects.require(tx, project)
    order = listing.parse_order("name", {"name": dataset.c.name, "id": dataset.c.id})
    rows, following = listing.read_page(
        tx, _shown_rows(project_row), order, ["datasets", project_row.id], cursor, limit
    )
    return Page(items=_shown(tx, rows), next_cursor=following)


def delete_dataset(tx: Transaction, project: str, name: str, *, expected_rev: ExpectedRev) -> None:
    """Hide a dataset. Its name can be used again, and its commits stay in the database.

    Raises `ConflictProblem` if it has a protected branch.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    row = find_dataset(tx, project_row, name)
    lock_refs(tx, row.id)
    require_no_protected_branch(tx, row.id)
    absent = NotFoundProblem(f"There is no dataset {name!r} in this project.", code="no-dataset")
    values = {"deleted_us": tx.now_us, "updated_us": tx.now_us}
    change_row(tx, dataset, (dataset.c.id == row.id, _ALIVE), values, expected_rev=expected_rev, absent=absent)
    tx.audit("dataset.deleted", row.id, about=name, project_id=project_row.id, name=name)


# -- branches and tags ------------------------------------------------------------------------------------------------


def new_ref(tx: Transaction, dataset_id: str, name: str, kind: RefKind, digest: str | None) -> dict[str, Any]:
    """Return the row to insert for a new branch or tag."""
    return {
        "dataset_id": dataset_id, "name": name, "kind": kind.value, "digest": digest,
        "created_us": tx.now_us, "updated_us": tx.now_us, "rev": 1,
    }  # fmt: skip


def _shown_ref(row: Row[Any]) -> Ref:
    return Ref(
        name=row.name, kind=RefKind(row.kind), commit=row.digest, protection=rule_of(row),
        created_at=datetime_of(row.created_us), updated_at=datetime_of(row.updated_us), rev=row.rev,
    )  # fmt: skip


def list_refs(tx: Transaction, project: str, name: str, *, cursor: str | None, limit: int) -> Page:
    """List the branches and tags of a dataset in the order of their names."""
    row = find_dataset(tx, projects.require(tx, project), name)
    order = listing.parse_order("name", {"name": dataset_ref.c.name}, unique="name")
    statement = select(dataset_ref).where(dataset_ref.c.dataset_id == row.id)
    rows, following = listing.read_page(tx, statement, order, ["refs", row.id], cursor, limit)
    return Page(items=tuple(map(_shown_ref, rows)), next_cursor=following)


def find_ref(tx: Transaction, dataset_id: str, name: str, *, lock: bool = False) -> Row[Any] | None:
    """Return the row of a branch or tag, or None; with `lock`, lock the row until the transaction ends."""
    statement = select(dataset_ref).where(dataset_ref.c.dataset_id == dataset_id, dataset_ref.c.name == name)
    return tx.execute(statement.with_for_update() if lock else statement).first()


def lock_refs(tx: Transaction, dataset_id: str) -> None:
    """Lock the branches and proposals of a dataset until this transaction ends.

    While the lock is held, no other transaction can delete or protect a branch, or open a proposal.
    """
    tx.lock(f"refs of {dataset_id}")


def read_ref(tx: Transaction, project: str, name: str, ref: str) -> Ref:
    """Return a branch or a tag. Raises `NotFoundProblem` if the dataset does not have it."""
    row = find_dataset(tx, projects.require(tx, project), name)
    found = find_ref(tx, row.id, ref)
    if found is None:
        raise _no_version(ref)
    return _shown_ref(found)


def create_ref(tx: Transaction, project: str, name: str, request: RefCreate) -> Ref:
    """Create a branch or a tag at a version.

    Raises `ConflictProblem` if another branch or tag has the name, if the name is the beginning of a digest, or if the
    dataset has too many branches and tags.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    row = find_dataset(tx, project_row, name)
    digest = resolve(tx, row.id, request.at)
    _require_no_commit(tx, row.id, request.name)
    held = tx.execute(select(func.count()).where(dataset_ref.c.dataset_id == row.id)).scalar_one()
    _require_room(held, MOST_REFS, "branches and tags in a dataset", "too-many-refs")
    name_taken = f"There is already a branch or tag {request.name!r}; choose another name."
    with taken(ConflictProblem(name_taken, code="name-taken")):
        row_of_ref = new_ref(tx, row.id, request.name, request.kind, digest)
        made = tx.execute(insert(dataset_ref).values(**row_of_ref).returning(*dataset_ref.c)).one()
    created: OrdinaryEventKind = "branch.created" if request.kind is RefKind.BRANCH else "tag.created"
    tx.emit(created, row.id, project_id=project_row.id, name=request.name, commit=digest)
    return _shown_ref(made)


def move_branch(
    tx: Transaction, project: str, name: str, branch: str, request: RefMove, *, expected_rev: ExpectedRev
) -> Ref:
    """Move a branch to any version of the dataset. No commit is deleted.

    Raises `InvalidProblem` for a tag, `PreconditionFailedProblem` if the branch has moved since it was read, and
    `ConflictProblem` if the branch is protected.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    row = find_dataset(tx, project_row, name)
    digest = resolve(tx, row.id, request.at)
    which = (dataset_ref.c.dataset_id == row.id, dataset_ref.c.name == branch)
    values = {"digest": digest, "updated_us": tx.now_us}
    was = find_ref(tx, row.id, branch, lock=True)
    changed = change_row(tx, dataset_ref, which, values, expected_rev=expected_rev, absent=_no_version(branch))
    if changed.kind != RefKind.BRANCH:
        raise is_tag(branch)
    require_reset(changed)
    tx.emit("branch.moved", row.id, project_id=project_row.id, branch=branch, commit=digest)
    moved = {"branch": branch, "was": None if was is None else was.digest, "commit": digest}
    tx.audit("branch.reset", row.id, about=name, project_id=project_row.id, **moved)
    return _shown_ref(changed)


def is_tag(name: str) -> InvalidProblem:
    """Return the error for a request that names a tag where a branch is required."""
    return InvalidProblem(f"{name!r} is a tag, which never moves; name a branch.", code="is-tag")


def branch_moved(branch: str, head: str | None) -> ConflictProblem:
    """Return the error for a branch whose newest commit is not the commit that the request expects.

    `head` is the digest of the newest commit; the client finds this digest in `context.commit`.
    """
    return ConflictProblem(
        f"The branch {branch!r} has moved. Read it again, then repeat the commit.",
        code=BRANCH_MOVED,
        context={"commit": head},
        unnamed="The branch has moved. Read it again, then repeat the commit.",
    )


def dataset_replaced(name: str) -> ConflictProblem:
    """Return the error for a dataset that was deleted and created again since the request was prepared."""
    return ConflictProblem(
        f"The dataset {name!r} was deleted, and another one with its name was created; send the request again.",
        code=BRANCH_MOVED,
    )


def delete_ref(tx: Transaction, project: str, name: str, ref: str, *, expected_rev: ExpectedRev) -> None:
    """Delete a branch or a tag; the commits stay.

    Raises `InvalidProblem` for the branch `main`. Raises `ConflictProblem` if the branch is protected, or is the source
    or target of an open proposal.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    row = find_dataset(tx, project_row, name)
    lock_refs(tx, row.id)
    if ref == MAIN:
        raise InvalidProblem(f"The branch {MAIN!r} cannot be deleted.", code="is-main")
    which = (dataset_ref.c.dataset_id == row.id, dataset_ref.c.name == ref)
    changed = change_row(
        tx, dataset_ref, which, {"updated_us": tx.now_us}, expected_rev=expected_rev, absent=_no_version(ref)
    )
    require_deletable(tx, changed)
    tx.execute(delete(dataset_ref).where(*which))
    gone: AuditKind = "branch.deleted" if changed.kind == RefKind.BRANCH else "tag.deleted"
    tx.audit(gone, row.id, about=name, project_id=project_row.id, name=ref, commit=changed.digest)


def protect_branch(
    tx: Transaction, project: str, name: str, branch: str, rule: ProtectionRule | None, *, expected_rev: ExpectedRev
) -> Ref:
    """Set the protection rule of a branch; None removes it.

    Raises `InvalidProblem` for a tag, and for a branch without commits, into which nothing can be merged.
    """
    project_row = projects.require(tx, project)
    hold_off_purges(tx, project_row.id)
    row = find_dataset(tx, project_row, name)
    lock_refs(tx, row.id)
    which = (dataset_ref.c.dataset_id == row.id, dataset_ref.c.name == branch)
    stored = null() if rule is None else rule.model_dump(mode="json")
    values = {"protection": stored, "updated_us": tx.now_us}
    changed = change_row(tx, dataset_ref, which, values, expected_rev=expected_rev, absent=_no_version(branch))
    if changed.kind != RefKind.BRANCH:
        raise is_tag(branch)
    if changed.digest is None:
        raise InvalidProblem(f"The branch {branch!r} has no commits yet; commit to it first.", code="no-commits")
    if rule is None:
        tx.audit("branch.unprotected", row.id, about=name, project_id=project_row.id, branch=branch)
    else:
        tx.audit("branch.protected", row.id, about=name, project_id=project_row.id, branch=branch, rule=stored)
    return _shown_ref(changed)


# -- versions ---------------------------------------------------------------------------------------------------------


def resolve(tx: Transaction, dataset_id: str, version: str) -> str:
    """Return the digest of the commit that `version` refers to.

    `version` is the name of a branch or tag, or a digest, perhaps abbreviated. A suffix such as `~2` goes back by two
    commits, along the first parents. Raises `NotFoundProblem` if there is no such commit, and `InvalidProblem` if
    several commits begin with an abbreviated digest.
    """
    match = _VERSION.fullmatch(version)
    if match is None:
        raise _no_version(version)
    name, back = match[1], int(match[2] or 0)
    ref = find_ref(tx, dataset_id, name)
    if ref is not None and ref.digest is None:
        raise NotFoundProblem(f"The branch {name!r} has no commits yet.", code="no-commits")
    digest = _by_digits(tx, dataset_id, name) if ref is None else str(ref.digest)
    if back == 0:
        return digest
    chain = first_parents(dataset_id, digest, back)
    found = tx.execute(select(chain.c.digest).where(chain.c.place == back)).scalar()
    if found is None:
        few = "There is no commit" if back == 1 else f"There are fewer than {back} commits"
        raise NotFoundProblem(f"{few} before {name!r}, so this version does not exist.", code="no-version")
    return str(found)


def first_parents(dataset_id: str, start: str, steps: int) -> CTE:
    """Return a query for a commit and the commits before it, found by following first parents.

    The rows have the columns `digest` and `place`. The commit `start` has the place 0, its first parent the place 1,
    and so on, up to the place `steps`.
    """
    first = (dataset_commit.c.dataset_id == dataset_id, dataset_commit.c.digest == start)
    chain = select(dataset_commit.c.digest, literal_column("0").label("place")).where(*first).cte(recursive=True)
    return chain.union_all(
        select(dataset_commit.c.first_parent, chain.c.place + 1).where(
            dataset_commit.c.dataset_id == dataset_id,
            dataset_commit.c.digest == chain.c.digest,
            dataset_commit.c.first_parent.is_not(None),
            chain.c.place < steps,
        )
    )


def _commits_by_digits(tx: Transaction, dataset_id: str, name: str) -> Sequence[str]:
    """Return the digests of at most two commits that begin with the hexadecimal digits `name`.

    Two digests show that `name` is ambiguous. The result is empty if `name` does not consist of digits.
    """
    match = _DIGITS.fullmatch(name)
    if match is None:
        return ()
    first = f"sha256:{match[1]}"
    statement = select(dataset_commit.c.digest).where(
        dataset_commit.c.dataset_id == dataset_id,
        dataset_commit.c.digest >= first,
        dataset_commit.c.digest <= f"{first}g",
    )
    return tx.execute(statement.limit(2)).scalars().all()


def _require_no_commit(tx: Transaction, dataset_id: str, name: str) -> None:
    """Raise `ConflictProblem` if the digest of a commit begins with a name.

    A branch or tag with this name would hide the commit from everybody who names it by these digits.
    """
    if found := _commits_by_digits(tx, dataset_id, name):
        raise ConflictProblem(
            f"The digest of the commit {found[0]} begins with {name!r}, so this name would be ambiguous; choose "
            "another name.",
            code="name-taken",
            unnamed=f"The digest of a commit begins with {name!r}, so this name would be ambiguous; choose another "
            "name.",
        )


def _by_digits(tx: Transaction, dataset_id: str, name: str) -> str:
    found = _commits_by_digits(tx, dataset_id, name)
    if not found:
        raise _no_version(name)
    if len(found) > 1:
        raise InvalidProblem(
            f"The digests of several commits begin with {name!r}; write more digits.", code="ambiguous-version"
        )
    return str(found[0])


def _no_version(name: str) -> NotFoundProblem:
    return NotFoundProblem(
        f"The dataset has no branch, tag or commit {name!r}.", code="no-version", context={"version": name}
    )
