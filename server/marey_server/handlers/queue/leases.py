"""Resources for workers: claims, heartbeats, logs, results and failures."""

from __future__ import annotations

import asyncio
from functools import partial

from marey_schemas.items import Page
from marey_schemas.queue.worker_protocol import (
    BatchCompleteAnswer,
    BatchCompleteRequest,
    ClaimRequest,
    CompleteAnswer,
    CompleteRequest,
    FailAnswer,
    FailRequest,
    Heartbeat,
    HeartbeatAnswer,
    LeaseList,
    LogAnswer,
    StageAnswer,
    StageRequest,
)
from marey_schemas.queue.workers import Worker
from marey_schemas.sizes import KIB, MIB
from marey_server.errors import BadRequestProblem
from marey_server.http.declarations import Access, Bytes, RequestBody, reads, writes
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store.jobs import completion, logs, queue, staging
from marey_server.store.jobs.claiming.rights import state_of_named
from marey_server.store.jobs.staging import PreparedOutput
from marey_server.store.monitoring.workers import claim_and_remember, list_workers
from marey_server.store.wakeups import wakeups, work_topic

LOOK_FOR_WORK_S = 15.0
"""Interval in seconds at which a waiting claim polls the queue, in case the notification of a new job is lost."""

MAX_STAGED_BYTES = 256 * MIB
MAX_LOG_BYTES = MIB


class Leases(Resource):
    """Leases of jobs."""

    path = "/leases"
    tag = "Work"

    @writes(access=Access.WORKER, scope="work", body=ClaimRequest, answer=LeaseList, reserved=True)
    async def post(self, body: ClaimRequest) -> Reply:
        """Claim jobs; if no job is available, wait up to `wait_s` seconds. A lease that is not renewed expires."""
        services = self.services
        loop = asyncio.get_running_loop()
        deadline = loop.time() + body.wait_s
        with wakeups.listen([work_topic(kind) for kind in body.kinds]) as listener:
            while True:
                leases = await self.change(
                    claim_and_remember, body, services.worker_memory, services.start_grace, services.queue_policy
                )
                left_s = deadline - loop.time()
                self.uneventful = not leases
                state = await self.look_up(state_of_named, body) if body.job is not None and not leases else None
                if leases or left_s <= 0 or (state is not None and state.terminal):
                    return Reply(LeaseList(leases=tuple(leases), state=state))
                await listener.wait(min(left_s, LOOK_FOR_WORK_S))
                if not self.is_awaited():  # claim nothing for a caller that has gone
                    return Reply(LeaseList())


class Workers(Resource):
    """Workers that this server knows."""

    path = "/workers"
    tag = "Work"

    @reads(access=Access.ADMINISTRATOR, scope="admin", answer=Worker, paged=True)
    async def get(self) -> Rendered:
        """List the workers, in one page.

        The list contains all workers that run jobs. It also contains the workers that sent a claim to this server
        process in the last 24 hours; claims from before the last start of the process do not count. Idle workers that
        send their claims to another process of the server are missing.
        """
        heard, policy = self.services.worker_memory.heard(), self.services.queue_policy
        return await self.answer_with(lambda workers: Reply(Page(items=workers)), list_workers, heard, policy)


class Completions(Resource):
    """Completions of many jobs."""

    path = "/leases/completions"
    tag = "Work"

    @writes(
        access=Access.WORKER,
        scope="work",
        body=RequestBody(BatchCompleteRequest, max_bytes=16 * MIB),
        answer=BatchCompleteAnswer,
        reserved=True,
    )
    async def post(self, body: BatchCompleteRequest) -> Rendered:
        """Complete many claimed jobs in one transaction; each job is accepted or refused separately."""
        return await self.answer_with(
            lambda results: Reply(BatchCompleteAnswer(results=tuple(results))),
            completion.complete_many,
            body.completions,
        )


