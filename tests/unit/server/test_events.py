"""The feed of events, and idempotency keys, with which requests can be repeated safely."""

import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.present import present
from tests.support.store_fixtures import Lab, declared

from marey_schemas.access import ProjectChange, ProjectCreate
from marey_schemas.kinds import Kind
from marey_server.access.principal import Principal
from marey_server.errors import (
    ConflictProblem,
    ForbiddenProblem,
    InvalidProblem,
    NotFoundProblem,
    UnauthenticatedProblem,
)
from marey_server.store import events, idempotency, items, projects
from marey_server.store.idempotency import LIFETIME_US, StoredAnswer
from marey_server.store.transaction import Transaction


def test_what_happens_is_told_in_order_with_who_did_it(lab: Lab) -> None:
    rig = lab.add_skeleton()
    clip = lab.add_clip(rig, who=lab.contributor)
    lab.write(items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=None)
    told = [(event.kind, event.subject, event.actor) for event in lab.events() if event.kind.startswith("item.")]
    assert told == [
        ("item.created", rig.id, lab.owner.user_name),
        ("item.created", clip.id, lab.contributor.user_name),
        ("item.deleted", clip.id, lab.owner.user_name),
    ]
    assert {event.project for event in lab.events()} == {"lab"}


def test_the_feed_goes_on_after_the_last_event_received(lab: Lab) -> None:
    for number in range(5):
        lab.add_skeleton(f"rig {number}", bone_m=number + 1)
    whole = [event.seq for event in lab.events()]
    seen, after = [], 0
    while page := lab.events(after, limit=2):
        seen += [event.seq for event in page]
        after = page[-1].seq
    assert seen == whole
    assert lab.events(after=whole[-1]) == []


def test_a_page_is_bounded_by_the_bytes_of_its_events(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    """Texts of two-byte characters show that bytes are counted, and the longest body is longer than a page."""
    monkeypatch.setattr(events, "PAGE_BYTES", 10_000)
    sizes = [100, 4_000, 3_000, 30_000, 10, 2_000, 9_000, 1, 1]
    before = lab.events()[-1].seq
    lab.write(lambda tx: [tx.emit("project.changed", "s", project_id=project_id(tx), note="é" * n) for n in sizes])
    lab.write(events.number_events)
    pages, after, complete = [], before, False
    while not complete:
        page, complete = lab.read(events.list_events, "lab", after=after, limit=4)
        pages.append([len(one.body["note"]) for one in page])
        after = page[-1].seq
    assert [size for page in pages for size in page] == sizes
    whole = [sum(2 * size for size in page) <= 10_000 or len(page) == 1 for page in pages]
    assert all(whole), pages
    assert len(pages) < len(sizes)


def project_id(tx: Transaction) -> str:
    return projects.require(tx, "lab").id


def test_a_page_is_complete_if_no_event_remains(lab: Lab) -> None:
    whole = lab.events()
    assert lab.read(events.list_events, "lab", limit=len(whole) + 1).complete
    assert lab.read(events.list_events, "lab", limit=len(whole)).complete
    assert not lab.read(events.list_events, "lab", limit=len(whole) - 1).complete
    assert lab.read(events.list_events, "lab", after=whole[-1].seq) == ([], True)


def test_what_failed_did_not_happen(lab: Lab) -> None:
    before = lab.events()
    with pytest.raises(ConflictProblem):
        lab.write(projects.create_project, ProjectCreate(name="lab"))
    assert lab.events() == before


def test_events_are_for_members_and_administrators(lab: Lab) -> None:
    required = declared("GET", "/projects/{project}/events")
    lab.make_public()
    with pytest.raises(UnauthenticatedProblem):
        lab.read(events.list_events, "lab", who=lab.anonymous, required=required)
    with pytest.raises(ForbiddenProblem):
        lab.read(events.list_events, "lab", who=lab.stranger, required=required)
    lab.write(events.number_events)
    assert lab.read(events.list_events, "lab", who=lab.reader, required=required).items
    with pytest.raises(ForbiddenProblem):
        lab.read(events.list_events, who=lab.owner)
    chief = lab.sign_up("chief", administrator=True)
    kinds = {event.kind for event in lab.read(events.list_events, who=chief).items}
    assert {"user.created", "project.created", "project.changed"} <= kinds


# -- idempotency ------------------------------------------------------------------------------------------------------


def once(tx: Transaction, key: str = "k", fingerprint: str = "f", *, fail: bool = False) -> StoredAnswer | None:
    """Append a letter to the project's title, but only once for each idempotency key.

    Returns the stored answer of an earlier request with the key, or None.
    """
    stored = idempotency.begin(tx, key, fingerprint)
    if stored is not None:
        return stored
    before = projects.read_project(tx, "lab").title or ""
    projects.change_project(tx, "lab", ProjectChange(title=before + "I"), expected_rev=None)
    if fail:
        raise InvalidProblem("no")
    idempotency.finish(tx, key, 201, {"Location": "/x"}, b"body")
    return None


def count(lab: Lab) -> int:
    return len(lab.read(projects.read_project, "lab").title or "")


def test_a_request_sent_again_is_done_once_and_answered_the_same(lab: Lab) -> None:
    assert lab.write(once) is None
    assert lab.write(once) == StoredAnswer(201, {"Location": "/x"}, b"body")
    assert count(lab) == 1


def test_a_request_sent_by_many_connections_at_once_is_done_once(lab: Lab) -> None:
    futures = [lab.database.submit_write(lab.owner, once) for _ in range(8)]
    answers = [future.result(60) for future in futures]
    assert answers.count(None) == 1
    assert count(lab) == 1


def test_a_key_stands_for_one_request_of_one_caller(lab: Lab) -> None:
    lab.write(once)
    with pytest.raises(InvalidProblem) as refused:
        lab.write(once, fingerprint="other")
    assert refused.value.error_code == "idempotency-key-reused"
    admin = Principal("user", present(lab.owner.user_id) + "x", "o", administrator=True, scopes=lab.owner.scopes)
    assert lab.write(once, who=admin) is None
    assert count(lab) == 2


def test_a_request_that_failed_may_be_sent_again(lab: Lab) -> None:
    with pytest.raises(InvalidProblem):
        lab.write(once, fail=True)
    assert lab.write(once) is None
    assert count(lab) == 1


def test_a_key_expires(lab: Lab, clock: AdjustableClock) -> None:
    lab.write(once)
    clock.advance(LIFETIME_US / 1e6 + 1)
    assert lab.write(once, fingerprint="other") is None
    assert count(lab) == 2


def test_hidden_projects_have_no_feed(lab: Lab) -> None:
    with pytest.raises(NotFoundProblem):
        lab.read(events.list_events, "lab", who=lab.stranger)
