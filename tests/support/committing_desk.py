"""Users of the dataset `gaits`, and jobs that commit their outputs to the branches of this dataset."""

from __future__ import annotations

from typing import Any

import pytest
from tests.support.queue_desk import Desk, document
from tests.support.store_fixtures import WRITE, requiring

from marey_schemas.access import Role
from marey_schemas.datasets.commits import Commit, CommitCreate, Entry, PutEntry
from marey_schemas.datasets.naming import MAIN, DatasetCreate
from marey_schemas.kinds import Kind
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.jobs import Job, JobCreate
from marey_schemas.queue.worker_protocol import Lease
from marey_server.access.principal import Principal
from marey_server.access.roles import RequiredRole
from marey_server.store import datasets
from marey_server.store.items.drafts import Draft
from marey_server.store.jobs import submission

JOBS = RequiredRole(Role.CONTRIBUTOR, "jobs")


class CommittingDesk:
    """Users who submit jobs, run jobs and commit; a short method for each of these steps."""

    def __init__(self, desk: Desk, name: str = "gaits", collection: str | None = None) -> None:
        self.desk = desk
        self.name = name
        self.write(datasets.create_dataset, "lab", DatasetCreate(name=name, collection=collection))

    def read(self, function: Any, *args: Any, **kwargs: Any) -> Any:
        """Run a function that reads the database, as the user of the desk; return its result."""
        return self.desk.database.read(self.desk.user, requiring(WRITE, function), *args, **kwargs)

    def write(self, function: Any, *args: Any, who: Principal | None = None, **kwargs: Any) -> Any:
        """Run a function that writes to the database, as the user of the desk or as `who`; return its result."""
        return self.desk.database.write(who or self.desk.user, requiring(WRITE, function), *args, **kwargs)

    def submit(self, kind: str = "sum", to: str | None = None, **fields: Any) -> str:
        """Submit a job that commits to the branch `to`, by default `main`; return its id.

        Fields of the request for the commit are given with the prefix `commit_`.
        """
        chosen = {name.removeprefix("commit_"): fields.pop(name) for name in list(fields) if name.startswith("commit_")}
        request = JobCreate(kind=kind, commit=OutputsCommit.at(to or self.name, **chosen), **fields)
        (made,) = self.desk.database.write(self.desk.user, requiring(JOBS, submission.submit), "lab", (request,))
        job_id: str = made.id
        return job_id

    def work(self, *names: str, **fields: Any) -> Lease:
        """Claim a job, and complete it with outputs of these names; return its lease."""
        lease = self.desk.claim()
        if names:
            self.desk.stage(lease, *names, **fields)
        self.desk.complete(lease)
        return lease

    def job(self, job_id: str) -> Job:
        """Return the present state of the job with this id."""
        return self.desk.job(job_id)

    def head(self, branch: str = MAIN) -> str | None:
        """Return the digest of the newest commit of a branch, or None if the branch has no commits."""
        found: str | None = self.read(datasets.read_ref, "lab", self.name, branch).commit
        return found

    def branches(self) -> set[str]:
        """Return the names of all branches and tags."""
        page = self.read(datasets.list_refs, "lab", self.name, cursor=None, limit=1000)
        return {one.name for one in page.items}

    def commit(self, version: str = MAIN) -> Commit:
        """Return the commit that a version names."""
        found: Commit = self.read(datasets.read_commit, "lab", self.name, version)
        return found

    def log(self, version: str = MAIN) -> list[Commit]:
        """Return a commit and the commits before it, newest first."""
        page = self.read(datasets.list_commits, "lab", self.name, version, path="", cursor=None, limit=1000)
        return list(page.items)

    def listed(self, version: str = MAIN) -> list[Entry]:
        """Return the entries of a version, by path."""
        page = self.read(datasets.list_entries, "lab", self.name, version, path="", cursor=None, limit=1000)
        return list(page.items)

    def entries(self, version: str = MAIN) -> dict[str, str | None]:
        """Return the id of the item of each entry of a version, by path; None for an entry without item."""
        return {one.path: one.item for one in self.listed(version)}

    def put(self, path: str, *, number: int, branch: str = MAIN) -> str:
        """Commit a new item at a path as a user, not as a job; return its id."""
        (made,) = self.desk.publish(
            Draft("d", Kind.CHARACTER, f"own{number}", {"character": document(number=number)}, "own")
        )
        self.change(PutEntry(path=path, item=made.item), branch=branch)
        return made.item

    def change(self, *changes: Any, branch: str = MAIN) -> Commit:
        """Commit changes to a branch as a user, not as a job; return the commit."""
        request = CommitCreate(branch=branch, message="by hand", changes=changes)
        prepared = self.read(datasets.prepare_commit, "lab", self.name, request)
        made: Commit = self.write(datasets.record_commit, "lab", self.name, prepared)
        return made


@pytest.fixture
def gaits(desk: Desk) -> CommittingDesk:
    """A new project with a queue and the dataset `gaits`."""
    return CommittingDesk(desk)
