"""Writes to one dataset while another request writes to it: nothing is lost, repeated or answered with 500."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.support.store_fixtures import WRITE, Lab, skeleton_tree

from marey_schemas.access import Role
from marey_schemas.datasets.commits import CommitCreate
from marey_schemas.datasets.merges import CheckoutRequest
from marey_schemas.datasets.naming import MAIN, DatasetCreate
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access.roles import RequiredRole
from marey_server.errors import ConflictProblem
from marey_server.store import datasets, items
from marey_server.store.database.connections import Database

pytestmark = pytest.mark.every_database

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


def put(lab: Lab, name: str) -> None:
    request = ItemCreate(name=name, collection="gaits", parts={"hierarchy": skeleton_tree(bone_m=len(name))})
    lab.write(items.create_item, "lab", Kind.SKELETON, request)


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