class AttemptHeartbeat(Resource):
    """Heartbeat of an attempt."""

    path = "/jobs/{job}/attempts/{fence:int}/heartbeat"
    tag = "Work"

    @writes(
        access=Access.ATTEMPT,
        scope=None,
        body=RequestBody(Heartbeat, max_bytes=64 * KIB),
        answer=HeartbeatAnswer,
        reserved=True,
    )
    async def post(self, job: str, fence: int, body: Heartbeat) -> Rendered:
        """Renew the lease; the answer says whether the worker must stop."""
        return await self.answer(queue.heartbeat, job, fence, body, self.services.queue_policy)


class AttemptLog(Resource):
    """Log of an attempt."""

    path = "/jobs/{job}/attempts/{fence:int}/log"
    tag = "Work"

    @writes(
        access=Access.ATTEMPT,
        scope=None,
        body=RequestBody(Bytes, max_bytes=MAX_LOG_BYTES, required=False),
        answer=LogAnswer,
        headers=("Upload-Offset",),
    )
    async def post(self, job: str, fence: int, body: bytes | None) -> Rendered:
        """Append to the attempt's log at the offset in the header `Upload-Offset`.

        If this offset is not the end of the stored log, the answer is 409 with the right offset in `context.offset`.
        """
        text = self.request.headers.get("Upload-Offset", "")
        if not (text.isascii() and text.isdigit() and len(text) <= 15):
            raise BadRequestProblem(
                "The header Upload-Offset must be the number of bytes that the stored log already has.",
                code="bad-upload-offset",
            )
        policy = self.services.queue_policy
        return await self.answer(logs.append_log, job, fence, int(text), body or b"", policy)


class AttemptOutputs(Resource):
    """Outputs of an attempt."""

    path = "/jobs/{job}/attempts/{fence:int}/outputs"
    tag = "Work"

    @writes(
        access=Access.ATTEMPT,
        scope=None,
        body=RequestBody(StageRequest, max_bytes=MAX_STAGED_BYTES, results=True),
        answer=StageAnswer,
    )
    async def post(self, job: str, fence: int, body: StageRequest) -> Rendered:
        """Upload outputs, which become visible when the attempt completes.

        An output replaces an earlier output of the same name.
        """
        prepared = await self.compute(partial(_prepare, body))
        return await self.answer_with(
            lambda staged: Reply(StageAnswer(staged=staged)), staging.stage, job, fence, prepared, body.facets
        )


def _prepare(request: StageRequest) -> list[PreparedOutput]:
    return [staging.prepare_output(output) for output in request.outputs]


class AttemptCompletion(Resource):
    """Successful end of an attempt."""

    path = "/jobs/{job}/attempts/{fence:int}/complete"
    tag = "Work"

    @writes(
        access=Access.ATTEMPT,
        scope=None,
        body=RequestBody(CompleteRequest, max_bytes=16 * MIB),
        answer=CompleteAnswer,
        reserved=True,
        replays=True,
    )
    async def post(self, job: str, fence: int, body: CompleteRequest) -> Rendered:
        """Publish the staged outputs and end the job; a request with the same `write_id` gets the same answer."""
        return await self.answer(completion.complete, job, fence, body)


class AttemptFailure(Resource):
    """Unsuccessful end of an attempt."""

    path = "/jobs/{job}/attempts/{fence:int}/fail"
    tag = "Work"

    @writes(access=Access.ATTEMPT, scope=None, body=FailRequest, answer=FailAnswer, replays=True, reserved=True)
    async def post(self, job: str, fence: int, body: FailRequest) -> Rendered:
        """End the attempt; the job is retried or fails. A request with the same `write_id` gets the same answer."""
        return await self.answer(completion.fail, job, fence, body, self.services.queue_policy)


RESOURCES: tuple[type[Resource], ...] = (
    Leases,
    Workers,
    Completions,
    AttemptHeartbeat,
    AttemptLog,
    AttemptOutputs,
    AttemptCompletion,
    AttemptFailure,
)
