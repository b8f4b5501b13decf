"""Client of one server, with one token."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from types import TracebackType
from typing import Self, Unpack

import httpx
from pydantic import SecretStr

from marey_client.access import Tokens, Users
from marey_client.arguments import checked, checks_arguments
from marey_client.audit import AuditConditions, read_audit
from marey_client.blobs import Blobs
from marey_client.credentials import TokenFile, resolve
from marey_client.errors import BadArgument
from marey_client.jobs import Jobs
from marey_client.paging import pages
from marey_client.project import ProjectHandle
from marey_client.retries import Retries
from marey_client.transport import Transport, sends_nothing
from marey_schemas.access import Login, Me, NewToken, Project, ProjectCreate
from marey_schemas.audit import AuditEntry
from marey_schemas.invitations import AcceptedInvitation, InvitationAcceptance, SignedUp, SignUp
from marey_schemas.queue.workers import Worker
from marey_schemas.sign_ins import BrowserSignIn, BrowserSignInCode, BrowserSignInCreate


@checks_arguments
class Marey:
    """Client of a Marey server. Several threads may share a client; close it, or use it in a `with` block.

    Parameters
    ----------
    url : address of the server, such as `https://marey.example.org`; default: server and token from the environment or
        from `marey login`, as on the command line
    token : a personal token, or a `TokenFile`, which is read again when it changes; with a `url` and no token, only
        public projects can be read
    retries : how often, and for how long, requests that are safe to repeat are sent again
    timeout_s : longest time in seconds to wait for the next bytes of an answer
    http : HTTP transport that replaces the network in tests
    """

    @checks_arguments
    def __init__(
        self,
        url: str | None = None,
        token: str | TokenFile | None = None,
        *,
        retries: Retries | None = None,
        timeout_s: float = 60.0,
        http: httpx.BaseTransport | None = None,
    ) -> None:
        if url is None:
            known = resolve()
            url, token = known.url, token or known.bearer
        self.transport = Transport(url, token, retries=retries, timeout_s=timeout_s, http=http)

    def __repr__(self) -> str:
        return f"<Marey {self.transport.url}>"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close every connection."""
        self.transport.close()

    def sign_in(self, login: Login) -> NewToken:
        """Return a token for a name and a password."""
        return self.transport.post(NewToken, "/login", login, repeatable=False)

    def sign_up(self, request: SignUp) -> SignedUp:
        """Create an account with the invitation of an administrator; the answer contains a token, shown only once.

        The request is sent again if its answer is lost, because a repeated request has no further effect.
        """
        return self.transport.post(SignedUp, "/sign-up", request, repeatable=True)

    def begin_sign_in(self, request: BrowserSignInCreate) -> BrowserSignIn:
        """Begin a sign-in with the identity provider of the server; a person completes it in a browser.

        Raises `NotFound` if the server has no identity provider.
        """
        return self.transport.post(BrowserSignIn, "/sign-ins", request, repeatable=False)

    def finish_sign_in(self, sign_in: str, request: BrowserSignInCode) -> NewToken:
        """End a sign-in with the code that the browser got, and return its token.

        Raises `NotFound` if the code is wrong, or if the sign-in has expired.
        """
        return self.transport.post(NewToken, f"/sign-ins/{sign_in}/token", request, repeatable=False)

    def accept_invitation(self, code: str) -> AcceptedInvitation:
        """Become a member of a project with the code of an invitation.

        The request is sent again if its answer is lost. Raises `NotFound` if the code is not valid.
        """
        request = InvitationAcceptance(code=SecretStr(code))
        return self.transport.post(AcceptedInvitation, "/invitations/accept", request, repeatable=True)

    def me(self) -> Me:
        """Return the user and the scopes of the client's token."""
        return self.transport.get(Me, "/me")

    @sends_nothing
    def project(self, name: str) -> ProjectHandle:
        """Return a project by its name, without a request. Raises `BadArgument` for the path of a folder."""
        known, slash, path = name.partition("/")
        if slash:
            folder = f", and the folder {path!r} apart from it" if path else ""
            raise BadArgument(f"project: {name!r} is a path; give the name of the project, {known!r}{folder}")
        if name in ("", ".", ".."):
            raise BadArgument(f"project: {name!r} is not the name of a project; `marey project ls` lists the names")
        return ProjectHandle(self.transport, name)

    def projects(self) -> Iterator[Project]:
        """List the projects that the token may read."""
        return pages(self.transport, Project, "/projects")

    def create_project(self, project: str | ProjectCreate) -> ProjectHandle:
        """Create a project with a name, or with the fields of `ProjectCreate`; the caller becomes its owner."""
        wanted = checked(ProjectCreate, name=project) if isinstance(project, str) else project
        return self.project(self.transport.post(Project, "/projects", wanted).name)

    def audit(self, **conditions: Unpack[AuditConditions]) -> Iterator[AuditEntry]:
        """List the audit log of the server, newest entries first.

        The log records changes of users, tokens and access, and deletions, in all projects. Only administrators may
        read it. `AuditConditions` describes the conditions.
        """
        return read_audit(self.transport, "/audit", **conditions)

    def workers(self) -> Iterator[Worker]:
        """List the workers that the server knows, by name. Only administrators may list them.

        A server knows the workers that run jobs, and the workers that claimed jobs from it in the last 24 hours. If
        several servers share a database, workers that wait for jobs of another server are missing.
        """
        return pages(self.transport, Worker, "/workers")

    @cached_property
    def jobs(self) -> Jobs:
        """The jobs of the server, each by its id."""
        return Jobs(self.transport)

    @cached_property
    def blobs(self) -> Blobs:
        """The blobs (bytes identified by their digest) of the server."""
        return Blobs(self.transport)

    @cached_property
    def users(self) -> Users:
        """The users of the server."""
        return Users(self.transport)

    @cached_property
    def tokens(self) -> Tokens:
        """The tokens of the caller; administrators also reach tokens of other users."""
        return Tokens(self.transport)


@checks_arguments
def connect(url: str | None = None, token: str | TokenFile | None = None) -> Marey:
    """Return a client of a server, by default of the one that the command line uses.

    Without `url`, server and token come from `MAREY_SERVER` and `MAREY_TOKEN`, from `marey login`, or from the data
    folder of a server on this machine. `Marey` takes further options. Raises `BadAddress` if `url` is not the address
    of a server, and `BadCredentialFile` if the stored token cannot be read.
    """
    return Marey(url, token)
