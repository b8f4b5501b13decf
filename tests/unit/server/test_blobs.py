"""Access to the bytes of blobs, and rights to refer to blobs."""

import tracemalloc
from dataclasses import replace
from typing import Any

import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.store_fixtures import Lab

from marey_schemas.access import ProjectCreate
from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.sizes import MIB
from marey_server.access.principal import Principal
from marey_server.errors import ConflictProblem, ForbiddenProblem, NotFoundProblem, UnauthenticatedProblem
from marey_server.store import blobs, items, projects
from marey_server.store.blob_backings import SPOOLED_BYTES, Spool
from marey_server.store.blobs import GRACE_US

pytestmark = pytest.mark.every_database

FILE = b"HIERARCHY ROOT hips"
DIGEST = digest_of(FILE)


def study(lab: Lab, who: Principal, name: str = "s", **body: Any) -> Item:
    request = ItemCreate(name=name, parts={"character": {"schema": "marey/document@1", **body}})
    return lab.write(items.create_item, "lab", Kind.CHARACTER, request, who=who)


def readers(lab: Lab) -> set[Any]:
    everybody = (lab.owner, lab.contributor, lab.reader, lab.stranger, lab.anonymous)
    return {who.user_name for who in everybody if lab.read(blobs.readable, [DIGEST], who=who)}


def test_who_sent_the_bytes_may_read_them_and_nobody_else(lab: Lab) -> None:
    lab.write(blobs.put_blob, FILE, who=lab.contributor)
    assert readers(lab) == {lab.contributor.user_name}
    with pytest.raises(NotFoundProblem):
        lab.read(blobs.read_range, DIGEST, 0, 5, who=lab.owner)
    assert lab.read(blobs.read_range, DIGEST, 0, 5, who=lab.contributor) == b"HIERA"


def test_a_document_shares_what_it_names_with_the_readers_of_its_project(lab: Lab) -> None:
    lab.write(blobs.put_blob, FILE, who=lab.contributor)
    made = study(lab, lab.contributor, figures=[{"blob": DIGEST}])
    everybody_inside = {lab.owner.user_name, lab.contributor.user_name, lab.reader.user_name}
    assert readers(lab) == everybody_inside
    lab.make_public()
    assert readers(lab) == everybody_inside | {lab.stranger.user_name, None}
    lab.write(items.delete_item, "lab", Kind.CHARACTER, made.id, expected_rev=None)
    assert readers(lab) == {lab.contributor.user_name}


def test_nobody_gets_bytes_by_naming_their_digest(lab: Lab) -> None:
    lab.write(blobs.put_blob, FILE, who=lab.contributor)
    bodies: tuple[dict[str, Any], ...] = ({"figures": [{"blob": DIGEST}]}, {"blob": DIGEST})
    for body in bodies:
        with pytest.raises(ConflictProblem) as refused:
            study(lab, lab.owner, **body)
        assert refused.value.context == {"missing": [DIGEST]}
        assert refused.value.errors[0].pointer.endswith("/blob")
    rig = lab.add_skeleton()
    with pytest.raises(ConflictProblem):
        lab.add_clip(rig, info={"source": {"file": DIGEST}})
    assert readers(lab) == {lab.contributor.user_name}


def test_naming_a_digest_in_words_shares_nothing(lab: Lab) -> None:
    lab.write(blobs.put_blob, FILE, who=lab.contributor)
    study(lab, lab.owner, "before", image=DIGEST)
    study(lab, lab.contributor, "after", image=DIGEST)
    assert readers(lab) == {lab.contributor.user_name}


def test_a_stored_document_gives_no_access_to_who_stores_it_again_without_the_bytes(lab: Lab) -> None:
    lab.write(blobs.put_blob, FILE, who=lab.contributor)
    made = study(lab, lab.contributor, "mine", blob=DIGEST)
    lab.write(items.delete_item, "lab", Kind.CHARACTER, made.id, expected_rev=None)
    with pytest.raises(ConflictProblem):
        study(lab, lab.owner, "theirs", blob=DIGEST)


