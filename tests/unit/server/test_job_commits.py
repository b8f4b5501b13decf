"""Jobs that commit their outputs: one transaction publishes the outputs and moves the branch, or neither."""

from typing import Any

import pytest
from tests.support.queue_desk import Desk, document
from tests.support.store_fixtures import WRITE, requiring

from marey_schemas.datasets.commits import Commit, CommitCreate, PutEntry, RemoveEntry
from marey_schemas.datasets.naming import MAIN, DatasetCreate
from marey_schemas.kinds import Kind
from marey_schemas.queue.commits import OutputsCommit
from marey_schemas.queue.jobs import Job
from marey_schemas.queue.worker_protocol import Lease
from marey_server.store import datasets
from marey_server.store.items.drafts import Draft


class CommittingDesk:
    """Desk with the dataset `gaits`, to which jobs commit."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.write(datasets.create_dataset, "lab", DatasetCreate(name="gaits"))

    def read(self, function: Any, *args: Any, **kwargs: Any) -> Any:
        return self.desk.database.read(self.desk.user, requiring(WRITE, function), *args, **kwargs)

    def write(self, function: Any, *args: Any, **kwargs: Any) -> Any:
        return self.desk.database.write(self.desk.user, requiring(WRITE, function), *args, **kwargs)

    def submit(
        self, kind: str = "sum", to: str = "gaits", *, commit: dict[str, Any] | None = None, **fields: Any
    ) -> str:
        return self.desk.submit(kind, commit=OutputsCommit.at(to, **(commit or {})), **fields)

    def work(self, *names: str, **fields: Any) -> Lease:
        """Claim a job, and complete it with outputs of these names."""
        lease = self.desk.claim()
        if names:
            self.desk.stage(lease, *names, **fields)
        self.desk.complete(lease)
        return lease

    def job(self, job_id: str) -> Job:
        return self.desk.job(job_id)

    def head(self, branch: str = MAIN) -> str | None:
        found: str | None = self.read(datasets.read_ref, "lab", "gaits", branch).commit
        return found

    def commit(self, version: str = MAIN) -> Commit:
        found: Commit = self.read(datasets.read_commit, "lab", "gaits", version)
        return found

    def entries(self, version: str = MAIN) -> dict[str, str | None]:
        """The items of a version by path."""
        page = self.read(datasets.list_entries, "lab", "gaits", version, path="", cursor=None, limit=1000)
        return {one.path: one.item for one in page.items}

    def put(self, path: str, *, number: int, branch: str = MAIN) -> str:
        """Commit a new item at a path as a person; return its id."""
        (made,) = self.desk.publish(Draft("d", Kind.STUDY, f"own{number}", {"study": document(number=number)}, "own"))
        self.change(PutEntry(path=path, item=made.item), branch=branch)
        return made.item

    def change(self, *changes: Any, branch: str = MAIN) -> Commit:
        request = CommitCreate(branch=branch, message="by hand", changes=changes)
        prepared = self.read(datasets.prepare_commit, "lab", "gaits", request)
        made: Commit = self.write(datasets.record_commit, "lab", "gaits", prepared)
        return made


@pytest.fixture
def gaits(desk: Desk) -> CommittingDesk:
    return CommittingDesk(desk)


def test_a_job_commits_its_outputs_when_it_completes(gaits: CommittingDesk) -> None:
    made = gaits.submit(into="made")
    assert gaits.head() is None
    assert gaits.job(made).commit is not None
    gaits.work("a", "b")
    found = gaits.job(made)
    (first, second) = gaits.desk.outputs(made)
    assert gaits.entries() == {"made/a": first.item, "made/b": second.item}
    commit = gaits.commit()
    assert found.commit is not None
    assert (found.state, found.commit.digest, found.publish_conflict) == ("succeeded", commit.digest, None)
    assert (commit.job, commit.author, commit.message, commit.parents) == (made, "ann", f"Results of sum {made}", ())
    assert [first.entry, second.entry] == ["made/a", "made/b"]


def test_others_commits_to_other_paths_stay(gaits: CommittingDesk) -> None:
    gaits.put("mine", number=1)
    made = gaits.submit(into="made")
    theirs = gaits.put("later", number=2)
    before = gaits.head()
    gaits.work("a")
    (output,) = gaits.desk.outputs(made)
    assert gaits.commit().parents == (before,)
    assert gaits.entries().keys() == {"mine", "later", "made/a"}
    assert gaits.entries()["later"] == theirs
    assert gaits.entries()["made/a"] == output.item


def test_a_path_that_somebody_changed_meanwhile_is_not_overwritten(gaits: CommittingDesk) -> None:
    gaits.put("made/a", number=1)
    base = gaits.head()
    made = gaits.submit(into="made")
    theirs = gaits.put("made/a", number=2)
    head = gaits.head()
    gaits.work("a", "b")
    found = gaits.job(made)
    conflict = found.publish_conflict
    assert found.state == "succeeded"
    assert conflict is not None
    assert (conflict.code, conflict.branch, conflict.paths, conflict.count) == ("paths-changed", made, ("made/a",), 1)
    assert gaits.head() == head
    assert gaits.entries()["made/a"] == theirs
    assert gaits.commit(made).parents == (base,)
    assert gaits.entries(made) == {f"made/{one.name}": one.item for one in gaits.desk.outputs(made)}
    assert found.commit is not None
    assert found.commit.digest == gaits.head(made)


def test_an_entry_that_was_removed_meanwhile_is_a_conflict(gaits: CommittingDesk) -> None:
    gaits.put("made/a", number=1)
    made = gaits.submit(into="made")
    gaits.change(RemoveEntry(path="made/a", kind=Kind.STUDY))
    gaits.work("a")
    conflict = gaits.job(made).publish_conflict
    assert conflict is not None
    assert gaits.entries() == {}
    assert gaits.entries(made).keys() == {"made/a"}
