"""Resources of job kinds, submitted jobs, and their results."""

from __future__ import annotations

import asyncio
import re

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.items import EventFeed, Page
from marey_schemas.queue.job_kinds import UnknownKindError, find_kind, job_kinds
from marey_schemas.queue.jobs import (
    Attempt,
    Job,
    JobBatch,
    JobCreate,
    JobKind,
    JobList,
    JobOutput,
    JobState,
    TaskResult,
)
from marey_schemas.sizes import MIB
from marey_server.errors import NotFoundProblem
from marey_server.handlers.reports import ReportSender
from marey_server.http.caching import REVALIDATED
from marey_server.http.declarations import Access, Bytes, RequestBody, reads, writes
from marey_server.http.queries import CommaSeparated, CommaSeparatedOf, CountedPageQuery, PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store import events
from marey_server.store.jobs import reading, retrying, submission
from marey_server.store.jobs.logs import MOST_READ_BYTES, LogPage
from marey_server.store.jobs.reading import JobFilters
from marey_server.store.wakeups import job_topic, wakeups

LONGEST_WAIT_S = 30.0
LOOK_AGAIN_S = 15.0
"""Interval in seconds at which a waiting request polls the job, in case the notification of its end is lost."""

MAX_SUBMISSION_BYTES = 32 * MIB
RESULT_TYPES = {
    "document": "application/json", "fitted": "application/json",
}  # fmt: skip
"""Media types of the files in a job's result, by the name of the file in the result; other files have no known type."""
_WAIT = re.compile(r"(?:^|[,;\s])wait=(\d{1,4})(?:$|[,;\s])")


def _all_kinds() -> Page:
    """Return all kinds of jobs; the first time takes 0.2 s, because it generates their JSON schemas."""
    return Page(items=tuple(kind.document() for kind in job_kinds().values()))


class JobKinds(Resource):
    """Kinds of jobs."""

    path = "/job-kinds"
    tag = "Jobs"

    @reads(access=Access.ANYONE, scope=None, answer=JobKind, paged=True)
    async def get(self) -> Reply:
        """List all kinds of jobs, with the inputs and parameters they take."""
        return Reply(await self.compute(_all_kinds))


class JobKindResource(Resource):
    """A kind of job."""

    path = "/job-kinds/{job_kind}"
    tag = "Jobs"

    @reads(access=Access.ANYONE, scope=None, answer=JobKind)
    async def get(self, job_kind: str) -> Reply:
        """Return a kind of job."""
        try:
            return Reply(await self.compute(find_kind(job_kind).document))
        except UnknownKindError as error:
            detail = str(error)
            raise NotFoundProblem(f"{detail[0].upper()}{detail[1:]}.", code="no-kind") from None


class JobsQuery(CountedPageQuery):
    """Query parameters of a list of jobs: filters and order."""

    state: CommaSeparatedOf[JobState] = Field((), description="Return jobs in any of these states.")
    kind: CommaSeparated = Field((), description="Return jobs of any of these kinds.")
    parent: str | None = Field(
        None, max_length=64, description="Return the tasks of this job; absent: jobs that are not tasks."
    )
    author: str | None = Field(None, max_length=64, description="Return jobs that the user with this name submitted.")
    sort: str = Field(
        "-created_at",
        max_length=100,
        description="Sort keys: id, created_at, priority; a leading - sorts in descending order.",
    )

    def filters(self) -> JobFilters:
        """Convert the query parameters to the `JobFilters` by which the store selects jobs."""
        return JobFilters(self.state, self.kind, self.parent, self.author)


class ProjectJobs(Resource):
    """Jobs of a project."""

    path = "/projects/{project}/jobs"
    tag = "Jobs"

    @reads(access=Access.READER, query=JobsQuery, answer=Job, paged=True)
    async def get(self, project: str, query: JobsQuery) -> Rendered:
        """List jobs, newest first."""
        return await self.answer(
            reading.list_jobs,
            project,
            query.filters(),
            sort=query.sort,
            cursor=query.cursor,
            limit=query.limit,
            count=query.count is not None,
        )

    @writes(
        access=Access.CONTRIBUTOR,
        scope="jobs",
        body=RequestBody(JobCreate, max_bytes=MAX_SUBMISSION_BYTES),
        answer=Job,
        status=202,
        idempotency="key",
        headers=("Prefer",),
        in_folders=True,
    )
    async def post(self, project: str, body: JobCreate) -> Rendered | Reply:
        """Submit a job. Inputs are pinned to their newest revisions; a job with many inputs is divided into tasks.

        An input `{"job": id}` stands for outputs of another job: all outputs of the kind that the input takes. The new
        job waits for the other job. With `Prefer: wait=n`, the answer is sent when the new job has ended, at the latest
        after n seconds.
        """
        submitted = await self.answer_with(lambda made: accepted(made[0]), submission.submit, project, (body,))
        wait_s = wait_preferred(self)
        job_id = submitted.headers["Location"].rpartition("/")[2]
        if wait_s == 0:
            return submitted
        return accepted(await wait_for_end(self, job_id, wait_s))


