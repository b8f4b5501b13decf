"""Requests of those who carry out a study, and the answers to them: links, progress and judgements."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from marey_schemas.base import Answer, Request
from marey_schemas.sizes import DAY_S

MOST_LINKS_AT_ONCE = 100
MOST_LINK_DAYS = 180
MOST_JUDGES_AT_ONCE = 50
"""Greatest number of participants whose judgements one answer contains."""

ParticipantState = Literal["invited", "started", "finished", "withdrawn"]


class StudyLinksCreate(Request):
    """Request for links, each for one participant."""

    count: int = Field(1, ge=1, le=MOST_LINKS_AT_ONCE, description="Number of links to create.")
    expires_in_s: int = Field(
        30 * DAY_S,
        ge=60,
        le=MOST_LINK_DAYS * DAY_S,
        description="Seconds after the creation of the link within which the participant must begin.",
    )


class NewStudyLink(Answer):
    """Link for one participant; its code is shown only once."""

    participant: str = Field(description="Pseudonym of the participant, such as p1.")
    code: str = Field(description="Code of the link, which follows the address of the server and `/s/#`.")


class NewStudyLinks(Answer):
    """New links of a study, one for each participant."""

    revision: int = Field(description="Revision of the study that these participants see.")
    expires_at: datetime
    links: tuple[NewStudyLink, ...]


class StudyParticipant(Answer):
    """Participant of a study, under a pseudonym: state and progress."""

    id: str
    participant: str = Field(description="Pseudonym, such as p1.")
    revision: int = Field(description="Revision of the study that the participant sees.")
    state: ParticipantState
    answered: int
    timeouts: int
    expires_at: datetime | None = Field(description="End of the link; null once the participant has begun.")


class StudyProgress(Answer):
    """Numbers of participants and trials, over all revisions of a study."""

    invited: int = Field(description="Links that nobody has used yet and that have not expired.")
    started: int
    finished: int
    withdrawn: int
    answered: int = Field(description="Number of answered trials.")
    timeouts: int


class StudyDifferences(Answer):
    """Differences that the participants of one revision of a study have perceived so far.

    All tables are symmetric and in the order of the study's motions.
    """

    revision: int
    participants: int = Field(description="Number of participants with an answered trial.")
    trials: int = Field(description="Number of answered trials.")
    shown: tuple[tuple[int, ...], ...] = Field(
        description="How often each pair of motions was in an answered trial; 0: the pair is missing."
    )
    chosen: tuple[tuple[int, ...], ...] = Field(description="How often each pair was chosen.")
    differences: tuple[tuple[float | None, ...], ...] = Field(
        description="1 - chosen / shown, and 0 on the diagonal; null: the pair is missing."
    )
    order: tuple[int, ...] | None = Field(
        description="Motions along the first principal component of the differences; null: some motion is in no trial."
    )
    noise: float | None = Field(
        description="Standard error of the differences (root mean square), which is due to chance; it does not include "
        "how much people differ from each other. Null: unknown, because too few pairs were judged repeatedly."
    )


class JudgedTrial(Answer):
    """A trial that was answered or timed out."""

    index: int = Field(description="Number of trials that the participant had answered before.")
    number: int = Field(description="Number of the trial among all that were shown to the participant, from 1.")
    shown: tuple[int, ...] = Field(description="Motions by place on the screen: indices into the motions of the study.")
    chosen: tuple[int, int] | None = Field(
        description="Places of the two chosen motions on the screen; null if the trial timed out."
    )
    latency_s: float | None = Field(
        description="Seconds until the answer, by the clock of the server; null if the trial timed out."
    )
    timeouts_before: int = Field(
        description="Number of trials of the participant that timed out since the last answer."
    )
    seed: int
    client_fps: float | None


class JudgingParticipant(Answer):
    """Participant of a study, under a pseudonym, with the trials that were shown."""

    participant: str = Field(description="Pseudonym, such as p1.")
    finished: bool
    trials: tuple[JudgedTrial, ...]
