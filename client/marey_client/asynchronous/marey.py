"""Counterparts of `marey_client.marey` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Unpack

from marey_client.asynchronous.access import AsyncTokens, AsyncUsers
from marey_client.asynchronous.blobs import AsyncBlobs
from marey_client.asynchronous.counterparts import Connection, counterpart_of
from marey_client.asynchronous.jobs import AsyncJobs
from marey_client.asynchronous.project import AsyncProjectHandle
from marey_client.audit import AuditConditions
from marey_client.credentials import TokenFile
from marey_client.marey import Marey
from marey_schemas.access import Login, Me, NewToken, Project, ProjectCreate
from marey_schemas.audit import AuditEntry
from marey_schemas.invitations import AcceptedInvitation, SignedUp, SignUp
from marey_schemas.queue.workers import Worker
from marey_schemas.sign_ins import BrowserSignIn, BrowserSignInCode, BrowserSignInCreate


@counterpart_of(Marey)
class AsyncMarey(Connection):
    """Client of a Marey server for async programs: its methods are those of `Marey`, and are awaited.

    Tasks, and event loops, may share a client; close it, or use it in an `async with` block.

    Parameters
    ----------
    url, token, retries, timeout_s, http : those of `Marey`
    concurrency : number of calls that run at a time, each in a thread; others wait for their turn. Calls that wait for
        the end of a job are not counted. At most 64
    """

    async def sign_in(self, login: Login) -> NewToken:
        """Return a token for a name and a password."""
        return await self._run(self._sync.sign_in, login)

    async def sign_up(self, request: SignUp) -> SignedUp:
        """Create an account with the invitation of an administrator; the answer contains a token, shown only once.

        The request is sent again if its answer is lost, because a repeated request has no further effect.
        """
        return await self._run(self._sync.sign_up, request)

    async def begin_sign_in(self, request: BrowserSignInCreate) -> BrowserSignIn:
        """Begin a sign-in with the identity provider of the server; a person completes it in a browser.

        Raises `NotFound` if the server has no identity provider.
        """
        return await self._run(self._sync.begin_sign_in, request)

    async def finish_sign_in(self, sign_in: str, request: BrowserSignInCode) -> NewToken:
        """End a sign-in with the code that the browser got, and return its token.

        Raises `NotFound` if the code is wrong, or if the sign-in has expired.
        """
        return await self._run(self._sync.finish_sign_in, sign_in, request)

    async def accept_invitation(self, code: str) -> AcceptedInvitation:
        """Become a member of a project with the code of an invitation.

        The request is sent again if its answer is lost. Raises `NotFound` if the code is not valid.
        """
        return await self._run(self._sync.accept_invitation, code)

    async def me(self) -> Me:
        """Return the user and the scopes of the client's token."""
        return await self._run(self._sync.me)

    def project(self, name: str) -> AsyncProjectHandle:
        """Return a project by its name, without a request. Raises `BadArgument` for the path of a folder."""
        exchanged: AsyncProjectHandle = self._now(self._sync.project, name)
        return exchanged

    def projects(self) -> AsyncIterator[Project]:
        """List the projects that the token may read."""
        return self._each(self._sync.projects)

    async def create_project(self, project: str | ProjectCreate) -> AsyncProjectHandle:
        """Create a project with a name, or with the fields of `ProjectCreate`; the caller becomes its owner."""
        exchanged: AsyncProjectHandle = await self._exchange(self._sync.create_project, project)
        return exchanged

    def audit(self, **conditions: Unpack[AuditConditions]) -> AsyncIterator[AuditEntry]:
        """List the audit log of the server, newest entries first.

        The log records changes of users, tokens and access, and deletions, in all projects. Only administrators may
        read it. `AuditConditions` describes the conditions.
        """
        return self._each(self._sync.audit, **conditions)

    def workers(self) -> AsyncIterator[Worker]:
        """List the workers that the server knows, by name. Only administrators may list them.

        A server knows the workers that run jobs, and the workers that claimed jobs from it in the last 24 hours. If
        several servers share a database, workers that wait for jobs of another server are missing.
        """
        return self._each(self._sync.workers)

    @property
    def jobs(self) -> AsyncJobs:
        """The jobs of the server, each by its id."""
        exchanged: AsyncJobs = self._as_async(self._sync.jobs)
        return exchanged

    @property
    def blobs(self) -> AsyncBlobs:
        """The blobs (bytes identified by their digest) of the server."""
        exchanged: AsyncBlobs = self._as_async(self._sync.blobs)
        return exchanged

    @property
    def users(self) -> AsyncUsers:
        """The users of the server."""
        exchanged: AsyncUsers = self._as_async(self._sync.users)
        return exchanged

    @property
    def tokens(self) -> AsyncTokens:
        """The tokens of the caller; administrators also reach tokens of other users."""
        exchanged: AsyncTokens = self._as_async(self._sync.tokens)
        return exchanged


def connect_async(url: str | None = None, token: str | TokenFile | None = None) -> AsyncMarey:
    """Return a client of a server for async programs, by default of the server that the command line uses.

    Server and token are found as by `connect`. `AsyncMarey` takes further options. Raises the errors of `connect`.
    """
    return AsyncMarey(url, token)
