"""Queries over entries of a version: the contents that the database selects first leave out no entry."""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, example, given, settings
from tests.support.kept_rows import made_once
from tests.support.tiers import examples
from tests.unit.server.test_querying import QueriedLab, queries

from marey_schemas.datasets.checkouts import CheckoutRequest
from marey_schemas.datasets.commits import CommitCreate, PutEntry
from marey_schemas.datasets.naming import DatasetCreate
from marey_schemas.kinds import Kind
from marey_server.errors import InvalidProblem
from marey_server.store import datasets, items
from marey_server.store.database.connections import Database
from marey_server.store.datasets import selecting


def versioned_lab(database: Database) -> QueriedLab:
    """Return a project with a version of all its clips; later, some of the clips were changed, and one was deleted."""
    lab = QueriedLab(database)
    lab.write(datasets.create_dataset, "lab", DatasetCreate(name="gaits"))
    puts = tuple(PutEntry(path=f"all/{clip.name}", item=clip.id) for clip in lab.clips)
    prepared = lab.read(datasets.prepare_commit, "lab", "gaits", CommitCreate(message="all", changes=puts))
    lab.write(datasets.record_commit, "lab", "gaits", prepared)
    for clip in lab.clips[1::4]:
        info = {"schema": "marey/clip-info@1", "subject": "02", "action": "walk"}
        lab.write(items.put_part, "lab", Kind.CLIP, clip.id, "info", info, expected_rev=None)
    lab.write(items.delete_item, "lab", Kind.CLIP, lab.clips[0].id, expected_rev=None)
    return lab


@pytest.fixture
def versioned(database: Database) -> QueriedLab:
    return made_once(versioned_lab, database)


def selected_tree(lab: QueriedLab, text: str) -> str | None:
    """Return the root of the tree of the entries that a query selects; None if it selects none."""
    try:
        found = lab.read(datasets.select_entries, "lab", "gaits", CheckoutRequest(query=text))
    except InvalidProblem as problem:
        if problem.error_code != "empty-selection":
            raise
        return None
    tree: str = found.tree
    return tree


@given(queries)
@example("not action = walk and revision = 1")
@example("subject = 02 and facet.usage > 0 and tag = night")
@example("not (has facet.usage or has subject) and not folder = raw")
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=examples(30, soak=100))
def test_the_contents_that_are_selected_first_leave_out_no_entry(versioned: QueriedLab, text: str) -> None:
    found = selected_tree(versioned, text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(selecting, "MOST_IN_MEMORY", 0)
        patch.setattr(selecting, "SEARCHED_AT_ONCE", 3)
        assert selected_tree(versioned, text) == found
        patch.setattr(selecting, "_with_possible_content", lambda _tx, _project, _queries, entries: entries)
        assert selected_tree(versioned, text) == found


@pytest.mark.parametrize("in_memory", [0, 1000])
def test_only_possible_contents_are_compared(
    versioned: QueriedLab, monkeypatch: pytest.MonkeyPatch, in_memory: int
) -> None:
    monkeypatch.setattr(selecting, "MOST_IN_MEMORY", in_memory)
    revised = len(versioned.clips[1::4]) + 2  # of these and of two more clips, the database does not have all facts
    monkeypatch.setattr(selecting, "MOST_SEARCHED", revised)
    assert selected_tree(versioned, "frames = 1000 and not tag = nothing") is None
