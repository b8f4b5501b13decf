"""Requests of a study's participants, who have no account, and the answers to them."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, SecretStr, model_validator

from marey_schemas.base import Answer, Request
from marey_schemas.documents.studies import SHOWN

LINK_PREFIX = "mareystudy_"
"""Beginning of the code of every link; the prefix of the link and the secret follow, with `_` between them."""
PARTICIPANT_PREFIX = "mareyparticipant_"
"""Beginning of the token of every participant; a prefix and the secret follow, with `_` between them."""
LINK_PATH = "/s/#"
"""Path of the participant's page. The code of the link follows; browsers do not send what comes after `#`."""

LinkCode = Annotated[SecretStr, Field(max_length=200)]
Place = Annotated[int, Field(ge=0, lt=SHOWN)]
"""Place on the screen, from the left."""


class StudyLink(Request):
    """Request for the study to which a participant's link leads."""

    code: LinkCode


class StudyWelcome(Answer):
    """A study as its participants see it before they consent."""

    title: str
    consent_text: str
    clips: int = Field(description="Number of motions.")
    trials: int = Field(description="Number of trials to answer.")
    shown: int = Field(description="Number of motions in a trial.")
    seconds: float = Field(description="Seconds that the participant has to answer a trial.")


class ParticipationCreate(Request):
    """Consent to take part, in exchange for a token.

    The browser creates the key, and stores the key before it sends this request. Therefore, a repeated request gets the
    same token, and nobody else can use the link again.
    """

    code: LinkCode
    key: Annotated[SecretStr, Field(min_length=64, max_length=64)] = Field(
        description="64 random hexadecimal digits that the browser made."
    )
    consent: Literal[True] = Field(description="The participant consents to the text of the study.")

    @model_validator(mode="after")
    def _has_a_key(self) -> Self:
        if set(self.key.get_secret_value()) - set("0123456789abcdef"):
            raise ValueError("key: write 64 hexadecimal digits, with lower-case letters")
        return self


class Participation(Answer):
    """State of a participant: what the study asks for, and the trials answered so far."""

    title: str
    clips: int = Field(description="Number of motions. The motions are numbered from 0.")
    trials: int = Field(description="Number of trials to answer.")
    answered: int
    remaining: int
    shown: int = Field(description="Number of motions in a trial.")
    seconds: float = Field(description="Seconds that the participant has to answer a trial.")
    finished: bool


class NewParticipation(Answer):
    """Token of a new participant, and the participant's progress."""

    token: str
    participation: Participation


class OpenTrial(Answer):
    """A trial that the participant has not answered yet."""

    number: int = Field(description="Number of the trial among all that were shown to this participant, from 1.")
    clips: tuple[int, ...] = Field(description="Numbers of the motions, by place on the screen.")
    seconds_left: float = Field(description="Time that is left for the answer, by the clock of the server.")


class TrialStep(Answer):
    """Next step of a participant: the open trial, or null if no trial is left."""

    finished: bool
    answered: int
    remaining: int
    trial: OpenTrial | None


class TrialAnswer(Request):
    """Answer of a participant: the two most similar motions, by their places on the screen."""

    chosen: tuple[Place, Place] = Field(description="Two different places, from 0.")
    client_fps: float | None = Field(
        None,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Frames per second that the browser drew while the trial was shown; absent: not measured.",
    )

    @model_validator(mode="after")
    def _chose_two(self) -> Self:
        if self.chosen[0] == self.chosen[1]:
            raise ValueError("chosen: choose two different places")
        return self


class TrialOutcome(Answer):
    """Record of a trial, and the progress of the participant."""

    number: int
    outcome: Literal["answered", "timed_out"]
    chosen: tuple[int, int] | None = Field(description="The recorded places in order; null for a timeout.")
    answered: int
    remaining: int
    finished: bool
