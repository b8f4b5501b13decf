"""Resources for those who carry out a study: links, participants, progress and judgements."""

from __future__ import annotations

from pydantic import Field

from marey_schemas.base import Request
from marey_schemas.sizes import MOST_INTEGER
from marey_schemas.studies.conducting import (
    MOST_JUDGES_AT_ONCE,
    JudgingParticipant,
    NewStudyLinks,
    StudyDifferences,
    StudyLinksCreate,
    StudyParticipant,
    StudyProgress,
)
from marey_server.handlers.items import kind_of
from marey_server.http.caching import WITH_SECRET
from marey_server.http.declarations import Access, reads, writes
from marey_server.http.queries import PageQuery
from marey_server.http.reply import Rendered, Reply
from marey_server.http.resource import Resource
from marey_server.motions.studies import draw_plans, find_differences
from marey_server.store.studies import conducting, judgements

TAG = "Studies"


class DifferencesQuery(Request):
    """Query parameters of the differences of a study: its revision."""

    revision: int = Field(ge=1, le=MOST_INTEGER, description="Revision of the study that the participants saw.")


class JudgementsQuery(PageQuery):
    """Query parameters that select one page of participants of one revision of a study."""

    revision: int = Field(ge=1, le=MOST_INTEGER, description="Revision of the study that the participants saw.")
    limit: int = Field(
        MOST_JUDGES_AT_ONCE, ge=1, le=MOST_JUDGES_AT_ONCE, description="Greatest number of participants in a page."
    )


class StudyParticipants(Resource):
    """Participants of a study, and links for further participants."""

    path = "/projects/{project}/{kind}/{item}/participants"
    tag = TAG

    @reads(access=Access.MAINTAINER, query=PageQuery, answer=StudyParticipant, paged=True, public=False)
    async def get(self, project: str, kind: str, item: str, query: PageQuery) -> Rendered:
        """List the participants of a study (kind `studies`) under pseudonyms, without the codes of their links."""
        return await self.answer(
            conducting.list_participants, project, kind_of(kind), item, cursor=query.cursor, limit=query.limit
        )

    @writes(access=Access.MAINTAINER, body=StudyLinksCreate, answer=NewStudyLinks, status=201)
    async def post(self, project: str, kind: str, item: str, body: StudyLinksCreate) -> Rendered:
        """Create links, each for one participant without an account; the codes are shown only once.

        The participants see the newest revision of the study. The trials are drawn with the seed of the study, so that
        every participant sees every motion equally often, and all pairs of motions are shown about equally often.
        """
        planned = await self.look_up(conducting.plan_links, project, kind_of(kind), item, body)
        plans = await self.compute(draw_plans, planned, body.count)
        return await self.answer_with(
            lambda made: Reply(made, headers=WITH_SECRET),
            conducting.create_links,
            project,
            kind_of(kind),
            item,
            body,
            planned,
            plans,
        )


class OneStudyParticipant(Resource):
    """A participant of a study."""

    path = "/projects/{project}/{kind}/{item}/participants/{participant}"
    tag = TAG

    @writes(access=Access.MAINTAINER)
    async def delete(self, project: str, kind: str, item: str, participant: str) -> Rendered:
        """Delete the consent and the trials of a participant, who then counts as withdrawn.

        `participant` in the address is the id of the participant. The participant's link is no longer valid.
        """
        return await self.answer(conducting.withdraw_participant, project, kind_of(kind), item, participant)


class StudyProgressResource(Resource):
    """Progress of a study."""

    path = "/projects/{project}/{kind}/{item}/progress"
    tag = TAG

    @reads(access=Access.READER, answer=StudyProgress)
    async def get(self, project: str, kind: str, item: str) -> Rendered:
        """Return how many participants and trials a study has, without data of single participants."""
        return await self.answer(conducting.read_progress, project, kind_of(kind), item)


class StudyJudgementsResource(Resource):
    """Judgements of a study's participants."""

    path = "/projects/{project}/{kind}/{item}/judgements"
    tag = TAG

    @reads(access=Access.MAINTAINER, query=JudgementsQuery, answer=JudgingParticipant, paged=True, public=False)
    async def get(self, project: str, kind: str, item: str, query: JudgementsQuery) -> Rendered:
        """List the answers of the participants who saw a revision of a study, under pseudonyms and without dates."""
        return await self.answer(
            judgements.list_judgements,
            project,
            kind_of(kind),
            item,
            revision=query.revision,
            cursor=query.cursor,
            limit=query.limit,
        )


class StudyDifferencesResource(Resource):
    """Differences that the participants of a study perceived."""

    path = "/projects/{project}/{kind}/{item}/differences"
    tag = TAG

    @reads(access=Access.MAINTAINER, query=DifferencesQuery, answer=StudyDifferences, public=False)
    async def get(self, project: str, kind: str, item: str, query: DifferencesQuery) -> Reply:
        """Return how different the motions of a study look to the participants, according to the answers so far.

        The answer contains no data of single participants. The job kind `analyse_study` computes the same differences,
        groups of the motions, and metrics.
        """
        collected = await self.look_up(
            judgements.collect_answers, project, kind_of(kind), item, revision=query.revision
        )
        return Reply(await self.compute(find_differences, collected))


class AttemptJudgements(Resource):
    """Judgements of a study that is the input of a job."""

    path = "/jobs/{job}/attempts/{fence:int}/judgements/{item}"
    tag = "Work"

    @reads(access=Access.ATTEMPT, scope=None, query=JudgementsQuery, answer=JudgingParticipant, paged=True)
    async def get(self, job: str, fence: int, item: str, query: JudgementsQuery) -> Rendered:
        """List the answers of the participants of a study, for an attempt of a job whose author is a maintainer."""
        return await self.answer(
            judgements.list_for_attempt,
            job,
            fence,
            item,
            revision=query.revision,
            cursor=query.cursor,
            limit=query.limit,
        )


RESOURCES: tuple[type[Resource], ...] = (
    StudyParticipants,
    OneStudyParticipant,
    StudyProgressResource,
    StudyJudgementsResource,
    StudyDifferencesResource,
    AttemptJudgements,
)
