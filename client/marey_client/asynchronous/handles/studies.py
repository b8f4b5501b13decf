"""Counterparts of `marey_client.handles.studies` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from datetime import timedelta
from typing import Any, Unpack

from marey_client.asynchronous.counterparts import counterpart_of
from marey_client.asynchronous.handles.clips import AsyncClipHandle
from marey_client.asynchronous.handles.findings import AsyncFindings
from marey_client.asynchronous.items import AsyncItemHandle, AsyncItems
from marey_client.asynchronous.jobs import AsyncOnProgress
from marey_client.handles.studies import MONTH, Studies, StudyHandle
from marey_client.keywords.processing import AnalyseStudyKeywords
from marey_schemas.documents.studies import StudyDocument
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.studies.conducting import JudgingParticipant, NewStudyLinks, StudyParticipant, StudyProgress


@counterpart_of(StudyHandle)
class AsyncStudyHandle(AsyncItemHandle):
    """Handle of a perceptual study: its design, participants, judgements and analysis."""

    _sync: StudyHandle

    async def design(self, *, revision: int | None = None) -> StudyDocument:
        """Return the design: motions, trials, seed and consent."""
        return await self._run(self._sync.design, revision=revision)

    async def invite(self, count: int = 1, *, lifetime: timedelta = MONTH) -> NewStudyLinks:
        """Create links, each for one participant without an account; only the answer contains their codes.

        Only maintainers and owners may do this. Raises `Conflict` if the project has too many participants.
        """
        return await self._run(self._sync.invite, count, lifetime=lifetime)

    def participants(self) -> AsyncIterator[StudyParticipant]:
        """List the participants under their pseudonyms. Only maintainers and owners may do this."""
        return self._each(self._sync.participants)

    async def withdraw(self, participant: str) -> None:
        """Delete consent and trials of a participant, named by id. Only maintainers and owners may do this."""
        await self._run(self._sync.withdraw, participant)

    async def progress(self) -> StudyProgress:
        """Return the numbers of participants and answered trials, over all revisions of the study."""
        return await self._run(self._sync.progress)

    def judgements(self, *, revision: int | None = None) -> AsyncIterator[JudgingParticipant]:
        """List participants who saw a revision (default: that of the handle), each with all trials under a pseudonym.

        Only maintainers and owners may do this.
        """
        return self._each(self._sync.judgements, revision=revision)

    async def analyse(
        self, *, on_progress: AsyncOnProgress | None = None, **options: Unpack[AnalyseStudyKeywords]
    ) -> AsyncFindings:
        """Compute differences, order and groups of the motions, and fit metrics.

        `options` are those of `AnalyseStudyParams`.
        """
        exchanged: AsyncFindings = await self._exchange(self._sync.analyse, on_progress=on_progress, **options)
        return exchanged

    async def analyse_request(self, **options: Unpack[AnalyseStudyKeywords]) -> JobCreate:
        """Return the job request that `analyse` submits; `options` are those of `AnalyseStudyParams`."""
        return await self._run(self._sync.analyse_request, **options)


@counterpart_of(Studies)
class AsyncStudies(AsyncItems[AsyncStudyHandle]):
    """Perceptual studies of a project."""

    _sync: Studies

    async def design(
        self,
        name: str,
        clips: Sequence[AsyncClipHandle],
        *,
        consent_text: str,
        title: str | None = None,
        labels: Sequence[str] | None = None,
        collection: str = "",
        **design: Any,
    ) -> AsyncStudyHandle:
        """Create a study of clips at their newest revisions.

        `title` is by default the name; `labels` name the motions in figures. `design` are other fields of
        `StudyDocument`, such as `trials`, `seconds` and `seed`. Raises `Conflict` if the name is taken.
        """
        exchanged: AsyncStudyHandle = await self._exchange(
            self._sync.design,
            name,
            clips,
            consent_text=consent_text,
            title=title,
            labels=labels,
            collection=collection,
            **design,
        )
        return exchanged
