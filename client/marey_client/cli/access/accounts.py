"""Commands `login` and `logout`, and the group `user` for accounts."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.projects import ByteLimit, DefaultLimits, ItemLimit, changed_limits, print_quotas
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, UserName, connect, refuse_ignored
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_client.cli.terminal.secrets import ask_secret
from marey_schemas.sizes import DAY_S, LOGIN_DAYS, LONGEST_LOGIN_DAYS

if TYPE_CHECKING:
    from marey_client.marey import Marey
    from marey_schemas.access import User

user = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Manage users (for administrators).")


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.command()(login)
    app.command()(logout)
    app.add_typer(user, name="user")


def login(
    context: typer.Context,
    name: Annotated[
        str | None, typer.Option(help="Name of the user who signs in. Default: the command asks for it.")
    ] = None,
    with_token: Annotated[
        bool, typer.Option("--with-token", help="Read a token from standard input instead of asking for a password.")
    ] = False,
    invitation: Annotated[
        bool,
        typer.Option(
            "--invitation",
            help="Create an account with the invitation of an administrator; the command asks for the code, a new user "
            "name and a new password.",
        ),
    ] = False,
    browser: Annotated[
        bool,
        typer.Option(
            "--browser", help="Sign in with the identity provider of your team, in a browser, instead of a password."
        ),
    ] = False,
    paste: Annotated[
        bool,
        typer.Option(
            "--paste",
            help="With --browser, for a browser on another machine: the command asks for the code that the browser "
            "shows.",
        ),
    ] = False,
    days: Annotated[
        int,
        typer.Option(
            min=1,
            max=LONGEST_LOGIN_DAYS,
            help="Number of days for which the login is valid; with --browser, the server may allow fewer.",
        ),
    ] = LOGIN_DAYS,
) -> None:
    """Log in to a server, and store the server's address and a token in a file that only you can read."""
    from marey_client.credentials import logins_path, store_login
    from marey_client.marey import Marey
    from marey_schemas.access import Login

    if with_token + invitation + browser > 1:
        raise WrongUsage("give only one of --with-token, --invitation and --browser")
    if (paste and not browser) or (browser and name is not None):
        raise WrongUsage(
            "--paste needs --browser, and --name cannot be combined with --browser, because the identity provider "
            "determines the user"
        )
    if with_token:
        refuse_ignored(context, "with --with-token", "name", "days")
    with connect(context, anonymous=True) as marey:
        url = marey.transport.url
        if with_token:
            secret = typer.get_text_stream("stdin").read().strip()
            if not secret:
                raise WrongUsage("standard input contains no token; write marey login --with-token < FILE")
        elif browser:
            from marey_client.cli.access.browser_login import sign_in_in_browser

            secret = sign_in_in_browser(marey, days * DAY_S, paste=paste)
        elif invitation:
            secret = _sign_up(marey, name, days)
        else:
            who = name or _ask_name()
            password = ask_secret(f"Password of {who} at {url}")
            secret = marey.sign_in(Login(name=who, password=password, expires_in_s=days * DAY_S)).secret
    with Marey(url, secret) as marey:
        me = marey.me()
    path = logins_path(os.environ)
    store_login(path, url, secret)
    owner = f"as {me.user.name}" if me.user else "with a token of no user"
    print_message(f"logged in to {url} {owner}; the token is in {path}")


def _sign_up(marey: Marey, name: str | None, days: int) -> str:
    """Create an account with an invitation, print the user and the project, if any, and return a token."""
    from marey_schemas.invitations import SignUp

    url = marey.transport.url
    code = ask_secret(f"Invitation code for {url}")
    who = name or _ask_name()
    password = ask_secret(f"New password for {who} at {url}", twice=True)
    made = marey.sign_up(SignUp(code=code, name=who, password=password, expires_in_s=days * DAY_S))
    print_message(f"user {who} is created" + (f", as {made.role} of {made.project}" if made.project else ""))
    return made.secret


