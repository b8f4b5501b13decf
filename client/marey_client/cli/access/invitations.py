"""Commands `member` and `user` for invitations: creating, listing, withdrawing and accepting them."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.access.accounts import user
from marey_client.cli.projects import member
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, ProjectName, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_client.cli.terminal.secrets import ask_secret

if TYPE_CHECKING:
    from collections.abc import Sequence

    from marey_schemas.access import Role
    from marey_schemas.invitations import Invitation, NewInvitation

Days = Annotated[int, typer.Option(min=1, help="Number of days for which the invitation is valid, at most 30.")]
Uses = Annotated[int, typer.Option(min=1, help="Number of people who can use the invitation, at most 100.")]
Note = Annotated[
    str,
    typer.Option(
        help="Person or purpose that the invitation is for, for your own reference; "
        "lists of invitations show this text."
    ),
]
Named = Annotated[
    str, typer.Argument(metavar="PREFIX|ID", help="Prefix or id of the invitation, as in the list of invitations.")
]
RoleName = Annotated[
    str | None, typer.Option("--role", help="Role in the project: reader, contributor, maintainer or owner.")
]


def add_to(_app: typer.Typer) -> None:
    """Register the commands of this module in the groups `member` and `user`."""
    member.command("invite")(invite_member)
    member.command("invitations")(list_invitations)
    member.command("withdraw")(withdraw)
    member.command("accept")(accept)
    user.command("invite")(invite_person)
    user.command("invitations")(list_account_invitations)
    user.command("withdraw")(withdraw_account_invitation)


def invite_member(
    context: typer.Context,
    project_name: ProjectName,
    role: Annotated[str, typer.Option(help="Role of the new members: reader, contributor, maintainer or owner.")],
    days: Days = 7,
    uses: Uses = 1,
    note: Note = "",
    as_json: AsJson = False,
) -> None:
    """Invite users of the server to a project, and print the code of the invitation, which is never shown again.

    The invited person runs `marey member accept`.
    """
    wanted, lifetime = _role(role), _lifetime(days, uses)
    with connect(context) as marey:
        made = marey.project(project_name).invitations.create(wanted, lifetime=lifetime, uses=uses, note=note)
    _print_new(made, "marey member accept", as_json=as_json)


def list_invitations(context: typer.Context, project_name: ProjectName, as_json: AsJson = False) -> None:
    """List the open invitations to a project, without their codes."""
    with connect(context) as marey:
        found = list(marey.project(project_name).invitations.list())
    _print_list(found, as_json=as_json)


def withdraw(context: typer.Context, project_name: ProjectName, invitation: Named) -> None:
    """Withdraw an open invitation to a project, so that its code is not valid any more."""
    named = _named(invitation)
    with connect(context) as marey:
        marey.project(project_name).invitations.withdraw(named)
    print_message(f"the invitation {named} is withdrawn")


def accept(context: typer.Context, as_json: AsJson = False) -> None:
    """Become a member of a project by an invitation; the command asks for the code, or reads it from standard input."""
    with connect(context) as marey:
        found = marey.accept_invitation(ask_secret("Invitation code"))
    if as_json:
        return print_json(found)
    if found.joined:
        return print_message(f"you are {found.role} of {found.project}")
    return print_message(f"you are {found.role} of {found.project} already; the invitation was not used")


def invite_person(
    context: typer.Context,
    project_name: Annotated[
        str | None,
        typer.Option(
            "--project", help="Project that the new users join as members, with the role of --role. Default: none."
        ),
    ] = None,
    role: RoleName = None,
    days: Days = 7,
    uses: Uses = 1,
    note: Note = "",
    as_json: AsJson = False,
) -> None:
    """Invite people who have no account, and print the code of the invitation, which is never shown again.

    The invited person runs `marey login --invitation` and chooses a user name and a password.
    """
    if (project_name is None) != (role is None):
        raise WrongUsage("--project and --role belong together; give both, or neither")
    wanted, lifetime = None if role is None else _role(role), _lifetime(days, uses)
    with connect(context) as marey:
        made = marey.users.invitations.create(project_name, wanted, lifetime=lifetime, uses=uses, note=note)
    _print_new(made, "marey login --invitation", as_json=as_json)


def list_account_invitations(context: typer.Context, as_json: AsJson = False) -> None:
    """List the open invitations to create an account, without their codes."""
    with connect(context) as marey:
        found = list(marey.users.invitations.list())
    _print_list(found, as_json=as_json)


def withdraw_account_invitation(context: typer.Context, invitation: Named) -> None:
    """Withdraw an open invitation to create an account, so that its code is not valid any more."""
    named = _named(invitation)
    with connect(context) as marey:
        marey.users.invitations.withdraw(named)
    print_message(f"the invitation {named} is withdrawn")


def _role(text: str) -> Role:
    """Return the role that an option names. Raises `WrongUsage` for another text."""
    from marey_schemas.access import Role

    if text not in list(Role):
        raise WrongUsage(f"{text!r} is not a role; the roles are {', '.join(Role)}")
    return Role(text)


def _lifetime(days: int, uses: int) -> timedelta:
    """Return the days of the option --days as a duration. Raises `WrongUsage` if --days or --uses is too large."""
    from marey_schemas.invitations import MAX_DAYS, MAX_USES

    for option, given, most in (("--days", days, MAX_DAYS), ("--uses", uses, MAX_USES)):
        if given > most:
            raise WrongUsage(f"{option} {given} is too many; give at most {most}")
    return timedelta(days=days)


def _named(text: str) -> str:
    """Return `text`, which is the prefix or id of an invitation and becomes part of a URL.

    Raises `WrongUsage` if `text` is the code of an invitation: a code is a secret and must not become part of a URL.
    """
    from marey_schemas.invitations import CODE_PREFIX

    if text.startswith(CODE_PREFIX):
        raise WrongUsage(
            "this is the secret code of an invitation; give the prefix or the id that the list of invitations shows"
        )
    return text


def _print_new(made: NewInvitation, command: str, *, as_json: bool) -> None:
    if as_json:
        return print_json(made)
    print_pairs([("invitation", made.id), ("prefix", made.prefix), ("code", made.code)])
    return print_message(
        f"send the code to the invited person, who enters it in {command}; the server never shows it again"
    )


def _print_list(found: Sequence[Invitation], *, as_json: bool) -> None:
    if as_json:
        return print_json(found)
    rows = [
        (one.id, one.prefix, one.project, one.role, one.inviter, one.expires_at, one.uses_left, one.note)
        for one in found
    ]
    return print_table(("id", "prefix", "project", "role", "invited by", "valid until", "uses left", "note"), rows)
