"""Processes that are killed while they write: the write is stored whole or not at all, and can be repeated."""

import signal
from pathlib import Path

import pytest
from tests.support.present import present
from tests.support.store_fixtures import Lab
from tests.support.store_writer import ALL_US, FILES, LARGE_FILES, StoreWriter

from marey_schemas.encoding.digests import digest_of
from marey_schemas.kinds import Kind
from marey_server.access.principal import Principal
from marey_server.store import blobs, fsck, garbage, items

in_rows_and_in_files = pytest.mark.parametrize("backing", ["rows", "files"])


@pytest.fixture
def backing() -> str:
    return "rows"


@pytest.fixture
def folder(backing: str, tmp_path: Path) -> str:
    return "" if backing == "rows" else str(tmp_path / "blobs")


@pytest.fixture
def writer(lab: Lab, database_url: str, folder: str) -> StoreWriter:
    from marey_server.store.blob_backings import DirectoryBlobs

    if folder:
        lab.database.blobs = DirectoryBlobs(Path(folder))
    return StoreWriter(database_url, present(lab.owner.user_id), present(lab.owner.user_name), folder)


def stored(lab: Lab) -> list[bool]:
    there = lab.read(blobs.readable, [digest_of(data) for data in FILES])
    return [digest_of(data) in there for data in FILES]


def published(lab: Lab) -> list[str]:
    return [one.name for one in lab.read(items.list_items, "lab", Kind.CHARACTER, sort="name").items]


def assert_sound(lab: Lab) -> None:
    assert list(fsck.check_store(lab.database)) == []


@in_rows_and_in_files
@pytest.mark.parametrize(
    ("fault", "left"),
    [
        ("blob.put.before_commit@2:kill", [True, False, False]),
        ("blob.put.after_commit@2:kill", [True, True, False]),
    ],
)
def test_a_sender_that_dies_leaves_whole_blobs(
    lab: Lab, writer: StoreWriter, fault: str, left: list[bool], backing: str
) -> None:
    assert writer.run("send", fault) == -signal.SIGKILL
    assert stored(lab) == left
    assert_sound(lab)
    assert writer.run("send") == 0
    assert stored(lab) == [True, True, True]
    assert_sound(lab)


@pytest.mark.every_database
@pytest.mark.parametrize(("fault", "left"), [("publish.before_commit:kill", 0), ("publish.after_commit:kill", 3)])
def test_a_publisher_that_dies_leaves_everything_or_nothing(
    lab: Lab, writer: StoreWriter, fault: str, left: int
) -> None:
    writer.run("send")
    assert writer.run("publish", fault) == -signal.SIGKILL
    assert len(published(lab)) == left
    assert_sound(lab)
    assert writer.run("publish") == 0
    assert published(lab) == ["study 0", "study 1", "study 2"]
    assert all(one.revision == 1 for one in lab.read(items.list_items, "lab", Kind.CHARACTER).items)
    assert_sound(lab)


@in_rows_and_in_files
def test_a_collector_that_dies_deletes_nothing_it_did_not_finish(lab: Lab, writer: StoreWriter, backing: str) -> None:
    writer.run("send")
    assert writer.run("collect", "garbage.before_commit:kill") == -signal.SIGKILL
    assert stored(lab) == [True, True, True]
    assert_sound(lab)
    assert writer.run("collect") == 0
    assert stored(lab) == [False, False, False]
    assert_sound(lab)


def left_deleted(lab: Lab) -> int:
    return len(lab.read(items.list_items, "lab", Kind.CHARACTER, items.ItemFilters(deleted=True)).items)


def purged(lab: Lab) -> list[str]:
    return [one.subject for one in lab.events() if one.kind == "item.purged"]


@pytest.mark.every_database
@pytest.mark.parametrize(("fault", "gone"), [("purge.before_commit@2:kill", 1), ("purge.after_commit@2:kill", 2)])
def test_a_purger_that_dies_leaves_each_item_whole_or_purged(
    lab: Lab, writer: StoreWriter, fault: str, gone: int
) -> None:
    writer.run("send")
    writer.run("publish")
    ids = [one.id for one in lab.read(items.list_items, "lab", Kind.CHARACTER).items]
    for one in ids:
        lab.write(items.delete_item, "lab", Kind.CHARACTER, one, expected_rev=None)
    assert writer.run("purge", fault) == -signal.SIGKILL
    assert (left_deleted(lab), len(purged(lab))) == (3 - gone, gone)
    garbage.collect_garbage(lab.database, grace_us=ALL_US)
    assert_sound(lab)
    for one in set(ids) - set(purged(lab)):
        assert lab.write(items.restore_item, "lab", Kind.CHARACTER, one).parts["character"].size_bytes > 0
        lab.write(items.delete_item, "lab", Kind.CHARACTER, one, expected_rev=None)
    assert writer.run("purge") == 0
    assert sorted(purged(lab)) == sorted(ids)
    garbage.collect_garbage(lab.database, grace_us=ALL_US)
    assert stored(lab) == [False, False, False]
    assert_sound(lab)


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.every_database
@pytest.mark.parametrize("place", ["before_copy", "after_copy"])
def test_a_process_that_dies_while_it_copies_its_log_loses_nothing(
    lab: Lab, writer: StoreWriter, place: str, tmp_path: Path
) -> None:
    assert writer.run("send-large", f"log.{place}:kill") == -signal.SIGKILL
    acknowledged = set(writer.digests)
    assert acknowledged
    assert lab.read(blobs.readable, acknowledged) == acknowledged
    assert_sound(lab)
    assert writer.run("send-large") == 0
    assert lab.read(blobs.readable, writer.digests) == {digest_of(data) for data in LARGE_FILES}
    assert_sound(lab)
    lab.database.close()
    assert not list(tmp_path.rglob("*-wal"))


def test_without_a_fault_nobody_dies(lab: Lab, writer: StoreWriter) -> None:
    assert [writer.run(work) for work in ("send", "publish", "collect")] == [0, 0, 0]
    assert len(published(lab)) == 3
    assert stored(lab) == [True, True, True]
    garbage.collect_garbage(lab.database, grace_us=ALL_US)
    assert_sound(lab)
    stranger = Principal("user", lab.stranger.user_id, "stranger", scopes=("read",))
    assert not lab.read(blobs.readable, [digest_of(FILES[0])], who=stranger)