def accepted(job: Job) -> Reply:
    """Return the answer to a submission: the new job, its address, and the time after which to look again."""
    headers = {} if job.state.terminal else {"Retry-After": "1"}
    return Reply(job, location=f"/jobs/{job.id}", headers=headers)


class ProjectJobBatch(Resource):
    """Batch of jobs."""

    path = "/projects/{project}/jobs/batch"
    tag = "Jobs"

    @writes(
        access=Access.CONTRIBUTOR,
        scope="jobs",
        body=RequestBody(JobBatch, max_bytes=MAX_SUBMISSION_BYTES),
        answer=JobList,
        status=202,
        idempotency="key",
        in_folders=True,
    )
    async def post(self, project: str, body: JobBatch) -> Rendered:
        """Submit many jobs; if one of them is not valid, no job is submitted."""
        return await self.answer_with(
            lambda made: Reply(JobList(jobs=tuple(made))), submission.submit, project, body.jobs
        )


class JobResource(Resource):
    """A job."""

    path = "/jobs/{job}"
    tag = "Jobs"

    @reads(access=Access.READER, answer=Job, headers=("Prefer",))
    async def get(self, job: str) -> Rendered | Reply:
        """Return the state of a job; with `Prefer: wait=n`, wait at most n seconds for its end."""
        wait_s = wait_preferred(self)
        if wait_s == 0:
            return await self.answer(reading.read_job, job)
        return Reply(await wait_for_end(self, job, wait_s))


def wait_preferred(resource: Resource) -> float:
    """Return how many seconds the caller prefers to wait (RFC 7240), at most the limit of this server."""
    found = _WAIT.search(resource.request.headers.get("Prefer", ""))
    return min(float(found[1]), LONGEST_WAIT_S) if found else 0.0


async def wait_for_end(resource: Resource, job_id: str, wait_s: float) -> Job:
    """Wait until a job has ended, and return it.

    The wait also ends after `wait_s` seconds, if the client has disconnected, or if the server is stopping.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + wait_s
    with wakeups.listen([job_topic(job_id)]) as listener:
        while True:
            job = await resource.look_up(reading.read_job, job_id)
            left_s = deadline - loop.time()
            if job.state.terminal or left_s <= 0 or not resource.is_awaited():
                return job
            await listener.wait(min(left_s, LOOK_AGAIN_S))


class JobAttempts(Resource):
    """Attempts of a job."""

    path = "/jobs/{job}/attempts"
    tag = "Jobs"

    @reads(access=Access.READER, answer=Attempt, paged=True)
    async def get(self, job: str) -> Rendered:
        """List the attempts of a job: worker, times, and outcome."""
        return await self.answer(reading.list_attempts, job)


class JobOutputs(Resource):
    """Outputs of a job."""

    path = "/jobs/{job}/outputs"
    tag = "Jobs"

    @reads(access=Access.READER, query=PageQuery, answer=JobOutput, paged=True)
    async def get(self, job: str, query: PageQuery) -> Rendered:
        """List the revisions created by a job or its tasks.

        If the job has tasks, a page contains the outputs of `limit` tasks.
        """
        return await self.answer(reading.list_outputs, job, query.cursor, query.limit)


class JobResults(Resource):
    """Results of the tasks of a job."""

    path = "/jobs/{job}/results"
    tag = "Jobs"

    @reads(access=Access.READER, query=PageQuery, answer=TaskResult, paged=True, attempts=True)
    async def get(self, job: str, query: PageQuery) -> Rendered:
        """Return the results of a job's tasks in order. Blobs used in the results are kept until the job ends."""
        return await self.answer(reading.list_results, job, query.cursor, query.limit)


