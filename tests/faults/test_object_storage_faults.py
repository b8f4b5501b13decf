"""Object storage that fails, is slow or loses bytes: requests get an error or the right bytes, others continue."""

import os
import secrets
import signal
from collections.abc import Callable, Iterator
from functools import partial

import obstore
import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.faulty_s3 import FaultyS3, faulty_s3
from tests.support.patience import PATIENCE_S
from tests.support.present import present
from tests.support.s3_servers import S3Server
from tests.support.store_fixtures import Lab
from tests.support.store_writer import FILES, StoreWriter

from marey_schemas.access import ProjectCreate
from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import ItemCreate
from marey_schemas.kinds import Kind
from marey_schemas.sizes import MIB
from marey_server.access.principal import SYSTEM
from marey_server.errors import DamagedProblem
from marey_server.store import blobs, fsck, garbage, items, projects
from marey_server.store.blob_backings import DatabaseBlobs, Spool
from marey_server.store.database.lanes import Client
from marey_server.store.monitoring.readiness import find_faults
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.object_storage.client import Bucket, ObjectStorage, ObjectStorageProblem, StoredObject

pytestmark = pytest.mark.xdist_group("object storage")

DATA = os.urandom(100_000)
DIGEST = digest_of(DATA)
OLD_S = 2 * 24 * 3600.0


@pytest.fixture
def seaweedfs(s3_servers: Callable[[str], S3Server]) -> S3Server:
    return s3_servers("seaweedfs")


@pytest.fixture
def proxy(seaweedfs: S3Server) -> Iterator[FaultyS3]:
    with faulty_s3(seaweedfs.port) as running:
        yield running


@pytest.fixture
def behind_proxy(seaweedfs: S3Server, proxy: FaultyS3) -> Bucket:
    return seaweedfs.bucket(f"test-{secrets.token_hex(8)}", endpoint=proxy.endpoint, timeout_s=5)


@pytest.fixture
def remote(lab: Lab, behind_proxy: Bucket) -> Lab:
    """The project, with blobs in object storage behind the proxy."""
    lab.database.blobs = ObjectBlobs(ObjectStorage(behind_proxy), DatabaseBlobs())
    return lab


def storage_of(lab: Lab) -> ObjectStorage:
    assert isinstance(lab.database.blobs, ObjectBlobs)
    return lab.database.blobs.storage


def object_of(lab: Lab, digest: str) -> StoredObject:
    found = lab.read(blobs.object_of, digest)
    assert found is not None
    return found


def publish(lab: Lab, digest: str) -> None:
    """Let an item refer to a blob, so that the blob is kept."""
    tree = {"schema": "marey/document@1", "blob": digest}
    lab.write(items.create_item, "lab", Kind.CHARACTER, ItemCreate(name=digest[-12:], parts={"character": tree}))


def objects_in(lab: Lab) -> set[StoredObject]:
    return {one for page in storage_of(lab).pages() for one in page}


def defects(lab: Lab) -> list[str]:
    return [one.code for one in fsck.check_store(lab.database)]


@pytest.mark.parametrize("fault", ["500", "503", "lost request", "lost answer"])
def test_a_request_that_fails_once_is_repeated(remote: Lab, proxy: FaultyS3, fault: str) -> None:
    proxy.spoil("PUT", fault)
    assert remote.write(blobs.put_blob, DATA) == DIGEST
    proxy.spoil("GET", fault)
    assert remote.read(blobs.read_blob, DIGEST) == DATA
    assert len(objects_in(remote)) == 1
    assert defects(remote) == []


def test_a_storage_that_always_fails_is_reported_and_nothing_is_stored(remote: Lab, proxy: FaultyS3) -> None:
    proxy.spoil("PUT", *["500"] * 20)
    with pytest.raises(ObjectStorageProblem) as refused:
        remote.write(blobs.put_blob, DATA)
    assert refused.value.status == 503
    assert int(refused.value.headers["Retry-After"]) > 0
    assert remote.read(blobs.readable, [DIGEST]) == set()
    proxy.planned.clear()
    assert remote.write(blobs.put_blob, DATA) == DIGEST


