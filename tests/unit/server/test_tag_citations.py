"""Deletion of tags: a tag stays while a job, an item that a job made, or an open proposal cites its version."""

from __future__ import annotations

import pytest
from sqlalchemy import select
from tests.support.committing_desk import CommittingDesk
from tests.support.queue_desk import document, output

from marey_schemas.datasets.commits import PutEntry
from marey_schemas.datasets.naming import RefCreate, RefKind
from marey_schemas.datasets.proposals import ProposalCreate
from marey_schemas.kinds import Kind
from marey_schemas.purges import PurgeRequest
from marey_server.errors import ConflictProblem
from marey_server.store import datasets, items, purging
from marey_server.store.datasets import proposals
from marey_server.store.items.drafts import Draft
from marey_server.store.tables import dataset_ref
from marey_server.store.transaction import Transaction


def add_version(gaits: CommittingDesk, name: str = "walk") -> None:
    draft = Draft("d", Kind.CHARACTER, name, {"character": document(name=name)}, "raw")
    gaits.change(PutEntry(path=name, item=gaits.desk.publish(draft)[0].item))


def tag(gaits: CommittingDesk, name: str, kind: RefKind = RefKind.TAG) -> None:
    gaits.write(datasets.create_ref, "lab", "gaits", RefCreate(name=name, kind=kind))


def delete(gaits: CommittingDesk, ref: str) -> None:
    """Delete a branch or a tag, as the server does."""
    citing = gaits.read(purging.find_citations, "lab", "gaits", ref)
    gaits.write(purging.delete_uncited_ref, "lab", "gaits", ref, citing, expected_rev=None)


def refs(gaits: CommittingDesk) -> set[str]:
    def names(tx: Transaction) -> set[str]:
        return set(tx.execute(select(dataset_ref.c.name)).scalars())

    found: set[str] = gaits.read(names)
    return found


def test_a_tag_stays_while_a_job_or_its_result_cites_the_version(gaits: CommittingDesk) -> None:
    add_version(gaits)
    for name in ("v1", "trial"):
        tag(gaits, name, RefKind.BRANCH if name == "trial" else RefKind.TAG)
    given = {"things": ({"dataset": "gaits", "version": "v1"},)}
    job = gaits.desk.submit("square", inputs=given, into="made", cache="off")
    with pytest.raises(ConflictProblem, match=f"the queued job {job}") as caught:
        delete(gaits, "v1")
    assert caught.value.error_code == "tag-cited"
    lease = gaits.desk.claim(job=job)
    gaits.desk.stage_outputs(lease, output("model"))
    gaits.desk.complete(lease)
    with pytest.raises(ConflictProblem, match="made/model"):
        delete(gaits, "v1")
    delete(gaits, "trial")  # a branch at the same version
    assert refs(gaits) == {"main", "v1"}
    (made,) = gaits.read(items.list_items, "lab", Kind.CHARACTER, items.ItemFilters(collection="made")).items
    gaits.write(items.delete_item, "lab", Kind.CHARACTER, made.id, expected_rev=None)
    request = PurgeRequest(item=made.id)
    gaits.write(purging.record_purge, "lab", request, gaits.read(purging.prepare_purge, "lab", request))
    delete(gaits, "v1")
    assert refs(gaits) == {"main"}


def test_a_cited_tag_may_be_replaced_by_another_tag_of_its_version(gaits: CommittingDesk) -> None:
    add_version(gaits)
    tag(gaits, "v1")
    gaits.desk.submit("square", inputs={"things": ({"dataset": "gaits", "version": "main"},)})
    tag(gaits, "v1.0")
    delete(gaits, "v1")
    with pytest.raises(ConflictProblem, match=r"another tag of the same version first"):
        delete(gaits, "v1.0")
    assert refs(gaits) == {"main", "v1.0"}


def test_a_tag_without_citations_is_deleted(gaits: CommittingDesk) -> None:
    add_version(gaits)
    tag(gaits, "v1")
    add_version(gaits, "turn")
    gaits.desk.submit("square", inputs={"things": ({"dataset": "gaits", "version": "main"},)})
    delete(gaits, "v1")
    assert refs(gaits) == {"main"}


def test_a_tag_that_an_open_proposal_names_stays(gaits: CommittingDesk) -> None:
    add_version(gaits)
    tag(gaits, "old", RefKind.BRANCH)
    add_version(gaits, "turn")
    tag(gaits, "v2")
    request = ProposalCreate(title="Second version", source="v2", target="old")
    gaits.write(proposals.open_proposal, "lab", "gaits", request)
    with pytest.raises(ConflictProblem, match="open proposal 1 has 'v2' as source or target"):
        delete(gaits, "v2")
    gaits.write(proposals.close_proposal, "lab", "gaits", 1)
    delete(gaits, "v2")
    assert refs(gaits) == {"main", "old"}
