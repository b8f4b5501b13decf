"""Rules for blob backings (places where blobs are stored), checked for every backing on every database."""

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from threading import Barrier
from types import SimpleNamespace
from typing import Any, cast

import pytest
from sqlalchemy import Connection
from tests.support.database_fixtures import AdjustableClock
from tests.support.store_fixtures import Lab

from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access.principal import SYSTEM
from marey_server.errors import InvalidProblem, NotFoundProblem, StorageFullProblem
from marey_server.store import blob_backings, blobs, garbage, items
from marey_server.store.blob_backings import CHUNK_BYTES, DatabaseBlobs, DirectoryBlobs, Spool
from marey_server.store.database.connections import Database
from marey_server.store.object_storage.awaiting import Carried
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.transaction import Transaction

pytestmark = pytest.mark.xdist_group("object storage")

SIZES = (0, 1, 1000, CHUNK_BYTES - 1, CHUNK_BYTES, CHUNK_BYTES + 1, 3 * CHUNK_BYTES + 17)
OLD_US = 2 * 24 * 3600 * 1_000_000


def written_by(backing: Any) -> type:
    """Return the class of the object whose method `write` is called by transactions."""
    return type(backing.within(Carried(), int)) if isinstance(backing, ObjectBlobs) else type(backing)


class BlobBackingContract:
    """Tests that every backing of blobs must pass; each subclass defines the fixture `backing`."""

    @pytest.fixture
    def store(self, database: Database, backing: Any) -> Lab:
        database.blobs = backing
        return Lab(database)

    @pytest.fixture(params=["bytes", "spool"])
    def as_content(self, request: pytest.FixtureRequest) -> Any:
        def spooled(data: bytes) -> Spool:
            spool = Spool()
            for start in range(0, len(data), 70_000):
                spool.write(data[start : start + 70_000])
            return spool

        return bytes if request.param == "bytes" else spooled

    def test_bytes_of_any_size_come_back_whole_and_in_ranges(self, store: Lab, as_content: Any) -> None:
        for size in SIZES:
            data = os.urandom(size)
            digest = store.write(blobs.put_blob, as_content(data))
            assert digest == digest_of(data)
            assert store.read(blobs.read_blob, digest) == data
            for start, stop in (
                (0, 0),
                (0, 10),
                (size // 2, size),
                (CHUNK_BYTES - 5, CHUNK_BYTES + 5),
                (size - 3, size + 9),
            ):
                start = max(start, 0)
                assert store.read(blobs.read_range, digest, start, stop) == data[start:stop], (size, start, stop)

    def test_large_blobs_are_read_in_pieces(self, store: Lab) -> None:
        digest = store.write(blobs.put_blob, os.urandom(5 * CHUNK_BYTES))
        pieces = store.read(
            lambda tx: [len(piece) for piece in tx.blobs.read(tx.connection, digest, 0, 5 * CHUNK_BYTES)]
        )
        assert max(pieces) <= CHUNK_BYTES

    def test_the_same_bytes_again_are_stored_once(self, store: Lab) -> None:
        data = os.urandom(2 * CHUNK_BYTES)
        assert store.write(blobs.put_blob, data) == store.write(blobs.put_blob, data, who=store.reader)
        assert store.read(blobs.read_blob, digest_of(data)) == data

    def test_the_same_bytes_sent_at_once_by_many_are_stored_once(self, store: Lab) -> None:
        data = os.urandom(CHUNK_BYTES + 9)
        senders = [store.owner, store.reader, store.contributor, store.stranger] * 2
        futures = [store.database.submit_write(who, blobs.put_blob, data) for who in senders]
        assert {future.result(60) for future in futures} == {digest_of(data)}
        assert store.read(blobs.read_blob, digest_of(data), who=store.stranger) == data

    def test_bytes_that_are_not_the_announced_ones_are_refused(self, store: Lab) -> None:
        with pytest.raises(InvalidProblem):
            store.write(blobs.put_blob, b"changed", expected=digest_of(b"original"))
        with pytest.raises(NotFoundProblem):
            store.read(blobs.require_readable, digest_of(b"changed"))

    def test_bytes_of_a_write_that_failed_do_not_exist(self, store: Lab) -> None:
        def fail(tx: Transaction) -> None:
            blobs.put_blob(tx, b"never")
            raise RuntimeError("on the way")

        with pytest.raises(RuntimeError):
            store.write(fail)
        with pytest.raises(NotFoundProblem):
            store.read(blobs.require_readable, digest_of(b"never"))
        assert store.write(blobs.put_blob, b"never") == digest_of(b"never")
        assert store.read(blobs.read_blob, digest_of(b"never")) == b"never"

    def test_a_full_disk_refuses_the_bytes_and_leaves_nothing(
        self, store: Lab, backing: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fill_up(self: object, connection: Connection, contents: Any) -> None:
            next(iter(next(iter(contents.values()))))
            raise OSError(28, "No space left on device")

        with monkeypatch.context() as full:
            full.setattr(written_by(backing), "write", fill_up)
            with pytest.raises(StorageFullProblem):
                store.write(blobs.put_blob, b"too much")
        with pytest.raises(NotFoundProblem):
            store.read(blobs.require_readable, digest_of(b"too much"))

    def test_garbage_is_collected_with_its_bytes(self, store: Lab, backing: Any, clock: AdjustableClock) -> None:
        digest = store.write(blobs.put_blob, b"nobody's")
        assert garbage.collect_garbage(store.database).blobs == 0
        clock.advance(OLD_US / 1e6)
        young = store.write(blobs.put_blob, b"somebody's")
        assert garbage.collect_garbage(store.database).blobs == 1
        assert store.read(lambda tx: b"".join(tx.blobs.read(tx.connection, young, 0, 10))) == b"somebody's"
        with pytest.raises(NotFoundProblem):
            store.read(blobs.require_readable, digest)
        garbage.collect_garbage(store.database, grace_us=-1)
        assert store.read(lambda tx: b"".join(tx.blobs.read(tx.connection, digest, 0, 8))) == b""

    def test_a_blob_deleted_by_a_transaction_that_rolls_back_keeps_its_bytes(
        self, store: Lab, clock: AdjustableClock
    ) -> None:
        digest = store.write(blobs.put_blob, b"still here")
        clock.advance(OLD_US / 1e6)

        def fail(tx: Transaction) -> None:
            assert garbage.delete_blobs(tx, [digest]) == 1
            raise RuntimeError("on the way")

        with pytest.raises(RuntimeError):
            store.write(fail)
        assert store.read(blobs.read_blob, digest) == b"still here"

    def test_bytes_sent_again_while_strays_are_swept_survive(self, store: Lab, clock: AdjustableClock) -> None:
        """The garbage collection and the second upload run in both orders; the blob must exist at the end."""
        data = b"swept and sent"
        for _ in range(5):
            store.write(blobs.put_blob, data)
            clock.advance(OLD_US / 1e6)
            store.write(garbage.delete_blobs, [digest_of(data)], who=SYSTEM)
            start = threading.Barrier(2)

            def sweep(start: Barrier = start) -> None:
                start.wait(10)
                garbage.collect_garbage(store.database, grace_us=0)

            thread = threading.Thread(target=sweep)
            thread.start()
            start.wait(10)
            store.write(blobs.put_blob, data)
            thread.join(60)
            found = store.read(blobs.readable, [digest_of(data)])
            assert not found or store.read(blobs.read_blob, digest_of(data)) == data

    def test_it_says_that_it_can_be_written(self, store: Lab) -> None:
        store.read(lambda tx: tx.blobs.check_writable())


class TestDatabaseBlobs(BlobBackingContract):
    @pytest.fixture
    def backing(self) -> DatabaseBlobs:
        return DatabaseBlobs()


def test_many_small_blobs_take_time_in_proportion_to_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths_asked = []
    written = []

    class Counted(bytes):
        def __len__(self) -> int:
            lengths_asked.append(self)
            return super().__len__()

    inserting = SimpleNamespace(run_each=lambda _connection, rows: written.append(len(rows)))
    monkeypatch.setattr(blob_backings, "_INSERT_CHUNK", inserting)
    monkeypatch.setattr(blob_backings, "BYTES_PER_STATEMENT", 4000)

    DatabaseBlobs().write(cast(Any, None), {str(number): [Counted(10)] for number in range(1000)})

    assert written == [400, 400, 200]
    assert len(lengths_asked) == 1000


class TestDirectoryBlobs(BlobBackingContract):
    @pytest.fixture
    def backing(self, tmp_path: Path) -> DirectoryBlobs:
        return DirectoryBlobs(tmp_path / "blobs")

    def test_files_without_rows_are_swept_and_others_stay(self, store: Lab, backing: DirectoryBlobs) -> None:
        kept = store.write(blobs.put_blob, b"kept")

        def fail(tx: Transaction) -> None:
            blobs.put_blob(tx, b"stray")
            raise RuntimeError("on the way")

        with pytest.raises(RuntimeError):
            store.write(fail)
        (backing.root / "incoming" / "half").write_bytes(b"half a file")
        strays = set(backing.stray_digests(older_than_s=-10))
        assert strays == {kept, digest_of(b"stray")}
        assert garbage.collect_garbage(store.database).stray_files == 0
        for path in backing.root.rglob("*"):
            os.utime(path, (0, 0))
        assert garbage.collect_garbage(store.database).stray_files == 1
        assert set(backing.stray_digests(older_than_s=-10)) == {kept}
        assert store.read(blobs.read_blob, kept) == b"kept"

    def test_other_users_may_not_look_into_its_folders(self, store: Lab, backing: DirectoryBlobs) -> None:
        store.write(blobs.put_blob, b"private")
        folders = [backing.root, *(path for path in backing.root.iterdir() if path.is_dir())]
        assert [folder.stat().st_mode & 0o777 for folder in folders] == [0o700] * 3

    def test_an_interrupted_write_leaves_no_file_under_the_name(self, store: Lab, backing: DirectoryBlobs) -> None:
        def broken() -> Iterator[bytes]:
            yield b"half"
            raise RuntimeError("cut off")

        with pytest.raises(RuntimeError):
            store.write(lambda tx: tx.blobs.write(tx.connection, {digest_of(b"x"): broken()}))
        assert list(backing.stray_digests(older_than_s=-10)) == []
        assert list((backing.root / "incoming").iterdir()) == []

    def test_a_directory_that_cannot_be_written_is_told(self, backing: DirectoryBlobs) -> None:
        (backing.root / "incoming").rmdir()
        with pytest.raises(OSError, match="incoming"):
            backing.check_writable()


class TestObjectBlobs(BlobBackingContract):
    @pytest.fixture
    def backing(self, object_blobs: ObjectBlobs) -> ObjectBlobs:
        return object_blobs

    def test_objects_without_rows_are_swept_and_others_stay(
        self, store: Lab, backing: ObjectBlobs, clock: AdjustableClock
    ) -> None:
        kept = store.write(blobs.put_blob, b"kept")
        study = ItemCreate(name="s", parts={"character": {"schema": "marey/document@1", "blob": kept}})
        store.write(items.create_item, "lab", Kind.CHARACTER, study)

        def fail(tx: Transaction) -> None:
            blobs.put_blob(tx, b"stray")
            raise RuntimeError("on the way")

        with pytest.raises(RuntimeError):
            store.write(fail)
        assert {one.digest for page in backing.storage.pages() for one in page} == {kept, digest_of(b"stray")}
        assert garbage.collect_garbage(store.database).stray_objects == 0
        clock.advance(OLD_US / 1e6)
        assert garbage.collect_garbage(store.database).stray_objects == 1
        assert {one.digest for page in backing.storage.pages() for one in page} == {kept}
        assert store.read(blobs.read_blob, kept) == b"kept"
