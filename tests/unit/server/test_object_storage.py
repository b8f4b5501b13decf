"""Blobs in object storage without a network: names of objects, deletion while others write, moves, settings."""

import threading
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from tests.support.database_fixtures import AdjustableClock
from tests.support.present import present
from tests.support.store_fixtures import Lab
from tests.support.tiers import examples

from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.sizes import MIB
from marey_server.access.principal import SYSTEM
from marey_server.process.settings import Settings
from marey_server.store import blobs, documents, fsck, garbage, items, uploads
from marey_server.store.blob_backings import CHUNK_BYTES, DatabaseBlobs, DirectoryBlobs
from marey_server.store.blobs import GRACE_US
from marey_server.store.object_storage import awaiting, backing
from marey_server.store.object_storage.awaiting import BytesAwaited, Carried
from marey_server.store.object_storage.backing import COMMIT_WITHIN_US, ObjectBlobs
from marey_server.store.object_storage.client import Bucket, ObjectStorage, ObjectStorageProblem, StoredObject
from marey_server.store.object_upkeep import sweeping
from marey_server.store.object_upkeep.moving import CannotMove, Moved, move_blobs, move_uploads
from marey_server.store.tables import blob_chunk, document, upload_chunk
from marey_server.store.transaction import Transaction

ANY_DIGEST = "sha256:" + "ab" * 32


class ObjectsInMemory(ObjectStorage):
    """Object storage that keeps objects in a dictionary and counts the requests."""

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}
        self.reads = 0

    def put(self, name: str, chunks: Iterable[bytes]) -> None:
        self.objects[name] = b"".join(chunks)

    def read(self, name: str, start: int, stop: int) -> bytes | None:
        self.reads += 1
        found = self.objects.get(name)
        return None if found is None else found[start:stop]

    def size_of(self, name: str) -> int | None:
        return len(self.objects[name]) if name in self.objects else None

    def pages(self) -> Iterator[list[StoredObject]]:
        yield [one for name in sorted(self.objects) if (one := StoredObject.parse(name)) is not None]

    def delete(self, names: Sequence[str]) -> None:
        for name in names:
            self.objects.pop(name, None)

    def fault(self) -> str | None:
        return None


@pytest.fixture
def objects() -> ObjectsInMemory:
    return ObjectsInMemory()


@pytest.fixture
def remote(lab: Lab, objects: ObjectsInMemory) -> Lab:
    """The project, with blobs in object storage."""
    lab.database.blobs = ObjectBlobs(objects, DatabaseBlobs())
    return lab


def publish(lab: Lab, digest: str) -> None:
    """Let an item refer to a blob, so that the blob is kept."""
    tree = {"schema": "marey/document@1", "blob": digest}
    lab.write(items.create_item, "lab", Kind.CHARACTER, ItemCreate(name=digest[-12:], parts={"character": tree}))


def defects(lab: Lab) -> list[str]:
    return [one.code for one in fsck.check_store(lab.database)]


def test_the_name_of_an_object_tells_its_digest_and_the_time_of_its_transfer() -> None:
    one = StoredObject.new(ANY_DIGEST, 1_700_000_000_000_000)
    assert one.name.startswith(f"blobs/ab/{'ab' * 31}/")
    assert StoredObject.parse(one.name) == one
    assert one.began_us == 1_700_000_000_000_000
    assert StoredObject.new(ANY_DIGEST, one.began_us) != one
    for other in ("writable", "blobs/ab/cd", f"blobs/ab/{'ab' * 31}/short"):
        assert StoredObject.parse(other) is None


# -- deletion beside writers ------------------------------------------------------------------------------------------


class Writer:
    """Sender of a blob whose steps a test can interleave with other steps."""

    def __init__(self, lab: Lab, data: bytes) -> None:
        self._lab, self._data = lab, data
        self._carried = Carried()
        self._awaited: BytesAwaited | None = None
        self.has_ended = False

    def step(self) -> None:
        """Run the transaction if no bytes are awaited; otherwise move the bytes."""
        if self.has_ended:
            return
        if self._awaited is not None:
            self._awaited.move(self._carried)
            self._awaited = None
            return
        database = self._lab.database
        assert isinstance(database.blobs, ObjectBlobs)

        def run(tx: Transaction) -> None:
            tx.blobs = database.blobs.within(self._carried, lambda: tx.now_us)
            blobs.put_blob(tx, self._data)

        try:
            database._write(self._lab.owner, run)
            self.has_ended = True
        except BytesAwaited as awaited:
            self._awaited = awaited