def logout(context: typer.Context) -> None:
    """Delete the stored token for a server from this machine. The token stays valid until it ends or is revoked."""
    from marey_client.credentials import forget_login, logins_path

    with connect(context, anonymous=True) as marey:
        url = marey.transport.url
    known = forget_login(logins_path(os.environ), url)
    print_message(f"the stored token for {url} is deleted" if known else f"no token is stored for {url}")


# -- users --


@user.command("create")
def create_user(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name that the user signs in with.")],
    display_name: Annotated[str | None, typer.Option(help="Name that is shown to other users. Default: none.")] = None,
    administrator: Annotated[
        bool, typer.Option("--administrator", help="Make the user an administrator, with all rights.")
    ] = False,
    without_password: Annotated[
        bool,
        typer.Option(
            "--without-password",
            help="Create the user without a password; the user signs in with a token or an identity provider.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Create a user; the command asks for the password twice."""
    from marey_schemas.access import UserCreate

    wanted = UserCreate(name=name, display_name=display_name, administrator=administrator)
    if not without_password:  # a name that is not valid has been refused before
        password = ask_secret(f"Password for {name}", twice=True)
        wanted = UserCreate(name=name, display_name=display_name, password=password, administrator=administrator)
    with connect(context) as marey:
        made = marey.users.create(wanted)
    if as_json:
        return print_json(made)
    return print_message(f"user {made.name} is created")


@user.command("ls")
def list_users(context: typer.Context, as_json: AsJson = False) -> None:
    """List the users of the server (for administrators)."""
    with connect(context) as marey:
        users = list(marey.users.list())
    if as_json:
        return print_json(users)
    rows = [
        (
            one.name,
            one.display_name,
            _yes(one.administrator),
            _yes(one.disabled),
            one.created_at.date(),
            _seen(one),
        )
        for one in users
    ]
    return print_table(("name", "shown as", "administrator", "disabled", "since", "last seen"), rows)


def _seen(one: User) -> str:
    return "" if one.last_seen_at is None else f"{one.last_seen_at:%Y-%m-%d %H} h"


@user.command("show")
def show_user(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="User name; default: yourself.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show a user: names, rights and state; default: yourself."""
    with connect(context) as marey:
        found = marey.users.get(name) if name else marey.me()
    if as_json:
        return print_json(found)
    shown = found.model_dump(mode="json", exclude={"rev"})
    who = shown.pop("user", None)
    return print_pairs({**shown, **(who or {})}.items())


@user.command("password")
def change_password(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="User name; default: yourself.")] = None,
    end_tokens: Annotated[
        bool,
        typer.Option(
            "--end-tokens",
            help="Revoke all tokens of the user, except the token in use. Without this option, only the tokens that "
            "`marey login` made are revoked.",
        ),
    ] = False,
) -> None:
    """Set a new password, and end the user's other logins. For your own password, enter the current password, too."""
    from marey_schemas.access import EndTokens, UserChange

    with connect(context) as marey:
        me = marey.me().user
        who = name or (me.name if me else None)
        if who is None:
            raise WrongUsage(
                "the token in use does not belong to a user; give the name of the user whose password you want to set"
            )
        change: dict[str, Any] = {"password": ask_secret("New password", twice=True)}
        if end_tokens:
            change["end_tokens"] = EndTokens.ALL
        if me is not None and who == me.name:
            change["current_password"] = ask_secret("Current password")
        marey.users.change(who, UserChange.model_validate(change))
    print_message(f"the password of {who} is changed")


@user.command("disable")
def disable_user(context: typer.Context, name: UserName) -> None:
    """Disable a user: password, tokens and sign-ins do not work any more, and schedules pause. The data is kept."""
    with connect(context) as marey:
        marey.users.disable(name)
    print_message(f"{name} is disabled; to undo this, run marey user enable {name}")


@user.command("enable")
def enable_user(context: typer.Context, name: UserName) -> None:
    """Enable a disabled user again, with the same password and tokens. The user's schedules stay paused."""
    with connect(context) as marey:
        marey.users.enable(name)
    print_message(f"{name} is enabled")


@user.command("change")
def change_user(
    context: typer.Context,
    name: UserName,
    display_name: Annotated[
        str | None, typer.Option(help="New name that is shown to other users. Default: unchanged.")
    ] = None,
    administrator: Annotated[
        bool | None,
        typer.Option(help="Grant the user the rights of an administrator, or revoke them. Default: unchanged."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Change the displayed name and the administrator rights of a user."""
    from marey_schemas.access import UserChange

    given = {"display_name": display_name, "administrator": administrator}
    change = UserChange.model_validate({key: value for key, value in given.items() if value is not None})
    if not change.model_fields_set:
        raise WrongUsage("nothing to change; give --display-name, --administrator or both")
    with connect(context) as marey:
        changed = marey.users.change(name, change)
    if as_json:
        return print_json(changed)
    return print_message(f"user {changed.name} is changed")


@user.command("link")
def link_user(
    context: typer.Context,
    name: UserName,
    subject: Annotated[
        str,
        typer.Argument(help="Id of the person at the identity provider; the message of a refused sign-in shows it."),
    ],
    issuer: Annotated[
        str | None, typer.Option(help="Address of the identity provider; default: the provider of the server.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Let a person at an identity provider sign in as a user (for administrators)."""
    from marey_schemas.sign_ins import IdentityLink

    with connect(context) as marey:
        made = marey.users.link(name, IdentityLink(subject=subject, issuer=issuer))
    if as_json:
        return print_json(made)
    return print_message(f"{subject} at {made.issuer} can sign in as {name}; the link is {made.id}")


@user.command("links")
def list_links(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="User name; default: yourself.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show the people at identity providers who can sign in as a user; default: yourself."""
    with connect(context) as marey:
        me = None if name else marey.me().user
        who = name or (me.name if me else None)
        if who is None:
            raise WrongUsage("the token in use does not belong to a user; give the name of a user")
        found = list(marey.users.identities(who))
    if as_json:
        return print_json(found)
    rows = [(one.id, one.issuer, one.subject, one.created_at.date(), one.last_used_at) for one in found]
    return print_table(("id", "identity provider", "person", "since", "last sign-in"), rows)


@user.command("unlink")
def unlink_user(
    context: typer.Context,
    name: UserName,
    link: Annotated[str, typer.Argument(help="Id of the link; `marey user links` lists the ids.")],
) -> None:
    """Remove the link between a person at an identity provider and a user, and end all logins of the user.

    Only administrators may do this.
    """
    with connect(context) as marey:
        marey.users.unlink(name, link)
    print_message(f"the link {link} and all logins of {name} have ended")


@user.command("quota")
def user_quota(
    context: typer.Context,
    name: UserName,
    items: ItemLimit = None,
    stored_bytes: ByteLimit = None,
    defaults: DefaultLimits = False,
    as_json: AsJson = False,
) -> None:
    """Show a user's quotas: the number of items and bytes in use, and the limits. Administrators can change limits."""
    from marey_schemas.access import QuotaChange

    wanted = changed_limits(defaults, items=items, stored_bytes=stored_bytes)
    with connect(context) as marey:
        users = marey.users
        found = users.change_quotas(name, QuotaChange.model_validate(wanted)) if wanted else users.quotas(name)
    if as_json:
        return print_json(found)
    return print_quotas(found)


def _ask_name() -> str:
    if not sys.stdin.isatty():
        raise WrongUsage(
            "the command cannot ask for the user name, because standard input is not a terminal; give --name, or use "
            "--with-token"
        )
    return str(typer.prompt("User name", err=True))


def _yes(value: bool) -> str:
    return "yes" if value else ""
