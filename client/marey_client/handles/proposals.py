"""Proposals of a dataset: comments, reviews, checks and merges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from marey_client.arguments import checked, checks_arguments
from marey_client.paging import pages
from marey_client.transport import Params, Transport, read_model, sends_nothing
from marey_schemas.datasets.merges import Resolution
from marey_schemas.datasets.naming import MAIN
from marey_schemas.datasets.proposal_states import CheckState, ProposalState, Verdict
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
from marey_schemas.kinds import Kind


@checks_arguments
@dataclass(frozen=True)
class Proposals:
    """Proposals to merge versions into branches of a dataset."""

    transport: Transport
    url: str

    def open(self, title: str, source: str, *, into: str = MAIN, description: str = "") -> ProposalHandle:
        """Propose to merge a version into a branch. If the version is a branch, its later commits are included."""
        request = checked(ProposalCreate, title=title, source=source, target=into, description=description)
        return self.at(self.transport.post(Proposal, self.url, request).number)

    def list(self, state: ProposalState | None = None) -> Iterator[Proposal]:
        """List the proposals, newest first; with `state`, only proposals in this state."""
        query: Params = {} if state is None else {"state": state.value}
        return pages(self.transport, Proposal, self.url, query)

    @sends_nothing
    def at(self, number: int) -> ProposalHandle:
        """Return a handle of the proposal with this number; no request is sent."""
        return ProposalHandle(self.transport, f"{self.url}/{number}")


@checks_arguments
@dataclass(frozen=True)
class ProposalHandle:
    """Handle of a proposal; requests are sent only by its methods."""

    transport: Transport
    url: str

    def read(self) -> ProposalDetail:
        """Return the proposal with its reviews and checks, and what is missing before it can be merged."""
        return self.transport.get(ProposalDetail, self.url)

    def comment(
        self,
        text: str,
        *,
        path: str | None = None,
        kind: Kind | None = None,
        frames: tuple[int, int] | None = None,
    ) -> Comment:
        """Comment on the proposal, on one of its entries, or on a range of an entry's frames.

        `path` and `kind` name the entry; `frames` is the first frame and the end, which is not included.
        """
        request = checked(CommentCreate, text=text, path=path, kind=kind, frames=frames)
        return self.transport.post(Comment, f"{self.url}/comments", request)

    def comments(self) -> Iterator[Comment]:
        """List the comments, oldest first."""
        return pages(self.transport, Comment, f"{self.url}/comments")

    def review(self, verdict: Verdict, text: str = "", *, commit: str | None = None) -> Review:
        """Review the newest commit. Raises `Conflict` if `commit` is given and is not the newest commit."""
        request = checked(ReviewCreate, verdict=verdict, text=text, commit=commit)
        return self.transport.post(Review, f"{self.url}/reviews", request)

    def reviews(self) -> Iterator[Review]:
        """List all reviews, oldest first."""
        return pages(self.transport, Review, f"{self.url}/reviews")

    def report_check(
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
        request = CheckReport(name=name, state=state, text=text, job=job, link=link, commit=commit)
        return self.transport.post(ProposalCheck, f"{self.url}/checks", request)

    def merge(
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
        request = ProposalMerge(message=message, resolutions=tuple(resolutions), when_green=when_green, commit=commit)
        return self.transport.post(Proposal, f"{self.url}/merge", request)

    def withdraw_merge(self) -> Proposal:
        """Cancel the request of `merge(when_green=True)` to merge the proposal as soon as nothing is missing."""
        return read_model(Proposal, self.transport.send("DELETE", f"{self.url}/merge"))

    def close(self) -> Proposal:
        """Close the proposal without a merge; only the author of the proposal and maintainers may do this."""
        return self.transport.post(Proposal, f"{self.url}/close")