class Sweeper:
    """Sweep of objects, which stops between the decision to delete objects and the deletion."""

    def __init__(self, lab: Lab, objects: ObjectsInMemory) -> None:
        self._lab, self._objects = lab, objects
        self._going: list[StoredObject] = []

    def step(self) -> None:
        """Delete the objects that the previous step has chosen; if it chose none, choose objects to delete."""
        if self._going:
            self._objects.delete([one.name for one in self._going])
            self._going = []
            return
        for page in self._objects.pages():
            old = self._lab.database.read(SYSTEM, sweeping._unnamed, page, GRACE_US)
            self._going += self._lab.database.write(SYSTEM, sweeping._never_named, old, GRACE_US) if old else []


def run_interleaved(
    lab: Lab, objects: ObjectsInMemory, clock: AdjustableClock, plan: Sequence[str], data: bytes
) -> None:
    """Run steps of two writers of the same bytes, a sweeper, and the garbage collection of rows, in this order."""
    actors = {"a": Writer(lab, data), "b": Writer(lab, data), "sweeper": Sweeper(lab, objects)}
    for name in plan:
        if name == "seven hours":
            clock.advance(7 * 3600)
        elif name == "a day":
            clock.advance(GRACE_US / 1e6 + 1)
        elif name == "forget":
            lab.write(garbage.delete_blobs, [digest_of(data)], who=SYSTEM)
        else:
            actors[name].step()


STEPS = ("a", "b", "sweeper", "forget", "seven hours", "a day")
LATE_COMMIT = ("a", "a", "a day", "sweeper", "a", "sweeper")
"""A writer that is about to commit sleeps, until its object is swept."""
DELAYED_DELETION = ("a", "a", "a", "a day", "forget", "sweeper", "b", "b", "b", "sweeper")
"""A sweeper that has decided sleeps, until the same bytes are stored again."""


def complete(lab: Lab, objects: ObjectsInMemory, data: bytes) -> bool:
    """Return whether the bytes of a blob are stored, if the blob exists."""
    found = lab.read(blobs.sizes_of, [digest_of(data)])
    return not found or lab.read(blobs.read_blob, digest_of(data)) == data


