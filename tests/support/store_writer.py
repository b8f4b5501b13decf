"""A process that writes to a database, for tests that kill it."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tests.support.present import present

from marey_schemas.encoding.digests import digest_of
from marey_schemas.kinds import Kind
from marey_schemas.purges import PurgeRequest
from marey_schemas.queue.worker_protocol import CompleteRequest
from marey_server import faults
from marey_server.access.principal import Principal
from marey_server.store import blobs, garbage, items, projects, purging
from marey_server.store.blob_backings import DatabaseBlobs, DirectoryBlobs
from marey_server.store.database.connections import Database
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.jobs import completion
from marey_server.store.jobs.finishing import commit_deferred
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.object_storage.client import Bucket, ObjectStorage
from marey_server.store.object_upkeep.moving import Moved, move_blobs
from marey_server.store.transaction import Transaction

LARGE_FILES = [bytes([number]) * 2**20 for number in range(12)]
"""Files that together make the write-ahead log of SQLite long."""
ALL_US = -60_000_000
"""Grace period with which all garbage is deleted. On SQLite, the clock of each process starts up to a second ahead."""
LONGEST_S = 60.0
"""Longest time that a process may take for its work."""
FILES = [f"file {number}".encode() * 1000 for number in range(3)]


def publish(tx: Transaction) -> Any:
    """Publish three small items of the kind `study` that refer to the blobs of `FILES`."""
    row = projects.require(tx, "lab")
    trees = [{"n": n, "blob": digest_of(data)} for n, data in enumerate(FILES)]
    drafts = [
        items.Draft(f"d{n}", Kind.CHARACTER, f"study {n}", {"character": tree}, "a/b") for n, tree in enumerate(trees)
    ]
    return items.publish(tx, row, drafts, author_id=tx.principal.user_id, rights=rights_of_caller(tx, row))


def purge(database: Database, who: Principal) -> None:
    """Purge all deleted studies of `lab`, each in a transaction of its own."""
    deleted = database.read(who, items.list_items, "lab", Kind.CHARACTER, items.ItemFilters(deleted=True))
    for one in deleted.items:
        request = PurgeRequest(item=one.id)
        prepared = database.read(who, purging.prepare_purge, "lab", request)
        database.write(who, purging.record_purge, "lab", request, prepared)


class StoreWriter:
    """Does work in processes, each of which may have a fault.

    Blobs are in `bucket` if it is given, otherwise in `folder`, or in the database if `folder` is empty. The processes
    are forked from one that has loaded the server, because loading it takes longer than most of the work.
    """

    def __init__(self, url: str, user_id: str, user_name: str, folder: str = "", bucket: Bucket | None = None) -> None:
        self._arguments = (url, Principal("user", user_id, user_name, scopes=("read", "write")), folder, bucket)
        self.digests: list[str] = []
        """Digests of the large files that the last process has stored."""

    def run(self, work: str, fault: str = "") -> int:
        """Do `work` in a process; return its exit status: 0, or minus the number of the signal that killed it.

        The work `send` or `send-large` stores files, `publish` and `purge` call the functions of these names,
        `complete JOB FENCE` completes an attempt, `commit-deferred` commits the outputs of jobs with many outputs,
        `collect` collects garbage, and `move` moves all blobs to `bucket`.
        """
        fork_server = multiprocessing.get_context("forkserver")
        fork_server.set_forkserver_preload([__name__])
        receiver, sender = fork_server.Pipe(duplex=False)
        process = fork_server.Process(target=_do, args=(*self._arguments, work, fault, sender))
        process.start()
        sender.close()
        self.digests = []
        with contextlib.suppress(EOFError):
            while receiver.poll(LONGEST_S):
                self.digests.append(receiver.recv())
        process.join(LONGEST_S)
        status = process.exitcode
        process.kill()
        assert status in (0, -signal.SIGKILL), f"{work} with the fault {fault!r} ended with {status}"
        process.close()
        return present(status)


def _do(
    url: str, who: Principal, folder: str, bucket: Bucket | None, work: str, fault: str, sender: Connection
) -> None:
    faults.plan(fault)
    local = DirectoryBlobs(Path(folder)) if folder else DatabaseBlobs()
    database = Database(url, blobs=local if bucket is None else ObjectBlobs(ObjectStorage(bucket), local))
    name, *arguments = work.split()
    if name == "send":
        for data in FILES:
            database.write(who, blobs.put_blob, data)
    elif name == "send-large":
        for data in LARGE_FILES:
            sender.send(database.write(who, blobs.put_blob, data))
    elif name == "publish":
        database.write(who, publish)
    elif name == "purge":
        purge(database, who)
    elif name == "complete":
        complete(database, arguments[0], int(arguments[1]))
    elif name == "commit-deferred":
        commit_deferred(database)
    elif name == "move":
        move_blobs(database, Moved())
    else:
        assert name == "collect"
        garbage.collect_garbage(database, grace_us=ALL_US)
    database.close()


def complete(database: Database, job_id: str, fence: int) -> None:
    """Complete an attempt."""
    attempt = Principal("attempt", job_id=job_id, fence=fence, scopes=("read",))
    request = CompleteRequest(write_id=f"write-{job_id}-{fence}")
    database.write(attempt, completion.complete, job_id, fence, request)