@pytest.mark.every_database
def test_other_writes_and_reads_go_on_while_the_storage_is_silent(remote: Lab, proxy: FaultyS3) -> None:
    """More calls wait for the storage than the database has threads."""
    remote.write(blobs.put_blob, DATA)
    callers = [Client(f"client {number}") for number in range(5)]
    proxy.spoil("PUT", *["silence"] * 5)
    proxy.spoil("GET", *["silence"] * 5)
    queue_write, queue_read = remote.database.queue_write, remote.database.queue_read
    waiting = [queue_write(one, remote.owner, partial(blobs.put_blob, content=one.key.encode())) for one in callers]
    reading = [queue_read(one, remote.owner, lambda tx: blobs.read_blob(tx, DIGEST)) for one in callers]
    for _ in range(10):
        assert proxy.silent.acquire(timeout=PATIENCE_S)
    made = remote.database.submit_write(remote.owner, projects.create_project, ProjectCreate(name="other"))
    assert made.result(PATIENCE_S).name == "other"
    seen = queue_read(Client("reader"), remote.owner, lambda tx: projects.read_project(tx, "other"))
    assert seen.result(PATIENCE_S).name == "other"
    assert not any(future.done() for future in waiting)
    assert not any(future.done() for future in reading)
    proxy.go_on.set()
    assert [future.result(PATIENCE_S) for future in waiting] == [digest_of(one.key.encode()) for one in callers]
    assert [future.result(PATIENCE_S) for future in reading] == [DATA] * 5


def test_bytes_that_were_cut_off_on_the_way_are_read_again(remote: Lab, proxy: FaultyS3) -> None:
    remote.write(blobs.put_blob, DATA)
    proxy.spoil("GET", "truncated")
    assert remote.read(blobs.read_blob, DIGEST) == DATA


def test_bytes_that_were_changed_on_the_way_are_refused(remote: Lab, proxy: FaultyS3) -> None:
    remote.write(blobs.put_blob, DATA)
    proxy.spoil("GET", "wrong bytes")
    with pytest.raises(DamagedProblem):
        remote.read(blobs.read_blob, DIGEST)
    assert remote.read(blobs.read_blob, DIGEST) == DATA


def test_objects_that_were_changed_shortened_or_deleted_are_found(remote: Lab) -> None:
    for number in range(4):
        publish(remote, remote.write(blobs.put_blob, DATA + bytes([number])))
    kept, changed, shortened, deleted = (object_of(remote, digest_of(DATA + bytes([number]))) for number in range(4))
    bucket = storage_of(remote)._store
    obstore.put(bucket, changed.name, bytes([DATA[0] ^ 1]) + DATA[1:] + bytes([1]))
    obstore.put(bucket, shortened.name, DATA[:10])
    obstore.delete(bucket, [deleted.name])
    found = {(one.code, one.subject) for one in fsck.check_store(remote.database)}
    assert found == {
        ("blob-corrupt", changed.digest),
        ("blob-incomplete", shortened.digest),
        ("blob-incomplete", deleted.digest),
    }
    with pytest.raises(DamagedProblem):
        remote.read(blobs.read_blob, changed.digest)
    assert remote.read(blobs.read_blob, kept.digest) == DATA + bytes([0])
    assert remote.read(blobs.read_range, shortened.digest, 50, 60) == b""
    assert remote.read(blobs.read_range, deleted.digest, 50, 60) == b""


def test_readiness_tells_that_the_storage_is_away(remote: Lab, proxy: FaultyS3) -> None:
    assert remote.database.read(SYSTEM, find_faults) == []
    proxy.spoil("PUT", "500")
    storage_of(remote)._probed = None
    (fault,) = remote.database.read(SYSTEM, find_faults)
    assert fault == f"blobs cannot be written: {proxy.endpoint}, bucket marey answers with the status 500"
    proxy.spoil("PUT", "500")
    assert remote.database.read(SYSTEM, find_faults) == [fault], "the result is used again"
    assert proxy.planned["PUT"] == ["500"], "the storage was not asked again"


