"""Two requests that write to one dataset at the same time: nothing is lost, repeated or answered with 500."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.support.interleaving import Step, interleave
from tests.support.store_fixtures import WRITE, Lab, requiring, skeleton_tree

from marey_schemas.access import Role
from marey_schemas.datasets.checkouts import CheckoutRequest
from marey_schemas.datasets.commits import CommitCreate, PutEntry
from marey_schemas.datasets.contents import ReceivedCommit, ReceivedRevision
from marey_schemas.datasets.naming import MAIN, DatasetCreate, RefCreate, RefKind
from marey_schemas.encoding.canonical import document_digest
from marey_schemas.items import Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access.roles import RequiredRole
from marey_server.errors import ConflictProblem, InvalidProblem
from marey_server.store import datasets, items
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Transaction
from marey_versions.records import CommitRecord, key_of, revision_content
from marey_versions.tree.building import build
from marey_versions.tree.chunks import ChunksInMemory

pytestmark = pytest.mark.every_database
on_postgres = pytest.mark.parametrize("database_url", ["postgres"], indirect=True)

AT = "2020-01-02T03:04:05.000006Z"
GAITS = ("lab", "gaits")
MAINTAIN = RequiredRole(Role.MAINTAINER, "write")


@pytest.fixture
def other(open_database: Callable[[], Database]) -> Database:
    """The same database, opened again as another server process would open it."""
    return open_database()


@pytest.fixture
def gaits(lab: Lab) -> Lab:
    """The project `lab` with the dataset `gaits`; its folder is committed twice, with one and with two skeletons."""
    lab.write(datasets.create_dataset, "lab", DatasetCreate(name="gaits", collection="gaits"))
    for name in ("a", "b"):
        put(lab, name)
        record(lab, prepare(lab))
    return lab


def put(lab: Lab, name: str) -> Item:
    request = ItemCreate(name=name, collection="gaits", parts={"hierarchy": skeleton_tree()})
    made: Item = lab.write(items.create_item, "lab", Kind.SKELETON, request)
    return made


def prepare(lab: Lab) -> Any:
    """Prepare a commit of the folder."""
    return lab.read(datasets.prepare_commit, *GAITS, CommitCreate(message="m"), required=WRITE)


def record(lab: Lab, prepared: Any) -> Any:
    return lab.write(datasets.record_commit, *GAITS, prepared)


def check_out(lab: Lab, version: str) -> None:
    lab.write(datasets.check_out, *GAITS, CheckoutRequest(version=version, discard=True), required=MAINTAIN)


@pytest.mark.parametrize("version", [MAIN, f"{MAIN}~1"])
def test_a_checkout_during_a_commit_of_the_folder_lets_no_later_commit_undo_it(gaits: Lab, version: str) -> None:
    put(gaits, "c")
    prepared = prepare(gaits)
    check_out(gaits, version)
    made = record(gaits, prepared)
    with pytest.raises(ConflictProblem) as refused:
        prepare(gaits)
    assert refused.value.error_code == "folder-elsewhere"
    assert gaits.read(datasets.read_commit, *GAITS, MAIN) == made
    check_out(gaits, MAIN)
    put(gaits, "d")
    assert record(gaits, prepare(gaits)).entries == 4


def test_a_selection_is_not_checked_out_in_another_dataset_with_the_same_name(gaits: Lab) -> None:
    request = CheckoutRequest(paths=("a",), discard=True)
    selected = gaits.read(datasets.select_entries, *GAITS, request, required=MAINTAIN)
    gaits.write(datasets.delete_dataset, *GAITS, expected_rev=None, required=MAINTAIN)
    gaits.write(datasets.create_dataset, "lab", DatasetCreate(name="gaits", collection="gaits"))
    with pytest.raises(ConflictProblem) as refused:
        gaits.write(datasets.check_out, *GAITS, request, selected, required=MAINTAIN)
    assert refused.value.error_code == "branch-moved"


def both(lab: Lab, other: Database, first: Callable[..., Any], second: Callable[..., Any]) -> tuple[Any, Any]:
    """Interleave two writes of the owner; return their results or errors."""
    one, two = requiring(MAINTAIN, first), requiring(MAINTAIN, second)
    return interleave(Step(lab.database, lab.owner, one), Step(other, lab.owner, two))


@on_postgres
@pytest.mark.parametrize("paths", [((), ("a",)), (("a",), ()), (("a",), ("b",))], ids=["part", "whole", "another part"])
def test_of_two_checkouts_the_folder_has_all_entries_of_the_second(
    gaits: Lab, other: Database, paths: tuple[tuple[str, ...], tuple[str, ...]]
) -> None:
    """If entries were missing, the next commit of the folder would remove them from the branch."""

    def checking_out(only: tuple[str, ...]) -> Callable[[Transaction], Any]:
        request = CheckoutRequest(paths=only, discard=True)
        selected = gaits.read(datasets.select_entries, *GAITS, request, required=MAINTAIN)
        return lambda tx: datasets.check_out(tx, *GAITS, request, selected)

    both(gaits, other, *map(checking_out, paths))
    with pytest.raises(InvalidProblem) as refused:
        prepare(gaits)
    assert refused.value.error_code == "no-changes"


@on_postgres
@pytest.mark.parametrize("branches", [(MAIN, MAIN), (MAIN, "trial")], ids=["same", "another"])
def test_a_commit_that_is_repeated_while_it_is_recorded_is_made_once(
    gaits: Lab, other: Database, branches: tuple[str, str]
) -> None:
    gaits.write(datasets.create_ref, *GAITS, RefCreate(name="trial", kind=RefKind.BRANCH))
    change = PutEntry(path="c", item=put(gaits, "c").id)

    def recording(branch: str) -> Callable[[Transaction], Any]:
        request = CommitCreate(branch=branch, message="m", changes=(change,), write_id="12345678")
        prepared = gaits.read(datasets.prepare_commit, *GAITS, request, required=WRITE)
        return lambda tx: datasets.record_commit(tx, *GAITS, prepared)

    first, second = both(gaits, other, *map(recording, branches))
    assert first == second == gaits.read(datasets.read_commit, *GAITS, MAIN)


def received(path: str | None = None) -> ReceivedRevision:
    """Return a revision as another server sends it; without a path, it belongs to no entry."""
    tree = skeleton_tree(2)
    content = revision_content("skeleton", {"hierarchy": document_digest(tree)})
    return ReceivedRevision(content=content, kind=Kind.SKELETON, path=path, parts={"hierarchy": tree})


@on_postgres
@pytest.mark.parametrize("path", ["rig", None])
def test_of_two_senders_of_a_revision_one_adds_it(gaits: Lab, other: Database, path: str | None) -> None:
    revisions = (received(path),)
    local = gaits.read(datasets.find_local, "lab", revisions, [].append, required=MAINTAIN)

    def store(tx: Transaction) -> int:
        return datasets.store_revisions(tx, *GAITS, datasets.prepare_revisions(revisions, local), local).added

    assert both(gaits, other, store, store) == (1, 0)


@on_postgres
def test_two_senders_of_a_commit_get_the_same_answer(gaits: Lab, other: Database) -> None:
    revisions, parts = (received("rig"),), {"hierarchy": document_digest(skeleton_tree(2))}
    local = gaits.read(datasets.find_local, "lab", revisions, [].append, required=MAINTAIN)
    drafts = datasets.prepare_revisions(revisions, local)
    gaits.write(datasets.store_revisions, *GAITS, drafts, local, required=MAINTAIN)
    tree = build(ChunksInMemory(), [(key_of("rig", "skeleton"), {"parts": parts, "tags": []})])
    body = {"tree": tree, "parents": (), "author": "a", "message": "m", "at": AT}
    request = ReceivedCommit.model_validate({**body, "changes": ({"path": "rig", "kind": "skeleton", "parts": parts},)})
    prepared = gaits.read(datasets.prepare_receipt, *GAITS, request, required=MAINTAIN)
    first, second = both(
        gaits, other, *(lambda tx: datasets.record_receipt(tx, *GAITS, request, prepared) for _ in range(2))
    )
    assert first == second
    assert first.digest == CommitRecord(tree, (), "a", "m", AT).digest
