"""Perceptual studies: the design of an experiment in which people say which two of four motions are most similar."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.references import OutputRef, RevisionRef

SHOWN: Literal[4] = 4
"""Number of motions that a trial shows."""
MOST_MOTIONS = 100
MOST_TRIALS = 200

Text = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1)]


class StudyMotion(Request):
    """A motion of a study: a revision of a clip, and a label that is only displayed."""

    clip: RevisionRef | OutputRef
    label: Annotated[str, StringConstraints(max_length=64)] | None = Field(
        None, description="Label in figures, such as F1. Participants do not see it, and no result depends on it."
    )

    @property
    def revision(self) -> RevisionRef:
        """The revision of the clip. Stored studies refer to revisions only, not to outputs of jobs."""
        assert isinstance(self.clip, RevisionRef)
        return self.clip


class StudyDocument(Request):
    """Part `study` of an item of the kind `study`: the design. It contains nothing about participants."""

    schema_: Literal["marey/study@1"] = Field("marey/study@1", alias="schema")
    title: Annotated[Text, Field(max_length=200)] = Field(description="Title that participants see.")
    consent_text: Annotated[Text, Field(max_length=20_000)] = Field(
        description="Text to which participants consent before the first trial."
    )
    motions: tuple[StudyMotion, ...] = Field(
        min_length=SHOWN, max_length=MOST_MOTIONS, description="The motions, each a revision of a different clip."
    )
    trials: int = Field(63, ge=1, le=MOST_TRIALS, description="Number of answered trials of each participant.")
    shown: Literal[4] = Field(SHOWN, description="Number of motions that a trial shows.")
    seconds: float = Field(
        10.0, ge=1, le=120, allow_inf_nan=False, description="Seconds that a participant has to answer a trial."
    )
    seed: int = Field(0, ge=0, le=2**32 - 1, description="Seed of the trials; the same seed draws the same trials.")

    @model_validator(mode="after")
    def _check_motions(self) -> Self:
        items = [one.clip.item for one in self.motions if isinstance(one.clip, RevisionRef)]
        if len(set(items)) != len(items):
            twice = next(item for item in items if items.count(item) > 1)
            raise ValueError(f"motions: the clip {twice} occurs twice; each motion must be a different clip")
        return self
