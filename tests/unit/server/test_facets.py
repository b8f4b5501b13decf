"""Facets: numbers that jobs publish about their inputs, and that queries compare."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import select
from tests.support.queue_desk import Desk, document, output
from tests.support.store_fixtures import ALL_RIGHTS, WRITE, requiring

from marey_schemas.access import ProjectCreate
from marey_schemas.items import Item, ItemRevert
from marey_schemas.kinds import Kind
from marey_schemas.purges import PurgeRequest
from marey_schemas.queue.facets import ItemFacets, require_facet_names
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.queue.worker_protocol import Lease
from marey_server.access.principal import SYSTEM
from marey_server.errors import InvalidProblem, LeaseLostProblem
from marey_server.store import fsck, items, projects, purging
from marey_server.store.items.drafts import Draft
from marey_server.store.items.facets import publish_facets
from marey_server.store.items.publishing import publish
from marey_server.store.jobs import result_cache
from marey_server.store.jobs.reaper import share_waiting
from marey_server.store.tables import item_facet, staged_output


def read(desk: Desk, function: Any, *args: Any, **kwargs: Any) -> Any:
    return desk.database.read(desk.user, requiring(WRITE, function), *args, **kwargs)


def write(desk: Desk, function: Any, *args: Any, **kwargs: Any) -> Any:
    return desk.database.write(desk.user, requiring(WRITE, function), *args, **kwargs)


def study(desk: Desk, item_id: str) -> Item:
    found: Item = read(desk, items.read_item, "lab", Kind.CHARACTER, item_id)
    return found


def selected(desk: Desk, query: str, project: str = "lab") -> list[str]:
    """Return the names of the studies that a query selects."""
    filters = items.ItemFilters(query=query)
    return [one.name for one in read(desk, items.list_items, project, Kind.CHARACTER, filters, sort="name").items]


def submit(desk: Desk, things: list[str], number: int = 0, **fields: Any) -> str:
    wanted = [{"item": one} for one in things]
    return desk.submit("measure", inputs={"things": wanted}, params={"number": number}, into="results", **fields)


def measured(item: str, usage: float, revision: int = 1, **more: float) -> ItemFacets:
    return ItemFacets(item=item, revision=revision, values={"usage": usage, **more})


def measure(desk: Desk, things: list[str], *usages: float, number: int = 0) -> str:
    """Run a job that publishes the usage of each thing; return its id."""
    job = submit(desk, things, number)
    lease = desk.claim()
    desk.stage_outputs(lease, output(f"m{number}"), facets=tuple(map(measured, things, usages)))
    desk.complete(lease)
    return job


def test_a_revert_restores_the_facets_of_the_earlier_content(desk: Desk) -> None:
    (thing,) = desk.things(1)
    measure(desk, [thing], 0.5)
    changed = document(content="other")
    write(desk, items.put_part, "lab", Kind.CHARACTER, thing, "character", changed, expected_rev=None)
    assert study(desk, thing).facets == {}
    back = write(desk, items.revert_item, "lab", Kind.CHARACTER, thing, ItemRevert(revision=1), expected_rev=None)
    assert (back.revision, back.facets) == (3, {"usage": 0.5})


def test_a_job_publishes_facets_of_its_inputs_when_it_completes(desk: Desk) -> None:
    things = desk.things(3)
    submit(desk, things)
    lease = desk.claim()
    facets = (measured(things[0], 0.25), measured(things[1], 0.5, used_frames=1.0))
    desk.stage_outputs(lease, output("m"), facets=facets)
    assert selected(desk, "has facet.usage") == []
    desk.complete(lease)
    assert study(desk, things[1]).facets == {"usage": 0.5, "used_frames": 1.0}
    assert [one.facets for one in read(desk, items.list_items, "lab", Kind.CHARACTER, sort="name").items[1:]] == [
        {"usage": 0.25}, {"usage": 0.5, "used_frames": 1.0}, {},
    ]  # fmt: skip
    assert selected(desk, "facet.usage > 0.25") == ["thing1"]
    assert selected(desk, "facet.usage in (0.25, 0.5) and not has facet.used_frames") == ["thing0"]
    assert selected(desk, "folder = raw and not facet.usage > 0.25") == ["thing0", "thing2"]
    explained = read(
        desk, items.explain_query, "lab", Kind.CHARACTER, items.ItemFilters(), "facet.usage >= 0.25 and name = thing1"
    )
    assert (explained.selected, [(one.hides, one.alone) for one in explained.conditions]) == (1, [(2, 0), (3, 1)])


def test_a_facet_belongs_to_the_revision_that_was_measured(desk: Desk) -> None:
    (thing,) = desk.things(1)
    submit(desk, [thing])
    lease = desk.claim()
    desk.publish(Draft("thing0", Kind.CHARACTER, "thing0", {"character": document(number=10)}, "raw"))
    assert study(desk, thing).revision == 2
    desk.stage_outputs(lease, output("m"), facets=(measured(thing, 0.5),))
    desk.complete(lease)
    assert study(desk, thing).facets == {}
    assert selected(desk, "has facet.usage") == []
    submit(desk, [thing], 1)
    lease = desk.claim()
    desk.stage_outputs(lease, output("m"), facets=(measured(thing, 0.75, revision=2),))
    desk.complete(lease)
    assert study(desk, thing).facets == {"usage": 0.75}


def test_the_newest_job_determines_a_facet_also_if_it_shares_the_result_of_another(desk: Desk) -> None:
    things = desk.things(2)
    first = measure(desk, things, 0.1, 0.2, number=1)
    measure(desk, things[:1], 0.9, number=2)
    assert [study(desk, one).facets["usage"] for one in things] == [0.9, 0.2]
    again = submit(desk, things, number=1)
    assert (desk.state(again), desk.job(again).cached_from) == ("succeeded", first)
    assert [study(desk, one).facets["usage"] for one in things] == [0.1, 0.2]


def test_a_shared_result_states_facets_of_the_revisions_of_its_own_job(desk: Desk) -> None:
    things = desk.things(1)
    first = measure(desk, things, 0.5)
    for number in (7, 0):  # back to the content that was measured, as another revision
        desk.publish(Draft("thing0", Kind.CHARACTER, "thing0", {"character": document(number=number)}, "raw"))
    assert (study(desk, things[0]).revision, study(desk, things[0]).facets) == (3, {})
    assert desk.job(submit(desk, things)).cached_from == first
    assert study(desk, things[0]).facets == {"usage": 0.5}


def test_many_facets_are_shared_in_several_transactions(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(result_cache, "MOST_SHARED_OUTPUTS", 4)
    monkeypatch.setattr(result_cache, "MEASURED_PER_OUTPUT", 1)
    things = desk.things(3)
    first = measure(desk, things, 0.1, 0.2, 0.3)
    wanted = {"things": [{"item": one} for one in things]}
    same = JobCreate(kind="measure", inputs=wanted, params={"number": 0}, into="results")
    again = desk.submit_many(same, same, same)
    assert [desk.state(one) for one in again] == ["succeeded", "waiting", "waiting"]
    assert desk.database.write(SYSTEM, share_waiting) == 1
    assert desk.database.write(SYSTEM, share_waiting) == 1
    assert {desk.job(one).cached_from for one in again} == {first}
    assert [desk.state(one) for one in again] == ["succeeded"] * 3


@pytest.mark.parametrize(
    ("facets", "code"),
    [
        (lambda given, other: [measured(other, 1.0)], "no-facet-input"),
        (lambda given, other: [measured(given, 1.0, revision=2)], "no-facet-input"),
        (lambda given, other: [measured(given, 1.0), measured(given, 2.0)], "no-facet-input"),
        (lambda given, other: [measured(given, 1.0, beauty=1.0)], "no-facet"),
    ],
    ids=["no input", "other revision", "twice", "not declared"],
)
def test_an_attempt_states_only_declared_facets_of_its_inputs(desk: Desk, facets: Any, code: str) -> None:
    given, other = desk.things(2)
    submit(desk, [given])
    lease = desk.claim()
    with pytest.raises(InvalidProblem) as refused:
        desk.stage_outputs(lease, output("m"), facets=tuple(facets(given, other)))
    assert refused.value.error_code == code
    desk.complete(lease)
    assert selected(desk, "has facet.usage") == []


def test_a_job_with_an_evaluation_states_facets_of_its_clips(desk: Desk) -> None:
    (own, unnamed, revised), far = desk.things(3), "study_far"
    desk.publish(Draft("d", Kind.CHARACTER, "thing2", {"character": document(number=9)}, "raw"))
    named = [{"item": own, "revision": 1}, {"item": revised, "revision": 2}, {"item": revised, "revision": 3}]
    odd: list[Any] = [{"item": far, "revision": 1}, {"item": [own]}, None]
    evaluation = {
        "schema": "marey/evaluation@1", "verdict": "v", "headline": {}, "clip_set": {"clips": [*named, *odd]},
    }  # fmt: skip
    (made,) = desk.publish(Draft("e", Kind.EVALUATION, "e", {"evaluation": evaluation}))
    job = desk.submit("suggest", inputs={"evaluation": {"item": made.item}}, params={})
    lease = desk.claim()

    def state(item: str, revision: int) -> None:
        facets = (ItemFacets(item=item, revision=revision, values={"removal_harm": -0.5}),)
        desk.stage_outputs(lease, facets=facets)

    for item, revision in ((unnamed, 1), (own, 2), (revised, 1), (revised, 3), (far, 1)):
        with pytest.raises(InvalidProblem) as refused:
            state(item, revision)
        assert refused.value.error_code == "no-facet-input"
    state(own, 1)
    state(revised, 2)  # replaces the facets of the earlier request
    desk.complete(lease)
    assert (desk.state(job), desk.outputs(job)) == ("succeeded", [])
    assert selected(desk, "facet.removal_harm < 0") == ["thing2"]


def test_an_attempt_that_fails_or_lost_its_lease_publishes_no_facets(desk: Desk) -> None:
    (thing,) = desk.things(1)
    submit(desk, [thing])

    def staged() -> Lease:
        lease = desk.claim()
        desk.stage_outputs(lease, output("m"), facets=(measured(thing, 0.5),))
        return lease

    desk.fail(staged())
    desk.clock.advance(3600)
    late = staged()
    desk.clock.advance(3600)
    desk.reap()
    with pytest.raises(LeaseLostProblem):
        desk.complete(late)
    assert selected(desk, "has facet.usage") == []


def test_a_purge_deletes_facets_and_no_job_adds_them_afterwards(desk: Desk) -> None:
    thing, kept = desk.things(2)
    measure(desk, [thing, kept], 0.5, 0.6)
    write(desk, items.delete_item, "lab", Kind.CHARACTER, thing, expected_rev=None)
    wanted = PurgeRequest(item=thing)
    write(desk, purging.record_purge, "lab", wanted, read(desk, purging.prepare_purge, "lab", wanted))
    project_id = read(desk, projects.require, "lab").id
    write(desk, publish_facets, project_id, [[thing, 1, {"usage": 0.9}], [kept, 1, {"usage": 0.7}]])
    rows = read(desk, lambda tx: tx.execute(select(item_facet.c.item_id, item_facet.c.value)).all())
    assert [tuple(row) for row in rows] == [(kept, 0.7)]
    drafts = read(desk, lambda tx: tx.execute(select(staged_output.c.draft)).scalars().all())
    assert [draft for draft in drafts if draft.get("facets")] == []
    assert list(fsck.check_store(desk.database)) == []
    leftover = {"item_id": thing, "number": 1, "name": "usage", "value": 1.0}
    write(desk, lambda tx: tx.execute(item_facet.insert().values(**leftover)))
    assert [one.code for one in fsck.check_store(desk.database)] == ["purge-incomplete"]


def test_a_query_shows_no_facets_of_another_project(desk: Desk) -> None:
    things = desk.things(1)
    desk.database.write(desk.user, projects.create_project, ProjectCreate(name="other"))

    def add(tx: Any) -> None:
        other = projects.require(tx, "other")
        draft = Draft("far", Kind.CHARACTER, "far", {"character": document(number=1)})
        (made,) = publish(tx, other, [draft], author_id=None, rights=ALL_RIGHTS)
        publish_facets(tx, other.id, [[made.item, 1, {"usage": 1.0}], [things[0], 1, {"usage": 1.0}]])

    desk.database.write(SYSTEM, add)
    assert (selected(desk, "has facet.usage"), selected(desk, "has facet.usage", "other")) == ([], ["far"])


@pytest.mark.parametrize("names", [["Usage"], ["a b"], [""], ["x" * 65], [f"f{number}" for number in range(17)]])
def test_a_job_kind_declares_few_facets_with_plain_names(names: list[str]) -> None:
    with pytest.raises(ValueError, match="declare at most 16 facets"):
        require_facet_names("measure", names)