def test_missing_answers_by_the_same_rule_in_the_order_asked(lab: Lab) -> None:
    lab.write(blobs.put_blob, FILE, who=lab.contributor)
    other = digest_of(b"other")
    asked = [other, DIGEST, other, "sha256:nonsense"]
    assert lab.read(blobs.missing, asked, who=lab.contributor) == [other, "sha256:nonsense"]
    assert lab.read(blobs.missing, asked, who=lab.owner) == [other, DIGEST, "sha256:nonsense"]
    assert lab.read(blobs.missing, asked, who=lab.anonymous) == [other, DIGEST, "sha256:nonsense"]


def test_thousands_of_digests_are_asked_for_at_once(lab: Lab) -> None:
    digests = [digest_of(str(number).encode()) for number in range(10_000)]
    lab.write(blobs.put_blob, b"9999")
    assert lab.read(blobs.missing, digests) == digests[:-1]


def test_what_may_soon_be_collected_must_be_sent_again(lab: Lab, clock: AdjustableClock) -> None:
    lab.write(blobs.put_blob, FILE)
    clock.advance(GRACE_US / 1e6 * 0.6)
    assert lab.read(blobs.missing, [DIGEST]) == [DIGEST]
    lab.write(blobs.put_blob, FILE)
    assert lab.read(blobs.missing, [DIGEST]) == []
    study(lab, lab.owner, blob=DIGEST)
    clock.advance(GRACE_US / 1e6 * 10)
    assert lab.read(blobs.missing, [DIGEST]) == []


def test_sending_bytes_needs_a_credential_that_writes(lab: Lab) -> None:
    with pytest.raises(UnauthenticatedProblem):
        lab.write(blobs.put_blob, FILE, who=lab.anonymous)
    with pytest.raises(ForbiddenProblem):
        lab.write(blobs.put_blob, FILE, who=Principal("user", lab.owner.user_id, "o", scopes=("read", "jobs")))
    bound = Principal("user", lab.owner.user_id, "o", scopes=("write!project=lab",))
    assert lab.write(blobs.put_blob, FILE, who=bound) == DIGEST


def test_what_an_attempt_sends_belongs_to_the_attempt(lab: Lab) -> None:
    project_id = lab.read(projects.read_project, "lab").id
    attempt = Principal("attempt", scopes=("read",), job_id="job_1", fence=1, project_id=project_id)
    lab.write(blobs.put_blob, FILE, who=attempt)
    assert readers(lab) == set()
    assert lab.read(blobs.readable, [DIGEST], who=attempt) == {DIGEST}
    for other in (replace(attempt, fence=2), replace(attempt, job_id="job_2")):
        assert lab.read(blobs.readable, [DIGEST], who=other) == set()


def test_bytes_sent_for_a_project_are_used_by_tokens_that_reach_it(lab: Lab) -> None:
    lab.write(projects.create_project, ProjectCreate(name="other"))
    sent = {"lab": b"for the lab", "other": b"for the other", "": b"for both"}
    for name, data in sent.items():
        place = lab.read(projects.read_project, name).id if name else None
        lab.write(blobs.put_blob, data, project_id=place)

    def seen(*scopes: str) -> set[str]:
        who = replace(lab.owner, scopes=scopes)
        found = lab.read(blobs.readable, [digest_of(data) for data in sent.values()], who=who)
        return {name for name, data in sent.items() if digest_of(data) in found}

    assert seen("read") == seen("read", "write!project=lab") == {"lab", "other", ""}
    assert seen("read!project=lab") == seen("write!project=lab", "work", "admin") == {"lab"}
    assert seen("read!project=lab", "jobs!project=other") == {"lab", "other"}
    assert seen("read!project=lab", "write") == {"lab", ""}
    assert seen("work", "admin") == seen("read!project=nowhere") == set()


def test_a_spool_keeps_few_bytes_in_memory() -> None:
    tracemalloc.start()
    try:
        with Spool() as spool:
            spool.write(bytes(MIB))
            assert tracemalloc.get_traced_memory()[0] < 2 * SPOOLED_BYTES
            assert b"".join(spool.chunks()) == bytes(MIB)
    finally:
        tracemalloc.stop()