class JobFile(ReportSender):
    """File of the result of a job."""

    path = "/projects/{project}/jobs/{job}/files/{file}"
    tag = "Jobs"

    @reads(
        access=Access.READER,
        answer=Bytes,
        answer_types=("application/json", "text/html", "application/octet-stream"),
        etag=True,
        also=((206, None), (416, None)),
        headers=("Range", "If-Range"),
    )
    async def get(self, project: str, job: str, file: str) -> Reply | Rendered | None:
        """Return a file of a job's result: its `report` as HTML, its `document` as JSON, or another member."""
        found, made = await self.look_up(reading.read_result_file, project, job, file)
        if file == "report":
            return await self.send_report(found, self.origin(project, made.author, made.finished_at or made.created_at))
        return await self.send_file(found, RESULT_TYPES.get(file, "application/octet-stream"), REVALIDATED, "sandbox")


class JobEventsQuery(Request):
    """Query parameters for reading events: the position in the feed, and the number of events."""

    after: int = Field(0, ge=0, le=2**62, description="Number of the last event received; 0: from the beginning.")
    limit: int = Field(100, ge=1, le=events.MAX_EVENTS, description="Greatest number of events in a page.")


class JobEvents(Resource):
    """Events of a job."""

    path = "/jobs/{job}/events"
    tag = "Jobs"

    @reads(access=Access.READER, query=JobEventsQuery, answer=EventFeed, public=False)
    async def get(self, job: str, query: JobEventsQuery) -> Rendered:
        """Return the events of a job in the order of their commits.

        A page may have fewer events than `limit`, because the bodies of its events have at most 4 MiB together; `more`
        says whether further events exist.
        """
        await self.services.number_events()
        return await self.answer(reading.list_job_events, job, query.after, query.limit)


class JobLogQuery(Request):
    """Query parameters of a page of a log."""

    offset: int = Field(0, ge=0, le=2**53, description="Offset of the first byte to return.")
    limit: int = Field(MOST_READ_BYTES, ge=1, le=MOST_READ_BYTES, description="Greatest number of bytes to return.")


class JobLog(Resource):
    """Log of a job."""

    path = "/jobs/{job}/log"
    tag = "Jobs"

    @reads(access=Access.READER, query=JobLogQuery, answer=Bytes, answer_types=("text/plain",), public=False)
    async def get(self, job: str, query: JobLogQuery) -> Rendered:
        """Return the logs of a job's attempts, joined in order, from an offset in bytes.

        The header `Log-Offset` is the offset of the next page; `Log-Sealed: true` means that there is no next page.
        """
        return await self.answer_with(_log_reply, reading.read_job_log, job, query.offset, query.limit)


def _log_reply(page: LogPage) -> Reply:
    headers = {"Log-Offset": str(page.offset), "Log-Sealed": str(page.sealed).lower()}
    return Reply(page.data, media_type="text/plain; charset=utf-8", headers=headers)


class JobCancellation(Resource):
    """Cancellation of a job."""

    path = "/jobs/{job}/cancel"
    tag = "Jobs"

    @writes(access=Access.CONTRIBUTOR, scope="jobs", answer=Job, in_folders=True)
    async def post(self, job: str) -> Rendered:
        """Cancel a job and its tasks: at once if no worker runs it, otherwise as soon as the worker has stopped."""
        return await self.answer(reading.cancel_job, job, self.services.queue_policy)


class RetryQuery(Request):
    """Query parameters for retrying a job."""

    dependants: bool = Field(True, description="Also retry jobs that ended only because this job did not succeed.")


class JobRetry(Resource):
    """Retry of a job."""

    path = "/jobs/{job}/retry"
    tag = "Jobs"

    @writes(
        access=Access.CONTRIBUTOR,
        scope="jobs",
        answer=Job,
        status=202,
        idempotency="key",
        in_folders=True,
        query=RetryQuery,
    )
    async def post(self, job: str, query: RetryQuery) -> Rendered:
        """Submit a failed or cancelled job again with the same inputs; the answer is the new job.

        Unsuccessful jobs on which the job depends are retried, too, and by default so are jobs that ended only because
        this job did not succeed. So the rest of a pipeline continues.
        """
        return await self.answer_with(accepted, retrying.retry_job, job, dependants=query.dependants)


RESOURCES: tuple[type[Resource], ...] = (
    JobKinds,
    JobKindResource,
    ProjectJobs,
    ProjectJobBatch,
    JobResource,
    JobAttempts,
    JobOutputs,
    JobResults,
    JobFile,
    JobEvents,
    JobLog,
    JobCancellation,
    JobRetry,
)
