"""Users, tokens, projects and members in requests and answers."""

from datetime import datetime
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import Field, SecretStr, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.names import ProjectName, UserName, form
from marey_schemas.sizes import DAY_S, LOGIN_DAYS, LONGEST_LOGIN_DAYS, LONGEST_TOKEN_DAYS

MOST_RUNNING = 1_000_000
"""Greatest value of the limit of a project's running jobs."""


class Role(StrEnum):
    """Role of a member in a project; each role includes the rights of the roles listed before it."""

    READER = "reader"
    CONTRIBUTOR = "contributor"
    MAINTAINER = "maintainer"
    OWNER = "owner"


class Visibility(StrEnum):
    """Visibility of a project to users who are not members: private or public."""

    PRIVATE = "private"
    PUBLIC = "public"


class Scope(StrEnum):
    """Permission that a token grants; a token never permits more than its user may do."""

    READ = "read"
    WRITE = "write"
    JOBS = "jobs"
    WORK = "work"
    ADMIN = "admin"


class EndTokens(StrEnum):
    """Tokens that a change of a user revokes: none, `sessions` (the tokens of sign-ins), or all.

    The token that authenticates the request always stays valid.
    """

    NONE = "none"
    SESSIONS = "sessions"
    ALL = "all"


DisplayName = Annotated[str, StringConstraints(min_length=1, max_length=255)]
Password = Annotated[SecretStr, Field(min_length=10, max_length=1024)]
LoginSeconds = Annotated[int, Field(ge=60, le=LONGEST_LOGIN_DAYS * DAY_S)]
_SCOPE = form(
    rf"^(?:{'|'.join(Scope)})(?:!project=[a-z0-9_-]{{1,64}})?$",
    f"be one of the scopes {', '.join(Scope)}, alone or with a project, as in write!project=walk",
)
ScopeText = Annotated[str, StringConstraints(pattern=_SCOPE)]
"""Scope of a token, optionally limited to one project, as in `write!project=walk`."""


class UserCreate(Request):
    """Request to create a user. Without a password, the user signs in with a token or an identity provider."""

    name: UserName
    display_name: DisplayName | None = None
    password: Password | None = None
    administrator: bool = False


class UserChange(Request):
    """Request to change a user; absent fields stay unchanged.

    Users who change their own password must also send the current one.
    """

    display_name: DisplayName | None = None
    password: Password | None = None
    current_password: SecretStr | None = None
    administrator: bool | None = None
    disabled: bool | None = None
    end_tokens: EndTokens | None = Field(
        None,
        description="Tokens of the user to revoke: `none`, `sessions` (the tokens of sign-ins) or `all`. The token of "
        "this request is never revoked. Default with a new password: `sessions`.",
    )


class User(Answer):
    """A person or a service that signs in."""

    id: str
    name: str
    display_name: str | None = None
    administrator: bool
    disabled: bool
    created_at: datetime
    last_seen_at: datetime | None = Field(
        None,
        description="Time, to the hour, when a token or an identity of the user was last used; uses of tokens "
        "that were deleted later do not count. Only the list of users contains this time, which "
        "administrators may read. Null: there was no use, or the answer is not this list.",
    )
    rev: int


class Me(Answer):
    """The caller, and the rights of the token that authenticates the request."""

    user: User | None
    scopes: tuple[str, ...]
    job: str | None = Field(
        None,
        description="The id of the job for which the server made the token, for one attempt; null for tokens of users.",
    )
    expires_at: datetime | None = Field(
        None, description="Time at which the token of this request ends; null: it never ends."
    )
    token: str | None = Field(None, description="The id of the token of this request; null for tokens of attempts.")


class TokenCreate(Request):
    """Request to create a token for the caller."""

    name: DisplayName
    scopes: tuple[ScopeText, ...] = Field(("read", "write", "jobs"), min_length=1, max_length=32)
    expires_in_s: int | None = Field(
        90 * DAY_S,
        ge=60,
        le=LONGEST_TOKEN_DAYS * DAY_S,
        description="Seconds until the token ends; null: it never ends. A token cannot end later than the token that "
        "creates it. If absent, the token ends after 90 days, or when the token that creates it ends, whichever is "
        "sooner.",
    )
    labels: dict[str, str] | None = Field(
        None,
        description="Labels that a worker with this token may announce, by name; only for tokens with the scope "
        "`work`. Jobs that require other labels cannot be claimed with this token. Null: the labels of the token "
        "that creates this token, or any labels if that token is not restricted to labels.",
    )


class TokenRotation(Request):
    """Request to replace the token that authenticates this request; the new token has the same rights and expiry."""

    rotation_id: str = Field(
        pattern=form(r"^[A-Za-z0-9_-]{32,64}$", "have 32 to 64 letters, digits, - and _"),
        description="Random text, for example 32 hexadecimal digits. A repeated request with the same `rotation_id` "
        "gets the same new token. Keep this text secret until you have the answer.",
    )
    grace_s: int = Field(
        3600,
        ge=60,
        le=7 * DAY_S,
        description="Seconds for which the replaced token remains valid; it never remains valid after its expiry.",
    )


