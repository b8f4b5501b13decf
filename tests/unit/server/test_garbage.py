"""Garbage collection while other transactions run: nothing that has a reference is deleted."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import pytest
import sqlalchemy
from sqlalchemy import Table
from tests.support.database_fixtures import AdjustableClock
from tests.support.store_fixtures import Lab

from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.errors import ConflictProblem
from marey_server.store import blobs, documents, fsck, garbage, items
from marey_server.store.blobs import GRACE_US
from marey_server.store.tables import (
    attempt,
    attempt_blob,
    blob,
    coverage_stream,
    document,
    idempotency_key,
    job,
    staged_output,
    token,
)
from marey_server.store.transaction import Transaction

LONG_S = GRACE_US / 1e6 + 1
FILE = b"a file"
TREE = {"schema": "marey/document@1", "blob": digest_of(FILE)}


def rows(lab: Lab, table: Table[Any]) -> set[str]:
    return set(lab.read(lambda tx: tx.execute(sqlalchemy.select(table.c.digest)).scalars().all()))


def publish_study(tx: Transaction, name: str = "s") -> Item:
    return items.create_item(tx, "lab", Kind.CHARACTER, ItemCreate(name=name, parts={"character": TREE}))


def test_what_nothing_refers_to_goes_after_a_day_and_what_something_refers_to_stays(
    lab: Lab, clock: AdjustableClock
) -> None:
    rig = lab.add_skeleton()
    clip = lab.add_clip(rig)
    lab.write(blobs.put_blob, FILE)
    lab.write(documents.store_document, {"schema": "marey/document@1", "n": 1})
    before = rows(lab, document), rows(lab, blob)
    assert garbage.collect_garbage(lab.database) == garbage.Collected(0, 0, 0, 0, 0)
    clock.advance(LONG_S)
    collected = garbage.collect_garbage(lab.database)
    assert (collected.documents, collected.blobs) == (1, 1)
    assert len(before[0] - rows(lab, document)) == 1
    assert before[1] - rows(lab, blob) == {digest_of(FILE)}
    lab.write(items.delete_item, "lab", Kind.CLIP, clip.id, expected_rev=None)
    clock.advance(LONG_S)
    assert garbage.collect_garbage(lab.database).documents == 0
    assert lab.write(items.restore_item, "lab", Kind.CLIP, clip.id).id == clip.id
    assert list(fsck.check_store(lab.database)) == []


def test_arrays_go_with_the_document_that_held_them_unless_another_holds_them_too(
    lab: Lab, clock: AdjustableClock
) -> None:
    import numpy as np

    shared, own = np.arange(10.0), np.arange(20.0)
    kept = {"schema": "marey/document@1", "x": shared}
    lab.write(items.create_item, "lab", Kind.CHARACTER, ItemCreate(name="kept", parts={"character": kept}))
    lab.write(documents.store_document, {"schema": "marey/document@1", "x": shared, "y": own})
    clock.advance(LONG_S)
    collected = garbage.collect_garbage(lab.database)
    assert (collected.documents, collected.blobs) == (1, 1)
    assert list(fsck.check_store(lab.database)) == []


def test_what_a_running_attempt_has_staged_stays_for_as_long_as_it_runs(lab: Lab, clock: AdjustableClock) -> None:
    staged = lab.write(documents.store_document, {"schema": "marey/document@1", "n": 1})

    def stage(tx: Transaction) -> None:
        project_id = tx.execute(sqlalchemy.text("SELECT id FROM project")).scalar_one()
        given = {"kind": "x", "params": {}, "inputs": {}, "time_limit_s": 60, "memory_limit_mb": 64, "run_at_us": 0}
        given |= {"id": "job_1", "project_id": project_id, "created_us": 0, "state": "running"}
        tx.execute(sqlalchemy.insert(job).values(**given))
        given = {"job_id": "job_1", "fence": 1, "worker": "w", "token_hash": "h", "started_us": 0}
        tx.execute(sqlalchemy.insert(attempt).values(**given))
        draft = {"parts": {"character": staged}}
        given = {"job_id": "job_1", "fence": 1, "name": "o", "position": 0, "draft": draft}
        tx.execute(sqlalchemy.insert(staged_output).values(**given))
        blobs.put_blob(tx, FILE)
        blobs.keep_for_job(tx, "job_1", [digest_of(FILE)])

    lab.write(stage)
    clock.advance(7 * LONG_S)
    assert garbage.collect_garbage(lab.database) == garbage.Collected(0, 0, 0, 0, 0)
    lab.write(lambda tx: tx.execute(sqlalchemy.delete(staged_output)))
    assert garbage.collect_garbage(lab.database).documents == 1
    assert rows(lab, blob) == {digest_of(FILE)}


def test_a_job_cannot_keep_what_its_author_may_not_refer_to(lab: Lab) -> None:
    lab.write(blobs.put_blob, FILE, who=lab.reader)
    with pytest.raises(ConflictProblem):
        lab.write(blobs.keep_for_job, "job_1", [digest_of(FILE)])


@pytest.mark.parametrize("taker", ["publish", "put"])
@pytest.mark.parametrize("first", ["taker", "collector"])
def test_whoever_takes_something_up_while_it_is_collected_gets_it_or_is_told(
    lab: Lab, clock: AdjustableClock, open_database: Callable[..., Any], taker: str, first: str
) -> None:
    """The first of two transactions waits between its write and its commit; the second one starts meanwhile."""
    lab.write(blobs.put_blob, FILE)
    lab.write(documents.store_document, TREE)
    clock.advance(LONG_S)
    acted, outcome = threading.Event(), []

    def take(tx: Transaction) -> Any:
        return publish_study(tx) if taker == "publish" else blobs.put_blob(tx, FILE)

    def collect(tx: Transaction) -> int:
        garbage.delete_documents(tx, sorted(rows_of_document))
        return garbage.delete_blobs(tx, [digest_of(FILE)])

    rows_of_document = rows(lab, document)
    leads, follows = (take, collect) if first == "taker" else (collect, take)
    other = open_database()

    def lead(tx: Transaction) -> Any:
        answer = leads(tx)
        acted.set()
        thread.join(0.3)
        return answer

    def follow() -> None:
        acted.wait(10)
        try:
            outcome.append(other.write(lab.owner if follows is take else SYSTEM, follows))
        except ConflictProblem as error:
            outcome.append(error.error_code)

    thread = threading.Thread(target=follow)
    thread.start()
    lab.write(lead, who=lab.owner if leads is take else SYSTEM)
    thread.join(30)
    assert list(fsck.check_store(lab.database)) == []
    there = digest_of(FILE) in rows(lab, blob)
    if taker == "put" or first == "taker":
        assert there
        assert lab.read(blobs.read_blob, digest_of(FILE)) == FILE
    else:
        assert outcome == ["missing-blobs"]
        assert not there


def test_nothing_is_lost_while_everybody_is_busy(lab: Lab, clock: AdjustableClock) -> None:
    """Publications, uploads and garbage collection run at once, without a grace period; all references stay valid."""
    errors = []

    def publisher(number: int) -> None:
        for turn in range(6):
            try:
                lab.write(blobs.put_blob, FILE)
                lab.write(publish_study, f"{number}-{turn}")
            except ConflictProblem as error:
                if error.error_code != "missing-blobs":
                    errors.append(error)

    def collector() -> None:
        for _ in range(10):
            garbage.collect_garbage(lab.database, grace_us=0)

    threads = [threading.Thread(target=publisher, args=(number,)) for number in range(3)]
    threads += [threading.Thread(target=collector) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert errors == []
    assert list(fsck.check_store(lab.database)) == []


@pytest.mark.parametrize("table", [idempotency_key, token, attempt_blob, coverage_stream], ids=lambda one: one.name)
def test_expired_rows_go_a_few_at_a_time_and_others_stay(
    lab: Lab, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch, table: Table[Any]
) -> None:
    monkeypatch.setattr(garbage, "BATCH", 2)

    def add_rows(tx: Transaction, names: Sequence[str]) -> None:
        for name in names:
            hour_us = tx.now_us + 3600 * 10**6
            project_id = tx.execute(sqlalchemy.text("SELECT id FROM project")).scalar_one()
            rows_of: dict[str, dict[str, Any]] = {
                "idempotency_key": {"principal": "user", "key": name, "fingerprint": "f"},
                "token": {"id": name, "user_id": lab.owner.user_id, "name": name, "prefix": name, "secret_hash": "h",
                          "scopes": [], "expires_us": hour_us},
                "attempt_blob": {"digest": digest_of(FILE), "job_id": name, "fence": 1},
                "coverage_stream": {"id": name, "project_id": project_id, "settings": {}, "state": b"",
                                    "updated_us": tx.now_us},
            }  # fmt: skip
            tx.execute(sqlalchemy.insert(table).values(**rows_of[table.name], created_us=tx.now_us))

    key = list(table.primary_key.columns)[-1 if table is idempotency_key else 1 if table is attempt_blob else 0]
    lab.write(blobs.put_blob, FILE)
    lab.write(add_rows, [f"old{number}" for number in range(5)])
    clock.advance(100 * 86400)
    if table is not attempt_blob:
        lab.write(add_rows, ["new"])
    counts: list[int] = []
    delete_rows = garbage._delete_rows

    def delete_and_count(*args: Any) -> int:
        counts.append(delete_rows(*args))
        return counts[-1]

    monkeypatch.setattr(garbage, "_delete_rows", delete_and_count)
    garbage.collect_garbage(lab.database, grace_us=200 * 86400 * 10**6)
    left = lab.database.read(SYSTEM, lambda tx: set(tx.execute(sqlalchemy.select(key)).scalars()))
    assert not {name for name in left if name.startswith("old")}
    assert ("new" in left) == (table is not attempt_blob)
    assert sum(counts) == 5
    assert max(counts) == 2


def test_expired_keys_go(lab: Lab, clock: AdjustableClock) -> None:
    from marey_server.store import idempotency

    lab.write(idempotency.begin, "k", "f")
    clock.advance(idempotency.LIFETIME_US / 1e6 + 1)
    assert garbage.collect_garbage(lab.database).keys == 1
