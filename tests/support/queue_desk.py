"""Project with a queue, and short functions for submitters and workers."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.kept_rows import made_once
from tests.support.store_fixtures import ALL_RIGHTS

from marey_schemas.access import ProjectCreate, ProjectQuotaChange, UserCreate
from marey_schemas.base import Request
from marey_schemas.kinds import Kind
from marey_schemas.queue import job_kinds
from marey_schemas.queue.facets import ItemFacets
from marey_schemas.queue.jobs import InputSpec, Job, JobCreate, Progress
from marey_schemas.queue.kind_declaration import KindDeclaration
from marey_schemas.queue.worker_protocol import (
    ClaimRequest,
    CompleteAnswer,
    CompleteRequest,
    FailAnswer,
    FailRequest,
    Heartbeat,
    HeartbeatAnswer,
    Lease,
    StagedOutput,
)
from marey_server.access.principal import SYSTEM, Principal
from marey_server.store import projects, users
from marey_server.store.credentials import tokens
from marey_server.store.database.connections import Database
from marey_server.store.items.drafts import Draft, Published
from marey_server.store.items.publishing import publish
from marey_server.store.jobs import completion, queue, reading, staging, submission
from marey_server.store.jobs.policy import QueuePolicy
from marey_server.store.jobs.reaper import reap_page
from marey_server.store.transaction import Transaction


class Params(Request):
    """Parameters of the kinds of jobs that the tests of the queue declare."""

    number: int = 0


ERRAND = KindDeclaration(
    name="errand",
    description="Runs each time, and makes nothing.",
    params=Params,
    implementation="tests:errand",
    version=1,
    outputs={},
    deterministic=False,
)
SUM = KindDeclaration(
    name="sum",
    description="Computes equal results from equal inputs.",
    params=Params,
    implementation="tests:sum",
    version=1,
    outputs={"sums": Kind.CHARACTER},
)
SQUARE = KindDeclaration(
    name="square",
    description="Creates one study from each study of the input.",
    params=Params,
    implementation="tests:square",
    version=1,
    inputs={
        "things": InputSpec(kind=Kind.CHARACTER, many=True),
        "ruler": InputSpec(kind=Kind.CHARACTER, required=False),
    },
    outputs={"squares": Kind.CHARACTER},
    fan_out="things",
    batch_size=2,
    refusing_all_fails=True,
)
SURVEY = KindDeclaration(
    name="survey",
    description="Divides the work into the number of tasks that a parameter gives, and gathers their results.",
    params=Params,
    implementation="tests:survey",
    version=1,
    inputs={"things": InputSpec(kind=Kind.CHARACTER, many=True)},
    outputs={"survey": Kind.CHARACTER},
    task_count=lambda params: params.number,
    gathering="tests:gather",
)
MEASURE = KindDeclaration(
    name="measure",
    description="Measures its inputs, and publishes the numbers as facets.",
    params=Params,
    implementation="tests:measure",
    version=1,
    inputs={"things": InputSpec(kind=Kind.CHARACTER, many=True)},
    outputs={"measurement": Kind.CHARACTER},
    facets={"usage": "Use of the thing.", "used_frames": "Frames of the thing that are used."},
)
RIG = KindDeclaration(
    name="rig",
    description="Makes a skeleton with several parts.",
    params=Params,
    implementation="tests:rig",
    version=1,
    outputs={"rigs": Kind.SKELETON},
)
LABEL = KindDeclaration(
    name="label",
    description="Makes annotations.",
    params=Params,
    implementation="tests:label",
    version=1,
    outputs={"labels": Kind.ANNOTATION},
)
KINDS = {kind.name: kind for kind in (*job_kinds.BUILT_IN, ERRAND, SUM, SQUARE, SURVEY, MEASURE, RIG, LABEL)}


@dataclass
class Desk:
    """User who submits jobs to the project `lab` and also runs these jobs."""

    database: Database
    clock: AdjustableClock
    policy: QueuePolicy = field(default_factory=lambda: QueuePolicy(random_unit=lambda: 0.0))
    project: str = "lab"
    user: Principal = SYSTEM
    _write_ids: Iterator[int] = field(default_factory=itertools.count)

    def open(self) -> None:
        """Create the user `ann` and her project."""
        made = self.database.write(SYSTEM, users.create_user, UserCreate(name="ann"))
        scopes = ("read", "write", "jobs", "work")
        self.user = Principal("user", made.id, "ann", scopes=scopes, token_id="token_ann", token_key=b"of ann")
        self.database.write(self.user, projects.create_project, ProjectCreate(name=self.project))

    def replaced_token(self) -> Principal:
        """Return a principal of the user with another token, as after a rotation."""
        return replace(self.user, token_id="token_new", token_key=b"another secret")

    # -- submitting ----------------------------------------------------------------------------------------------------

    def submit(self, kind: str = "errand", **fields: Any) -> str:
        """Submit one job; return its id."""
        return self.submit_many(JobCreate(kind=kind, **fields))[0]

    def submit_many(self, *requests: JobCreate) -> list[str]:
        """Submit jobs in one request, and return their ids."""
        made = self.database.write(self.user, submission.submit, self.project, requests)
        return [job.id for job in made]

    def job(self, job_id: str) -> Job:
        """Return the present state of a job."""
        return self.database.read(self.user, reading.read_job, job_id)

    def state(self, job_id: str) -> str:
        """Return the present state of a job."""
        return self.job(job_id).state.value

    def cancel(self, job_id: str) -> Job:
        """Cancel a job, and return it."""
        return self.database.write(self.user, reading.cancel_job, job_id, self.policy)

    def outputs(self, job_id: str) -> list[Any]:
        """Return the results that a job published."""
        return list(self.database.read(self.user, reading.list_outputs, job_id).items)

    def things(self, count: int, collection: str = "raw") -> list[str]:
        """Create `count` items for use as inputs of jobs; return their ids."""
        drafts = [
            Draft(f"thing{n}", Kind.CHARACTER, f"thing{n}", {"character": document(number=n)}, collection)
            for n in range(count)
        ]
        return [one.item for one in self.publish(*drafts)]

    def publish(self, *drafts: Draft) -> list[Published]:
        """Publish drafts as a user, not as a job."""

        def act(tx: Transaction) -> list[Published]:
            return publish(
                tx, projects.require(tx, self.project), drafts, author_id=self.user.user_id, rights=ALL_RIGHTS
            )

        return self.database.write(self.user, act)

    def limit_running(self, most: int | None) -> None:
        """Set the limit of running jobs of the project, as an administrator does."""
        change = ProjectQuotaChange(running_jobs=most)
        self.database.write(SYSTEM, projects.change_quotas, self.project, change)

    # -- working -------------------------------------------------------------------------------------------------------

    def claim_many(self, count: int = 256, kinds: tuple[str, ...] = tuple(KINDS), **fields: Any) -> list[Lease]:
        """Claim up to `count` jobs, as the worker `w` or the given one, and return their leases."""
        request = ClaimRequest(**dict[str, Any](worker="w", kinds=kinds, max=count) | fields)
        return self.database.write(self.user, queue.claim, request, self.policy)

    def claim(self, **fields: Any) -> Lease:
        """Claim one job, and return its lease; fail if there is none."""
        (lease,) = self.claim_many(1, **fields)
        return lease

    def attempt(self, lease: Lease) -> Principal:
        """Return the principal that the server finds now for the token of an attempt."""
        return self.database.read(SYSTEM, tokens.resolve_token, lease.attempt_token)

    def heartbeat(self, lease: Lease, progress: Progress | None = None) -> HeartbeatAnswer:
        """Send a heartbeat, and return the answer."""
        return self.database.write(
            _as_attempt(lease), queue.heartbeat, lease.job, lease.fence, Heartbeat(progress=progress), self.policy
        )

    def stage(self, lease: Lease, *names: str, **fields: Any) -> int:
        """Upload a small document under each name; return how many outputs the attempt has uploaded so far."""
        return self.stage_outputs(lease, *(output(name, **fields) for name in names))

    def stage_outputs(self, lease: Lease, *staged: StagedOutput, facets: Sequence[ItemFacets] = ()) -> int:
        """Stage outputs and facets; return the number of outputs that the attempt has staged."""
        outputs = [staging.prepare_output(one) for one in staged]
        return self.database.write(self._attempt_of(lease), staging.stage, lease.job, lease.fence, outputs, facets)

    def complete(self, lease: Lease, *, write_id: str | None = None, **fields: Any) -> CompleteAnswer:
        """Complete the attempt, and return the answer."""
        request = CompleteRequest(write_id=write_id or self.write_id(), **fields)
        return self.database.write(self._attempt_of(lease), completion.complete, lease.job, lease.fence, request)

    def fail(self, lease: Lease, code: str = "broken", *, write_id: str | None = None, **fields: Any) -> FailAnswer:
        """End the attempt without success, and return the answer."""
        request = FailRequest(write_id=write_id or self.write_id(), code=code, **fields)
        return self.database.write(
            self._attempt_of(lease), completion.fail, lease.job, lease.fence, request, self.policy
        )

    def reap(self) -> int:
        """Return jobs with expired leases to the queue or end them; return the number of these jobs."""
        return self.database.write(SYSTEM, reap_page, self.policy).taken

    def write_id(self) -> str:
        """Return a new write id."""
        return f"write-{next(self._write_ids):06}"

    def _attempt_of(self, lease: Lease) -> Principal:
        project_id = self.database.read(self.user, projects.require, self.project).id
        return Principal(
            "attempt",
            self.user.user_id,
            "ann",
            scopes=("read",),
            job_id=lease.job,
            fence=lease.fence,
            project_id=project_id,
        )


def _as_attempt(lease: Lease) -> Principal:
    return Principal("attempt", job_id=lease.job, fence=lease.fence, scopes=("read",))


def document(**facts: Any) -> dict[str, Any]:
    """Return a small document with these members; its schema allows any member."""
    return {"schema": "marey/document@1", **facts}


def output(
    name: str, *, collection: str = "", facts: Mapping[str, Any] = MappingProxyType({}), **fields: Any
) -> StagedOutput:
    """Return a small document as an output that can be staged."""
    parts = {"character": document(name=name, **facts)}
    return StagedOutput(name=name, kind=Kind.CHARACTER, item_name=name, collection=collection, parts=parts, **fields)


def opened_desk(database: Database) -> Desk:
    """Return a desk whose user and project are new; the clock of the database must be an `AdjustableClock`."""
    assert isinstance(database.clock, AdjustableClock)
    desk = Desk(database, database.clock)
    desk.open()
    return desk


@pytest.fixture
def test_kinds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Declare the job kinds of this module in addition to the built-in ones."""
    monkeypatch.setattr(job_kinds, "job_kinds", lambda: KINDS)


@pytest.fixture
def desk(database: Database, test_kinds: None) -> Desk:
    """A new project with a queue, on SQLite and on Postgres."""
    return made_once(opened_desk, database)
