"""Counterparts of `marey_client.handles.proposals` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.handles.proposals import ProposalHandle, Proposals
from marey_schemas.datasets.merges import Resolution
from marey_schemas.datasets.naming import MAIN
from marey_schemas.datasets.proposal_states import CheckState, ProposalState, Verdict
from marey_schemas.datasets.proposals import Comment, Proposal, ProposalCheck, ProposalDetail, Review
from marey_schemas.kinds import Kind


@counterpart_of(Proposals)
class AsyncProposals(Counterpart):
    """Proposals to merge versions into branches of a dataset."""

    _sync: Proposals

    @property
    def url(self) -> str:
        return self._sync.url

    async def open(self, title: str, source: str, *, into: str = MAIN, description: str = "") -> AsyncProposalHandle:
        """Propose to merge a version into a branch. If the version is a branch, its later commits are included."""
        exchanged: AsyncProposalHandle = await self._exchange(
            self._sync.open, title, source, into=into, description=description
        )
        return exchanged

    def list(self, state: ProposalState | None = None) -> AsyncIterator[Proposal]:
        """List the proposals, newest first; with `state`, only proposals in this state."""
        return self._each(self._sync.list, state)

    def at(self, number: int) -> AsyncProposalHandle:
        """Return a handle of the proposal with this number; no request is sent."""
        exchanged: AsyncProposalHandle = self._now(self._sync.at, number)
        return exchanged


@counterpart_of(ProposalHandle)
class AsyncProposalHandle(Counterpart):
    """Handle of a proposal; requests are sent only by its methods."""

    _sync: ProposalHandle

    @property
    def url(self) -> str:
        return self._sync.url

    async def read(self) -> ProposalDetail:
        """Return the proposal with its reviews and checks, and what is missing before it can be merged."""
        return await self._run(self._sync.read)

    async def comment(
        self, text: str, *, path: str | None = None, kind: Kind | None = None, frames: tuple[int, int] | None = None
    ) -> Comment:
        """Comment on the proposal, on one of its entries, or on a range of an entry's frames.

        `path` and `kind` name the entry; `frames` is the first frame and the end, which is not included.
        """
        return await self._run(self._sync.comment, text, path=path, kind=kind, frames=frames)

    def comments(self) -> AsyncIterator[Comment]:
        """List the comments, oldest first."""
        return self._each(self._sync.comments)

    async def review(self, verdict: Verdict, text: str = "", *, commit: str | None = None) -> Review:
        """Review the newest commit. Raises `Conflict` if `commit` is given and is not the newest commit."""
        return await self._run(self._sync.review, verdict, text, commit=commit)

    def reviews(self) -> AsyncIterator[Review]:
        """List all reviews, oldest first."""
        return self._each(self._sync.reviews)

    async def report_check(
        self,
        name: str,
        state: CheckState,
        *,
        text: str = "",
        job: str | None = None,
        link: str | None = None,
        commit: str | None = None,
    ) -> ProposalCheck:
        """Report the state of a check of the newest commit.

        Raises `Conflict` if `commit` is given and is not the newest commit, or if `state` is `SUCCEEDED` and `job` has
        not succeeded.
        """
        return await self._run(self._sync.report_check, name, state, text=text, job=job, link=link, commit=commit)

    async def merge(
        self,
        *,
        message: str = "",
        resolutions: Sequence[Resolution] = (),
        when_green: bool = False,
        commit: str | None = None,
    ) -> Proposal:
        """Merge the proposal; with `when_green`, the server merges it as soon as all requirements are met.

        Raises `Conflict`. Its code says why: `proposal-not-green`: requirements are not met; `missing` in the context
        of the error lists them. `merge-conflicts`: `resolutions` do not decide all conflicts. `proposal-moved`:
        `commit` is given and is not the newest commit. `proposal-merged`, `proposal-closed`: the proposal has ended.
        """
        return await self._run(
            self._sync.merge, message=message, resolutions=resolutions, when_green=when_green, commit=commit
        )

    async def withdraw_merge(self) -> Proposal:
        """Cancel the request of `merge(when_green=True)` to merge the proposal as soon as nothing is missing."""
        return await self._run(self._sync.withdraw_merge)

    async def close(self) -> Proposal:
        """Close the proposal without a merge; only the author of the proposal and maintainers may do this."""
        return await self._run(self._sync.close)
