"""Resources for participants of studies, who have no account: links, consent, trials, poses and withdrawal.

The code of a link and the token of a participant are secrets. They occur only in bodies and in the header
Authorization, and in the answer to the request that exchanges the link.
"""

from __future__ import annotations

from functools import partial
from typing import cast, get_args

from marey_schemas.studies.participation import (
    NewParticipation,
    Participation,
    ParticipationCreate,
    StudyLink,
    StudyWelcome,
    TrialAnswer,
    TrialOutcome,
    TrialStep,
)
from marey_server.errors import NotFoundProblem
from marey_server.handlers.access import MAX_LOGIN_BYTES, PasswordResource
from marey_server.http.caching import IMMUTABLE, WITH_SECRET
from marey_server.http.declarations import Access, Document, RequestBody, reads, writes
from marey_server.http.reply import Rendered, Reply, UnchangingDocument
from marey_server.http.resource import Resource
from marey_server.store import items
from marey_server.store.studies import participants, poses, trials
from marey_server.store.studies.poses import ShownPart
from marey_server.store.transaction import Transaction

TAG = "Study participation"


class StudyLinkWelcome(PasswordResource):
    """Study to which a link leads."""

    path = "/participation/link"
    tag = TAG

    @writes(
        access=Access.ANYONE,
        scope=None,
        body=RequestBody(StudyLink, max_bytes=MAX_LOGIN_BYTES),
        answer=StudyWelcome,
        also=((429, None),),
    )
    async def post(self, body: StudyLink) -> Rendered:
        """Return the title, the text of the consent and the extent of the study that a link leads to.

        All links that are not valid get the same answer (404 `study-link-invalid`).
        """
        attempt = await self.count_code(body.code, participants.try_of)
        return await self.answer(participants.welcome, body.code.get_secret_value(), attempt)


class OwnParticipation(PasswordResource):
    """Participation of the caller in a study."""

    path = "/participation"
    tag = TAG

    @writes(
        access=Access.ANYONE,
        scope=None,
        body=RequestBody(ParticipationCreate, max_bytes=MAX_LOGIN_BYTES),
        answer=NewParticipation,
        status=201,
        also=((429, None),),
    )
    async def post(self, body: ParticipationCreate) -> Rendered:
        """Consent to take part, and exchange the code of a link for the token of a participant.

        A repeated request with the same key gets the same token. With another key, the link is not valid any more.
        """
        attempt = await self.count_code(body.code, participants.try_of)
        return await self.answer_with(lambda made: Reply(made, headers=WITH_SECRET), participants.begin, body, attempt)

    @reads(access=Access.PARTICIPANT, scope=None, answer=Participation)
    async def get(self) -> Rendered:
        """Return the progress of the participant."""
        return await self.answer(participants.read_participation)

    @writes(access=Access.PARTICIPANT, scope=None)
    async def delete(self) -> Rendered:
        """Withdraw: delete the consent and all answers of the participant. A repetition changes nothing."""
        return await self.answer(participants.withdraw_caller)


class ParticipationTrials(Resource):
    """Trials of the participant."""

    path = "/participation/trials"
    tag = TAG

    @writes(access=Access.PARTICIPANT, scope=None, answer=TrialStep)
    async def post(self) -> Rendered:
        """Return the open trial, or open the next one; its clock starts at once.

        If the time of the open trial is over, it is recorded as timed out and does not count, and a new random set of
        motions is shown. When all trials are answered, `finished` is true.
        """
        return await self.answer(trials.open_trial)


class ParticipationTrial(Resource):
    """A trial of the participant."""

    path = "/participation/trials/{trial:int}"
    tag = TAG

    @writes(access=Access.PARTICIPANT, scope=None, body=TrialAnswer, answer=TrialOutcome)
    async def put(self, trial: int, body: TrialAnswer) -> Rendered:
        """Answer a trial. Only the first answer counts; all later answers get the recorded outcome."""
        return await self.answer(trials.answer_trial, trial, body)


def read_shown_part(tx: Transaction, clip: int, part: ShownPart) -> Reply:
    """Return a document of one motion of the caller's study; the document never changes."""
    found = poses.find_shown_part(tx, clip, part)
    content = UnchangingDocument(found.digest, partial(items.load_part, tx, found), found.size_bytes)
    return Reply(content, rev=f"r{found.revision}", headers={"Cache-Control": IMMUTABLE})


class ParticipationPart(Resource):
    """A document of one motion of the study."""

    path = "/participation/clips/{clip:int}/{part}"
    tag = TAG

    @reads(access=Access.PARTICIPANT, scope=None, answer=Document, etag=True)
    async def get(self, clip: int, part: str) -> Rendered:
        """Return the poses (`motion`) of a motion, its skeleton (`hierarchy`), or the joint mapping (`mapping`).

        Motions are numbered from 0, as in trials. The documents are the same as those of the clip and its skeleton.
        """
        if part not in get_args(ShownPart):
            known = ", ".join(get_args(ShownPart))
            raise NotFoundProblem(f"A motion of a study has no part {part!r}; the parts are {known}.")
        return await self.answer_with(lambda reply: reply, read_shown_part, clip, cast(ShownPart, part))


RESOURCES: tuple[type[Resource], ...] = (
    StudyLinkWelcome,
    OwnParticipation,
    ParticipationTrials,
    ParticipationTrial,
    ParticipationPart,
)