def test_refused_credentials_are_told_without_the_secret(lab: Lab, seaweedfs: S3Server) -> None:
    lab.database.blobs = ObjectBlobs(
        ObjectStorage(seaweedfs.bucket("any", secret_key="not-the-secret")), DatabaseBlobs()
    )
    (fault,) = lab.database.read(SYSTEM, find_faults)
    assert fault == f"blobs cannot be written: {seaweedfs.endpoint}, bucket marey refuses the credentials"
    with pytest.raises(ObjectStorageProblem) as refused:
        lab.write(blobs.put_blob, DATA)
    assert "not-the-secret" not in f"{refused.value} {refused.value.__cause__}"


def test_large_objects_are_sent_in_parts(remote: Lab, proxy: FaultyS3) -> None:
    data = os.urandom(20 * MIB + 1)
    with Spool() as spool:
        for start in range(0, len(data), MIB):
            spool.write(data[start : start + MIB])
        digest = remote.write(blobs.put_blob, spool)
    assert len([path for method, path in proxy.seen if method == "PUT" and "partNumber" in path]) == 3
    assert remote.read(blobs.read_blob, digest) == data
    assert defects(remote) == []


# -- the server's process and the S3 server die ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "stored"),
    [
        ("objects.before_put@2:kill", 1),
        ("objects.after_put@2:kill", 1),
        ("blob.put.before_commit@2:kill", 1),
        ("blob.put.after_commit@2:kill", 2),
    ],
)
def test_a_sender_that_dies_leaves_whole_blobs_and_objects_that_are_swept(
    remote: Lab, behind_proxy: Bucket, database_url: str, clock: AdjustableClock, fault: str, stored: int
) -> None:
    writer = StoreWriter(
        database_url, present(remote.owner.user_id), present(remote.owner.user_name), bucket=behind_proxy
    )
    assert writer.run("send", fault) == -signal.SIGKILL
    assert remote.read(blobs.readable, map(digest_of, FILES)) == {digest_of(data) for data in FILES[:stored]}
    assert defects(remote) == []
    assert writer.run("send") == 0
    for data in FILES:
        publish(remote, digest_of(data))
    clock.advance(OLD_S)
    garbage.collect_garbage(remote.database)
    assert objects_in(remote) == {object_of(remote, digest_of(data)) for data in FILES}
    assert defects(remote) == []


def test_a_sweeper_that_dies_has_deleted_nothing_that_a_row_names(
    remote: Lab, behind_proxy: Bucket, database_url: str, clock: AdjustableClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    for data in FILES:
        remote.write(blobs.put_blob, data)
    publish(remote, digest_of(FILES[0]))
    clock.advance(OLD_S)
    with monkeypatch.context() as dying:
        dying.setattr(ObjectStorage, "delete", _die)
        with pytest.raises(_DiedError):
            garbage.collect_garbage(remote.database)
    assert defects(remote) == []
    assert len(objects_in(remote)) == 3
    garbage.collect_garbage(remote.database)
    assert objects_in(remote) == {object_of(remote, digest_of(FILES[0]))}


class _DiedError(BaseException):
    """Error that simulates the death of the process."""


def _die(*_: object) -> None:
    raise _DiedError


@pytest.mark.parametrize("fault", ["move.after_copy@2:kill", "move.before_commit@2:kill"])
def test_a_move_that_dies_leaves_every_blob_readable_and_goes_on(
    lab: Lab, behind_proxy: Bucket, database_url: str, clock: AdjustableClock, fault: str
) -> None:
    for data in FILES:
        lab.write(blobs.put_blob, data)
        publish(lab, digest_of(data))
    lab.database.blobs = ObjectBlobs(ObjectStorage(behind_proxy), DatabaseBlobs())
    writer = StoreWriter(database_url, present(lab.owner.user_id), present(lab.owner.user_name), bucket=behind_proxy)
    assert writer.run("move", fault) == -signal.SIGKILL
    assert [lab.read(blobs.read_blob, digest_of(data)) for data in FILES] == FILES
    assert sum(lab.read(blobs.object_of, digest_of(data)) is not None for data in FILES) == 1
    assert writer.run("move") == 0
    assert [lab.read(blobs.read_blob, digest_of(data)) for data in FILES] == FILES
    clock.advance(OLD_S)
    garbage.collect_garbage(lab.database)
    assert objects_in(lab) == {object_of(lab, digest_of(data)) for data in FILES}
    assert defects(lab) == []