@settings(max_examples=examples(150), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(plan=st.lists(st.sampled_from(STEPS), max_size=14), number=st.integers(0, 2**64))
def test_no_object_that_a_row_names_is_deleted_in_any_order_of_steps(
    remote: Lab, objects: ObjectsInMemory, clock: AdjustableClock, plan: list[str], number: int
) -> None:
    data = f"{number} {plan}".encode()
    run_interleaved(remote, objects, clock, plan, data)
    assert complete(remote, objects, data)


@pytest.mark.parametrize("plan", [LATE_COMMIT, DELAYED_DELETION])
def test_a_late_commit_and_a_delayed_deletion_lose_nothing(
    remote: Lab, objects: ObjectsInMemory, clock: AdjustableClock, plan: tuple[str, ...]
) -> None:
    run_interleaved(remote, objects, clock, plan, b"bytes")
    assert complete(remote, objects, b"bytes")
    Writer(remote, b"bytes").step()
    assert complete(remote, objects, b"bytes")


def test_without_the_limit_of_twelve_hours_a_late_commit_loses_bytes(
    remote: Lab, objects: ObjectsInMemory, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backing, "COMMIT_WITHIN_US", 10 * GRACE_US)
    run_interleaved(remote, objects, clock, LATE_COMMIT, b"bytes")
    assert not complete(remote, objects, b"bytes")


def test_with_names_that_are_used_again_a_delayed_deletion_loses_bytes(
    remote: Lab, objects: ObjectsInMemory, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(StoredObject, "new", lambda digest, _began_us: StoredObject(digest, f"{0:016x}-{0:016x}"))
    monkeypatch.setattr(backing, "COMMIT_WITHIN_US", 2**62)
    run_interleaved(remote, objects, clock, DELAYED_DELETION, b"bytes")
    assert not complete(remote, objects, b"bytes")


def test_a_transaction_stores_blobs_in_any_number_of_calls(remote: Lab) -> None:
    contents = [f"blob {number}".encode() for number in range(awaiting.MOST_TRANSFERS + 2)]

    def put_each(tx: Transaction) -> None:
        for content in contents:
            blobs.put_blob(tx, content)

    remote.write(put_each)
    sizes = remote.read(blobs.sizes_of, [digest_of(content) for content in contents])
    assert list(sizes.values()) == [len(content) for content in contents]


def test_a_transfer_that_is_always_too_slow_is_given_up(
    remote: Lab, objects: ObjectsInMemory, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    puts: list[str] = []

    def put(name: str, _chunks: object) -> None:
        puts.append(name)
        clock.advance(COMMIT_WITHIN_US / 1e6 + 1)

    monkeypatch.setattr(objects, "put", put)
    with pytest.raises(ObjectStorageProblem):
        remote.write(blobs.put_blob, b"slow")
    assert len(puts) == awaiting.MOST_TRANSFERS
    assert remote.read(blobs.sizes_of, [digest_of(b"slow")]) == {}


# -- reading ----------------------------------------------------------------------------------------------------------


def test_the_arrays_of_documents_are_read_together(remote: Lab, objects: ObjectsInMemory) -> None:
    rig = remote.add_skeleton()
    for seed in range(6):
        remote.add_clip(rig, name=f"walk {seed}", seed=seed)
    objects.reads = 0
    runs: list[int] = []

    def load(tx: Transaction) -> int:
        runs.append(1)
        return len(documents.load_documents(tx, tx.execute(sqlalchemy.select(document.c.digest)).scalars().all()))

    assert remote.read(load) > 6
    assert len(runs) == 2
    assert objects.reads == len(objects.objects)


def test_a_blob_that_is_moved_while_it_is_read_is_read_at_its_new_place(
    lab: Lab, objects: ObjectsInMemory, tmp_path: Path
) -> None:
    """The mover removes the file after the snapshot of the reader, which must look again."""
    files = DirectoryBlobs(tmp_path / "blobs")
    lab.database.blobs = files
    digest = lab.write(blobs.put_blob, b"moving")
    lab.database.blobs = ObjectBlobs(objects, files)
    moved = threading.Event()

    def read(tx: Transaction) -> bytes:
        size = blobs.sizes_of(tx, [digest])[digest]
        if not moved.is_set():
            mover = threading.Thread(target=move_all, args=(lab,))
            mover.start()
            mover.join()
            files.remove_stray(digest)
            moved.set()
        return blobs.read_blob(tx, digest, 0, size)

    assert lab.read(read) == b"moving"


# -- moving -----------------------------------------------------------------------------------------------------------


def move_all(lab: Lab) -> Moved:
    moved = Moved()
    move_blobs(lab.database, moved)
    return moved


def test_blobs_are_moved_from_rows_and_files_to_objects_and_back_to_files(
    lab: Lab, objects: ObjectsInMemory, tmp_path: Path, clock: AdjustableClock
) -> None:
    files = DirectoryBlobs(tmp_path / "blobs")
    contents = [bytes([number]) * (number * CHUNK_BYTES // 2 + number) for number in range(5)]
    for number, data in enumerate(contents):
        lab.database.blobs = DatabaseBlobs() if number % 2 else files
        publish(lab, lab.write(blobs.put_blob, data))
    places: list[tuple[ObjectBlobs, int]] = [
        (ObjectBlobs(objects, files), 5),
        (ObjectBlobs(objects, files, stores_objects=False), 5),
        (ObjectBlobs(objects, files), 5),
    ]
    for place, count in places:
        lab.database.blobs = place
        assert [lab.read(blobs.read_blob, digest_of(data)) for data in contents] == contents
        moved = move_all(lab)
        assert (moved.blobs, moved.damaged) == (count, ())
        assert str(moved).startswith("5 blobs (")
        assert [lab.read(blobs.read_blob, digest_of(data)) for data in contents] == contents
        assert move_all(lab).blobs == 0
        assert defects(lab) == []
        clock.advance(2 * GRACE_US / 1e6)
        garbage.collect_garbage(lab.database)
        assert len(objects.objects) == (5 if place.stores_objects else 0)
    assert lab.read(lambda tx: tx.execute(blob_chunk.select()).all()) == []


def test_an_upload_stays_in_the_database_until_it_is_moved(remote: Lab, objects: ObjectsInMemory) -> None:
    data = bytes(range(256)) * 8192
    upload = remote.write(uploads.create_upload, len(data))
    for start in range(0, len(data), MIB):
        remote.write(uploads.append, upload.id, start, data[start : start + MIB])
    remote.write(uploads.finish, upload.id, digest_of(data), None)
    publish(remote, digest_of(data))
    assert objects.objects == {}
    assert remote.read(blobs.read_blob, digest_of(data)) == data
    assert move_uploads(remote.database).blobs == 1
    assert list(objects.objects.values()) == [data]
    assert remote.read(blobs.read_range, digest_of(data), 5, 99) == data[5:99]
    garbage.collect_garbage(remote.database)
    assert remote.read(lambda tx: tx.execute(upload_chunk.select()).all()) == []
    assert defects(remote) == []


def test_a_damaged_blob_is_not_moved(lab: Lab, objects: ObjectsInMemory, tmp_path: Path) -> None:
    files = DirectoryBlobs(tmp_path / "blobs")
    lab.database.blobs = files
    digest, kept = lab.write(blobs.put_blob, b"damaged"), lab.write(blobs.put_blob, b"kept")
    files._path(digest).write_bytes(b"DAMAGED")
    lab.database.blobs = ObjectBlobs(objects, files)
    moved = move_all(lab)
    assert (moved.blobs, moved.damaged) == (1, (digest,))
    assert [present(StoredObject.parse(name)).digest for name in objects.objects] == [kept]
    assert lab.read(blobs.object_of, digest) is None


def test_a_blob_that_is_deleted_during_its_move_stays_deleted(
    lab: Lab, objects: ObjectsInMemory, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = lab.write(blobs.put_blob, b"going")
    clock.advance(2 * GRACE_US / 1e6)
    lab.database.blobs = ObjectBlobs(objects, DatabaseBlobs())
    put = objects.put

    def put_and_delete(name: str, chunks: Iterable[bytes]) -> None:
        put(name, chunks)
        lab.write(garbage.delete_blobs, [digest], who=SYSTEM)

    monkeypatch.setattr(objects, "put", put_and_delete)
    moved = move_all(lab)
    assert (moved.blobs, moved.damaged) == (0, ())
    assert lab.read(blobs.sizes_of, [digest]) == {}


def test_blobs_cannot_be_moved_into_the_database(lab: Lab) -> None:
    with pytest.raises(CannotMove, match="not into the database"):
        move_all(lab)


def test_a_blob_in_a_bucket_that_the_settings_do_not_name_is_told(remote: Lab) -> None:
    publish(remote, remote.write(blobs.put_blob, b"far away"))
    remote.database.blobs = DatabaseBlobs()
    (found,) = fsck.check_store(remote.database)
    assert (found.code, "s3_bucket" in found.detail) == ("blob-unreachable", True)


# -- settings ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    file = tmp_path / "secret"
    file.write_text("very-secret\n")
    return file


def test_the_settings_give_the_bucket_and_never_show_its_secret(secret: Path) -> None:
    chosen = Settings(
        blobs="s3", s3_bucket="motions", s3_endpoint="http://s3:9000", s3_key_id="me", s3_secret_key_file=secret
    )
    assert chosen.bucket == Bucket("motions", endpoint="http://s3:9000", key_id="me", secret_key="very-secret")
    assert "very-secret" not in f"{chosen!r} {chosen.bucket!r} {chosen.bucket.shown}"
    assert Settings().bucket is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"blobs": "s3"}, "needs the name of a bucket"),
        ({"s3_bucket": "motions", "s3_key_id": "me"}, "needed together"),
        ({"s3_bucket": "motions", "s3_endpoint": "s3.internal"}, "must begin with http"),
        ({"s3_bucket": "motions", "s3_endpoint": "http://me:secret@s3"}, "must not contain a user"),
    ],
)
def test_settings_that_do_not_fit_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Settings(**given)
