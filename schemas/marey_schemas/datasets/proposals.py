"""Proposals to merge a version into a branch, with comments, reviews and checks, in requests and answers."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.datasets.commits import EntryPath
from marey_schemas.datasets.merges import EntryConflict, Resolution
from marey_schemas.datasets.naming import MAIN, RefName, Version
from marey_schemas.datasets.proposal_states import CheckState, ProposalState, Verdict
from marey_schemas.datasets.protection import CheckName
from marey_schemas.kinds import Kind
from marey_schemas.names import LINE, ItemId, Message, form
from marey_schemas.sizes import MOST_INTEGER

MOST_TEXT = 10_000
"""Greatest length, in characters, of a description, a comment or the text of a review."""
WITH_FRAMES = (Kind.CLIP, Kind.ANNOTATION)
"""Kinds of entries that have frames on which somebody can comment."""

_LINK = form(r"^https?://[^\s\x00-\x1f\x7f]+$", "be a web address, beginning with https:// or http://")
Title = Annotated[str, StringConstraints(min_length=1, max_length=255, pattern=LINE)]
Text = Annotated[str, StringConstraints(min_length=1, max_length=MOST_TEXT)]
Frame = Annotated[int, Field(ge=0, le=MOST_INTEGER)]


class ProposalCreate(Request):
    """Request to propose that a version is merged into a branch."""

    title: Title
    description: str = Field("", max_length=MOST_TEXT)
    source: Version = Field(
        description="Version whose changes are proposed. If it is a branch, the proposal includes its later commits."
    )
    target: RefName = Field(MAIN, description="Branch that gets the changes.")


class CommentCreate(Request):
    """Request to comment on a proposal, on one of its entries, or on frames of an entry."""

    text: Text
    path: EntryPath | None = Field(None, description="Path of the entry; null: the comment concerns the proposal.")
    kind: Kind | None = Field(None, description="Kind of the entry; required with `path`.")
    frames: tuple[Frame, Frame] | None = Field(
        None,
        description="First frame, and the frame after the last one, of a clip or an annotation; null: the "
        "comment concerns the whole entry.",
    )

    @model_validator(mode="after")
    def _names_one_place(self) -> CommentCreate:
        if (self.path is None) != (self.kind is None):
            raise ValueError(
                "give both path and kind to comment on an entry, or neither of them to comment on the proposal"
            )
        if self.frames is not None:
            if self.kind not in WITH_FRAMES:
                raise ValueError(
                    "frames: only clips and annotations have frames; give path and kind of such an entry, or no frames"
                )
            if self.frames[0] >= self.frames[1]:
                raise ValueError(
                    f"frames: the end, frame {self.frames[1]}, must be after the start, frame {self.frames[0]}"
                )
        return self


class ReviewCreate(Request):
    """Request to review the newest commit of a proposal."""

    verdict: Verdict
    text: str = Field("", max_length=MOST_TEXT)
    commit: Version | None = Field(
        None, description="Commit that was reviewed; null: the newest one. Any commit other than the newest is refused."
    )


class CheckReport(Request):
    """Report of the state of a check for a proposal's newest commit; it replaces this check's previous report."""

    name: CheckName
    state: CheckState
    commit: Version | None = Field(
        None,
        description="Commit that was checked; null: the newest one. A report on any other commit than the "
        "newest is refused.",
    )
    job: ItemId | None = Field(
        None,
        description="Job of the project that carries out the check. The state `succeeded` is refused unless this "
        "job has succeeded. A job whose inputs are versions of datasets must also have read the "
        "newest commit. Null: no job.",
    )
    link: Annotated[str, StringConstraints(max_length=2000, pattern=_LINK)] | None = Field(
        None, description="Address of a page about the check; null: there is none."
    )
    text: str = Field("", max_length=MOST_TEXT, description="Result of the check, as text.")


class ProposalMerge(Request):
    """Request to merge a proposal now, or as soon as all requirements are met."""

    message: Message = Field("", description="Message of the commit; empty: the number and title of the proposal.")
    resolutions: tuple[Resolution, ...] = Field((), max_length=10_000)
    commit: Version | None = Field(
        None, description="Commit to merge; null: the newest one. Any commit other than the newest is refused."
    )
    when_green: bool = Field(
        False,
        description="If approvals, checks or other requirements are still missing, merge as soon as all are met. A "
        "later commit of the proposal cancels this request.",
    )

    @model_validator(mode="after")
    def _can_wait(self) -> ProposalMerge:
        if self.when_green and (self.resolutions or self.message):
            raise ValueError(
                "when_green: a merge that waits for reviews and checks cannot have resolutions or a message; omit "
                "them, and resolve conflicts by a commit first"
            )
        return self


class Proposal(Answer):
    """A proposal to merge a version into a branch."""

    number: int = Field(description="Number in the dataset, from 1.")
    title: str
    description: str
    author: str
    state: ProposalState
    source: str = Field(description="Version whose changes are proposed, as the author named it.")
    target: str = Field(description="Branch that gets the changes.")
    head: str = Field(
        description="Digest of the newest proposed commit. After the end of the proposal: the commit that was the "
        "newest at that time."
    )
    target_commit: str | None = Field(
        description="Digest of the newest commit of the target branch. After the end of the proposal: the commit "
        "that was the newest just before the end. Null: the branch has no commit."
    )
    merged: str | None = Field(
        description="Digest of the commit that the merge made; null if the proposal is not merged."
    )
    when_green: str | None = Field(
        description="User on whose behalf the proposal is merged as soon as no requirement is missing; null: nobody "
        "has requested this."
    )
    ended_by: str | None = Field(description="User who merged or closed the proposal; null while it is open.")
    created_at: datetime
    updated_at: datetime
    ended_at: datetime | None
    rev: int


class Comment(Answer):
    """A comment on a proposal."""

    number: int = Field(description="Number in the proposal, from 1.")
    author: str
    text: str
    path: str | None
    kind: Kind | None
    frames: tuple[int, int] | None
    commit: str = Field(description="Digest of the newest proposed commit at the time of the comment.")
    at: datetime


class Review(Answer):
    """A review of one commit of a proposal."""

    number: int = Field(description="Number in the proposal, from 1.")
    author: str
    verdict: Verdict
    text: str
    commit: str = Field(description="Digest of the commit that was reviewed.")
    stale: bool = Field(
        description="Whether the proposal has a later commit than the reviewed one; if so, an "
        "approval in this review does not count."
    )
    at: datetime


class ProposalCheck(Answer):
    """Check of one commit of a proposal by a program, such as a job: its state and result."""

    name: str
    state: CheckState
    commit: str = Field(description="Digest of the commit that was checked.")
    job: str | None
    link: str | None
    text: str
    reporter: str
    at: datetime


class Missing(Answer):
    """Requirement for the merge of a proposal that is not met yet."""

    code: str
    detail: str


class Mergeability(Answer):
    """Whether a proposal could be merged now, and what the merge would change."""

    missing: tuple[Missing, ...] = Field(
        description="Reasons why the proposal cannot be merged yet; empty: it can be merged."
    )
    changes: int | None = Field(
        description="Number of entries that the merge would change. Null: the number was not computed, because a "
        "side has changed too many entries, or because the merge is impossible."
    )
    conflict_count: int | None = Field(description="Number of conflicts; null: it was not computed.")
    conflicts: tuple[EntryConflict, ...] = Field(description="The first conflicts, by path.")


class ProposalDetail(Proposal):
    """A proposal with its reviews and checks, and with what a merge now would do."""

    comments: int = Field(description="Number of comments.")
    reviews: tuple[Review, ...] = Field(description="The newest approval or request for changes of each reviewer.")
    checks: tuple[ProposalCheck, ...] = Field(description="Checks of the newest proposed commit, by name.")
    mergeability: Mergeability | None = Field(
        description="Whether the proposal could be merged now, and what "
        "the merge would change; null after the end of the "
        "proposal."
    )
