"""A process that writes to a database, for tests that kill it: `store_writer.py URL USER_ID USER_NAME WORK FOLDER`.

WORK is `send`, `send-large`, `publish`, `purge`, `complete JOB FENCE` (complete an attempt), `commit-deferred` (commit
the outputs of jobs with many outputs), or anything else to collect garbage.
"""

import sys
from pathlib import Path
from typing import Any

from marey_schemas.kinds import Kind
from marey_schemas.purges import PurgeRequest
from marey_schemas.queue.worker_protocol import CompleteRequest
from marey_server.access.principal import Principal
from marey_server.store import blobs, garbage, items, projects, purging
from marey_server.store.blob_backings import DirectoryBlobs
from marey_server.store.database.connections import Database
from marey_server.store.folder_roles.rights import rights_of_caller
from marey_server.store.jobs import completion
from marey_server.store.jobs.finishing import commit_deferred
from marey_server.store.transaction import Transaction

LARGE_FILES = [bytes([number]) * 2**20 for number in range(12)]
"""Files that together make the write-ahead log of SQLite long."""
FILES = [f"file {number}".encode() * 1000 for number in range(3)]


def publish(tx: Transaction) -> Any:
    """Publish three small items of the kind `study` that refer to the blobs of `FILES`."""
    row = projects.require(tx, "lab")
    trees = [{"n": n, "blob": blobs.digest_of(data)} for n, data in enumerate(FILES)]
    drafts = [items.Draft(f"d{n}", Kind.STUDY, f"study {n}", {"study": tree}, "a/b") for n, tree in enumerate(trees)]
    return items.publish(tx, row, drafts, author_id=tx.principal.user_id, rights=rights_of_caller(tx, row))


def purge(database: Database, who: Principal) -> None:
    """Purge all deleted studies of `lab`, each in a transaction of its own."""
    deleted = database.read(who, items.list_items, "lab", Kind.STUDY, items.ItemFilters(deleted=True))
    for one in deleted.items:
        request = PurgeRequest(item=one.id)
        prepared = database.read(who, purging.prepare_purge, "lab", request)
        database.write(who, purging.record_purge, "lab", request, prepared)


def main(url: str, user_id: str, user_name: str, work: str, folder: str) -> None:
    """Do `work` as this user. `send-large` prints the digest of each file after it is stored.

    Blobs are stored in `folder`, or in the database if `folder` is empty.
    """
    database = Database(url, blobs=DirectoryBlobs(Path(folder)) if folder else None)
    who = Principal("user", user_id, user_name, scopes=("read", "write"))
    if work == "send":
        for data in FILES:
            database.write(who, blobs.put_blob, data)
    elif work == "send-large":
        for data in LARGE_FILES:
            print(database.write(who, blobs.put_blob, data), flush=True)
    elif work == "publish":
        database.write(who, publish)
    elif work == "purge":
        purge(database, who)
    elif work.startswith("complete "):
        _, job_id, fence = work.split()
        attempt = Principal("attempt", job_id=job_id, fence=int(fence), scopes=("read",))
        request = CompleteRequest(write_id=f"write-{job_id}-{fence}")
        database.write(attempt, completion.complete, job_id, int(fence), request)
    elif work == "commit-deferred":
        commit_deferred(database)
    else:
        garbage.collect_garbage(database, grace_us=-1)
    database.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