class Token(Answer):
    """Token of a user: scopes, expiry and use, without its secret."""

    id: str
    name: str
    prefix: str
    scopes: tuple[str, ...]
    created_at: datetime
    expires_at: datetime | None
    last_used_at: datetime | None = Field(None, description="The latest use, to the hour; null if it was never used.")
    user: str | None = Field(None, description="The name of the user to whom the token belongs.")
    session: bool = Field(False, description="Whether a sign-in created the token.")
    created_by: str | None = Field(
        None,
        description="The id of the token that authorised the creation of this token; null if a sign-in or the server "
        "created this token.",
    )
    labels: dict[str, str] | None = Field(
        None, description="The labels that a worker with this token may announce; null: any."
    )
    successor_of: str | None = Field(
        None, description="The id of the token that this token replaced in a rotation; null: it replaced none."
    )


class NewToken(Token):
    """New token with its secret, which is shown only once."""

    secret: str


class Login(Request):
    """Request to sign in with a name and a password."""

    name: UserName
    password: SecretStr
    expires_in_s: LoginSeconds = LOGIN_DAYS * DAY_S


class ProjectCreate(Request):
    """Request to create a project; the caller becomes its owner."""

    name: ProjectName
    title: DisplayName | None = None
    description: str = Field("", max_length=10_000)
    visibility: Visibility = Visibility.PRIVATE


class ProjectChange(Request):
    """Request to change a project; absent fields stay unchanged."""

    title: DisplayName | None = None
    description: str | None = Field(None, max_length=10_000)
    visibility: Visibility | None = None


class Project(Answer):
    """A project: the items, jobs and members of a team."""

    id: str
    name: str
    title: str | None = None
    description: str = ""
    visibility: Visibility
    role: Role | None = Field(None, description="The caller's role; null for a guest of a public project.")
    created_at: datetime
    updated_at: datetime
    deleted_at: datetime | None = None
    most_running_jobs: int | None = Field(
        None,
        description="Greatest number of the project's jobs that may run at the same time, as set by an "
        "administrator. Null: there is no limit, or the caller is not a member.",
    )
    rev: int


class QuotaChange(Request):
    """Change of the limits of one project or one user.

    An absent limit stays as it is; null means the limit in the server's settings.
    """

    items: int | None = Field(
        None,
        ge=0,
        le=2**53,
        description="Largest number of items; absent: unchanged; null: the limit in the server's settings.",
    )
    stored_bytes: int | None = Field(
        None,
        ge=0,
        le=2**53,
        description="Largest total size of all revisions of the items, in bytes; absent: "
        "unchanged; null: the limit in the server's settings.",
    )


class ProjectQuotaChange(QuotaChange):
    """Change of the limits of one project.

    An absent limit stays as it is; null means the limit in the server's settings, or no limit of running jobs.
    """

    running_jobs: int | None = Field(
        None,
        ge=0,
        le=MOST_RUNNING,
        description="Greatest number of the project's jobs that workers run at the same time; null: no limit. A "
        "lower limit does not stop jobs that are running.",
    )


class QuotaUse(Answer):
    """Used amount of one quota, such as the number of items, and its limit."""

    used: int
    allowed: int


class QuotasInUse(Answer):
    """Used amounts and limits of the quotas of a project or a user. Deleted items do not count."""

    items: QuotaUse
    stored_bytes: QuotaUse


class RunningJobs(Answer):
    """Number of jobs that workers run, and its limit."""

    used: int
    allowed: int | None = Field(None, description="Greatest number of jobs that run at the same time; null: no limit.")


class ProjectQuotasInUse(QuotasInUse):
    """Used amounts and limits of the quotas of a project."""

    running_jobs: RunningJobs | None = Field(
        None,
        description="Number of the project's jobs that workers run, and its limit. A job that is divided into "
        "tasks does not count, but its tasks do. Null: the server has an earlier version, which does "
        "not report it.",
    )


class MemberChange(Request):
    """Request to add a user to a project with a role, or to change the role of a member."""

    role: Role


class Member(Answer):
    """A user's role in a project."""

    user: str
    role: Role
    since: datetime
    rev: int


EVERY_MEMBER = "*"
"""User name that means all members, in requests that set a role in a folder."""


class FolderRoleChange(Request):
    """Request to set the role of a member, or of all members, in a folder and everything below it."""

    role: Literal[Role.READER, Role.CONTRIBUTOR, Role.MAINTAINER]


class FolderRole(Answer):
    """Role of a member in a folder and everything below it, where it replaces the member's role in the project."""

    user: str = Field(
        description="The name of the member; `*` means all members without a role of their own in this folder, "
        "except owners."
    )
    folder: str = Field(description="The path of the folder.")
    collection: str = Field(description="The id of the folder.")
    role: Role
    since: datetime
    rev: int
