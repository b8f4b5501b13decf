"""Resources of proposals: comments, reviews, checks and merges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.datasets.proposal_states import ProposalState
from marey_schemas.datasets.proposals import (
    CheckReport,
    Comment,
    CommentCreate,
    Proposal,
    ProposalCheck,
    ProposalCreate,
    ProposalDetail,
    ProposalMerge,
    Review,
    ReviewCreate,
)
from marey_server.errors import ConflictProblem
from marey_server.handlers.versions.datasets import MAX_COMMIT_BYTES
from marey_server.http.declarations import Access, RequestBody, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.store.datasets import proposals
from marey_server.store.datasets.naming import BRANCH_MOVED

TRIES = 3
"""Greatest number of times that a merge is prepared, because a branch may move in the meantime."""


class ProposalsQuery(PageQuery):
    """Query parameters of a list of proposals."""

    state: ProposalState | None = Field(None, description="State of the proposals; absent: any.")


class DatasetProposals(Resource):
    """Proposals of a dataset."""

    path = "/projects/{project}/datasets/{dataset}/proposals"
    tag = "Proposals"

    @reads(access=Access.READER, query=ProposalsQuery, answer=Proposal, paged=True)
    async def get(self, project: str, dataset: str, query: ProposalsQuery) -> Rendered:
        """List the proposals, newest first."""
        return await self.answer(
            proposals.list_proposals, project, dataset, state=query.state, cursor=query.cursor, limit=query.limit
        )

    @writes(access=Access.CONTRIBUTOR, body=ProposalCreate, answer=Proposal, status=201, etag=True, idempotency="key")
    async def post(self, project: str, dataset: str, body: ProposalCreate) -> Rendered:
        """Propose to merge a version into a branch."""
        return await self.answer_with(
            lambda made: Reply(
                made, rev=made.rev, location=f"/projects/{project}/datasets/{dataset}/proposals/{made.number}"
            ),
            proposals.open_proposal,
            project,
            dataset,
            body,
        )


class ProposalResource(Resource):
    """A proposal."""

    path = "/projects/{project}/datasets/{dataset}/proposals/{proposal:int}"
    tag = "Proposals"

    @reads(access=Access.READER, answer=ProposalDetail)
    async def get(self, project: str, dataset: str, proposal: int) -> Rendered:
        """Return a proposal with its reviews and checks, and whether it can be merged."""
        return await self.answer(proposals.read_proposal, project, dataset, proposal)


class ProposalComments(Resource):
    """Comments on a proposal."""

    path = "/projects/{project}/datasets/{dataset}/proposals/{proposal:int}/comments"
    tag = "Proposals"

    @reads(access=Access.READER, query=PageQuery, answer=Comment, paged=True)
    async def get(self, project: str, dataset: str, proposal: int, query: PageQuery) -> Rendered:
        """List the comments, oldest first."""
        return await self.answer(
            proposals.list_comments, project, dataset, proposal, cursor=query.cursor, limit=query.limit
        )

    @writes(access=Access.CONTRIBUTOR, body=CommentCreate, answer=Comment, status=201, idempotency="key")
    async def post(self, project: str, dataset: str, proposal: int, body: CommentCreate) -> Rendered:
        """Comment on an open proposal, on one of its entries, or on frames of an entry."""
        return await self.answer(proposals.add_comment, project, dataset, proposal, body)


class WaitingProposal(Resource):
    """Base of resources whose requests may meet the last requirement of a proposal that waits for an automatic merge.

    The proposal is then merged.
    """

    tag = "Proposals"

    async def answer_with_merge(
        self, function: Callable[..., Any], project: str, dataset: str, proposal: int, body: Request
    ) -> Rendered:
        """Prepare the merge of the proposal, call `function` with the prepared merge, and answer with the result.

        `function` stores the request, and may perform the merge. If a branch has moved since the merge was prepared,
        both steps are repeated.
        """
        for _ in range(TRIES - 1):
            try:
                return await self._try(function, project, dataset, proposal, body)
            except ConflictProblem as error:
                if error.error_code != BRANCH_MOVED:
                    raise
        return await self._try(function, project, dataset, proposal, body)

    async def _try(
        self, function: Callable[..., Any], project: str, dataset: str, proposal: int, body: Request
    ) -> Rendered:
        prepared = await self.look_up(proposals.prepare_waiting, project, dataset, proposal)
        return await self.answer(function, project, dataset, proposal, body, prepared)


class ProposalReviews(WaitingProposal):
    """Reviews of a proposal."""

    path = "/projects/{project}/datasets/{dataset}/proposals/{proposal:int}/reviews"

    @reads(access=Access.READER, query=PageQuery, answer=Review, paged=True)
    async def get(self, project: str, dataset: str, proposal: int, query: PageQuery) -> Rendered:
        """List all reviews, oldest first."""
        return await self.answer(
            proposals.list_reviews, project, dataset, proposal, cursor=query.cursor, limit=query.limit
        )

    @writes(access=Access.CONTRIBUTOR, body=ReviewCreate, answer=Review, status=201, idempotency="key")
    async def post(self, project: str, dataset: str, proposal: int, body: ReviewCreate) -> Rendered:
        """Review the newest commit of an open proposal.

        If the proposal waits to be merged and meets all other requirements, an approval merges it.
        """
        return await self.answer_with_merge(proposals.add_review, project, dataset, proposal, body)


class ProposalChecks(WaitingProposal):
    """Checks of a proposal."""

    path = "/projects/{project}/datasets/{dataset}/proposals/{proposal:int}/checks"

    @writes(access=Access.CONTRIBUTOR, body=CheckReport, answer=ProposalCheck)
    async def post(self, project: str, dataset: str, proposal: int, body: CheckReport) -> Rendered:
        """Report the state of a check of the newest commit of an open proposal.

        If the proposal waits to be merged and meets all other requirements, a successful check merges it.
        """
        return await self.answer_with_merge(proposals.report_check, project, dataset, proposal, body)


class ProposalMerges(Resource):
    """Merge of a proposal."""

    path = "/projects/{project}/datasets/{dataset}/proposals/{proposal:int}/merge"
    tag = "Proposals"

    @writes(
        access=Access.CONTRIBUTOR,
        body=RequestBody(ProposalMerge, max_bytes=MAX_COMMIT_BYTES),
        answer=Proposal,
        etag=True,
        idempotency="key",
    )
    async def post(self, project: str, dataset: str, proposal: int, body: ProposalMerge) -> Rendered:
        """Merge a proposal into its target.

        If requirements are not met, the request is refused with 409, and `context.missing` lists these requirements.
        With `when_green`, the request is accepted, and the proposal is merged as soon as all requirements are met.
        """
        prepared = await self.look_up(proposals.prepare_acceptance, project, dataset, proposal, body)
        return await self.answer(proposals.merge_proposal, project, dataset, proposal, body, prepared)

    @writes(access=Access.CONTRIBUTOR, answer=Proposal, etag=True)
    async def delete(self, project: str, dataset: str, proposal: int) -> Rendered:
        """Cancel the automatic merge that was requested with `when_green`; the proposal stays open."""
        return await self.answer(proposals.withdraw_merge, project, dataset, proposal)


class ProposalClosing(Resource):
    """End of a proposal without a merge."""

    path = "/projects/{project}/datasets/{dataset}/proposals/{proposal:int}/close"
    tag = "Proposals"

    @writes(access=Access.CONTRIBUTOR, answer=Proposal, etag=True, idempotency="key")
    async def post(self, project: str, dataset: str, proposal: int) -> Rendered:
        """Close a proposal without merging it; only its author and maintainers may do this."""
        return await self.answer(proposals.close_proposal, project, dataset, proposal)


RESOURCES: tuple[type[Resource], ...] = (
    DatasetProposals,
    ProposalResource,
    ProposalComments,
    ProposalReviews,
    ProposalChecks,
    ProposalMerges,
    ProposalClosing,
)
