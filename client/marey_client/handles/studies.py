"""Handles of perceptual studies: links for participants, progress, judgements and analysis."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from datetime import timedelta
from itertools import combinations
from typing import Any, Unpack

from marey_client.arguments import checked, checks_arguments
from marey_client.errors import BadArgument
from marey_client.handles.clips import ClipHandle
from marey_client.handles.findings import Findings
from marey_client.items import ItemHandle, Items
from marey_client.jobs import Jobs, OnProgress, job_request
from marey_client.keywords.processing import AnalyseStudyKeywords
from marey_client.paging import pages
from marey_client.transport import named_path
from marey_schemas.documents.references import RevisionRef
from marey_schemas.documents.studies import StudyDocument, StudyMotion
from marey_schemas.queue.job_params import AnalyseStudyParams
from marey_schemas.queue.jobs import JobCreate
from marey_schemas.studies.conducting import (
    JudgingParticipant,
    NewStudyLinks,
    StudyLinksCreate,
    StudyParticipant,
    StudyProgress,
)

MONTH = timedelta(days=30)
TRIAL_COLUMNS = (
    "participant", "index", "number", "shown_1", "shown_2", "shown_3", "shown_4", "chosen_1", "chosen_2", "latency_s",
    "timeouts_before", "seed", "client_fps",
)  # fmt: skip
PAIR_COLUMNS = ("participant", "index", "nearer_1", "nearer_2", "farther_1", "farther_2")


@checks_arguments
class StudyHandle(ItemHandle):
    """Handle of a perceptual study: its design, participants, judgements and analysis."""

    def design(self, *, revision: int | None = None) -> StudyDocument:
        """Return the design: motions, trials, seed and consent."""
        return StudyDocument.model_validate(self.part("study", revision=revision))

    def invite(self, count: int = 1, *, lifetime: timedelta = MONTH) -> NewStudyLinks:
        """Create links, each for one participant without an account; only the answer contains their codes.

        Only maintainers and owners may do this. Raises `Conflict` if the project has too many participants.
        """
        request = checked(StudyLinksCreate, count=count, expires_in_s=int(lifetime.total_seconds()))
        return self.transport.post(NewStudyLinks, f"{self.url}/participants", request, repeatable=False)

    def participants(self) -> Iterator[StudyParticipant]:
        """List the participants under their pseudonyms. Only maintainers and owners may do this."""
        return pages(self.transport, StudyParticipant, f"{self.url}/participants")

    def withdraw(self, participant: str) -> None:
        """Delete consent and trials of a participant, named by id. Only maintainers and owners may do this."""
        self.transport.send("DELETE", named_path(f"{self.url}/participants", participant), repeatable=True)

    def progress(self) -> StudyProgress:
        """Return the numbers of participants and answered trials, over all revisions of the study."""
        return self.transport.get(StudyProgress, f"{self.url}/progress")

    def judgements(self, *, revision: int | None = None) -> Iterator[JudgingParticipant]:
        """List participants who saw a revision (default: that of the handle), each with all trials under a pseudonym.

        Only maintainers and owners may do this.
        """
        query = {"revision": self.item.revision if revision is None else revision}
        return pages(self.transport, JudgingParticipant, f"{self.url}/judgements", query)

    def analyse(self, *, on_progress: OnProgress | None = None, **options: Unpack[AnalyseStudyKeywords]) -> Findings:
        """Compute differences, order and groups of the motions, and fit metrics.

        `options` are those of `AnalyseStudyParams`.
        """
        request = self.analyse_request(**options)
        return Findings(self.transport, Jobs(self.transport).run(self.project, request, on_progress=on_progress))

    def analyse_request(self, **options: Unpack[AnalyseStudyKeywords]) -> JobCreate:
        """Return the job request that `analyse` submits; `options` are those of `AnalyseStudyParams`."""
        params = checked(AnalyseStudyParams, options)
        return job_request("analyse_study", {"study": self.as_input()}, params)


@checks_arguments
class Studies(Items[StudyHandle]):
    """Perceptual studies of a project."""

    def design(
        self,
        name: str,
        clips: Sequence[ClipHandle],
        *,
        consent_text: str,
        title: str | None = None,
        labels: Sequence[str] | None = None,
        collection: str = "",
        **design: Any,
    ) -> StudyHandle:
        """Create a study of clips at their newest revisions.

        `title` is by default the name; `labels` name the motions in figures. `design` are other fields of
        `StudyDocument`, such as `trials`, `seconds` and `seed`. Raises `Conflict` if the name is taken.
        """
        if labels is not None and len(labels) != len(clips):
            raise BadArgument(f"there are {len(labels)} labels for {len(clips)} clips; give one label for each clip")
        named: Sequence[str | None] = [None] * len(clips) if labels is None else labels
        motions = tuple(
            StudyMotion(clip=RevisionRef(item=clip.id, revision=clip.item.revision), label=label)
            for clip, label in zip(clips, named, strict=True)
        )
        study = StudyDocument(title=title or name, consent_text=consent_text, motions=motions, **design)
        return self.create(name, {"study": study.model_dump(mode="json", by_alias=True)}, collection=collection)


# -- judgements as tables ----------------------------------------------------------------------------------------------


def trials_csv(people: Sequence[JudgingParticipant]) -> str:
    """Return one line for each trial, also for those that timed out; motions are indices from 0, as in the study."""
    return _csv(TRIAL_COLUMNS, _trial_rows(people))


def _trial_rows(people: Sequence[JudgingParticipant]) -> Iterator[list[Any]]:
    for one in people:
        for trial in one.trials:
            chosen = (None, None) if trial.chosen is None else [trial.shown[place] for place in trial.chosen]
            yield [
                one.participant, trial.index, trial.number, *trial.shown, *chosen, trial.latency_s,
                trial.timeouts_before, trial.seed, trial.client_fps,
            ]  # fmt: skip


def pairs_csv(people: Sequence[JudgingParticipant]) -> str:
    """Return preference pairs: for each answered trial, five lines that compare the chosen pair with the others.

    In each line, the participant found the first two motions more similar than the last two.
    """
    return _csv(PAIR_COLUMNS, _pair_rows(people))


def _pair_rows(people: Sequence[JudgingParticipant]) -> Iterator[list[Any]]:
    for one in people:
        for trial in one.trials:
            if trial.chosen is None:
                continue
            nearer = [trial.shown[place] for place in trial.chosen]
            for places in combinations(range(len(trial.shown)), 2):
                if places != tuple(trial.chosen):
                    yield [one.participant, trial.index, *nearer, *(trial.shown[place] for place in places)]


def _csv(columns: Sequence[str], rows: Iterator[list[Any]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()
