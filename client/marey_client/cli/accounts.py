"""`login`, `token` and `user`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from marey_client.cli.failures import WrongUsage
from marey_client.cli.invocation import AsJson, connect
from marey_client.cli.output import print_json, print_pairs, print_table, tell

token = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Your tokens.")
user = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Users, for administrators.")

SECONDS_PER_DAY = 86_400


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    app.command()(login)
    app.command()(logout)
    app.add_typer(token, name="token")
    app.add_typer(user, name="user")


def login(
    context: typer.Context,
    name: Annotated[str | None, typer.Option(help="User name; asked for when left out.")] = None,
    with_token: Annotated[
        bool, typer.Option("--with-token", help="Read a token from standard input instead of asking for a password.")
    ] = False,
    days: Annotated[int, typer.Option(min=1, max=90, help="How long the login lasts.")] = 7,
) -> None:
    """Remember a server and a token for it, readable by you alone."""
    from marey_client.credentials import logins_path, store_login
    from marey_client.marey import Marey
    from marey_schemas.access import Login

    with connect(context, anonymous=True) as marey:
        url = marey.transport.url
        if with_token:
            secret = typer.get_text_stream("stdin").read().strip()
        else:
            who = name or typer.prompt("User name", err=True)
            password = typer.prompt(f"Password of {who} at {url}", hide_input=True, err=True)
            secret = marey.sign_in(Login(name=who, password=password, expires_in_s=days * SECONDS_PER_DAY)).secret
    with Marey(url, secret) as marey:
        me = marey.me()
    path = logins_path(os.environ)
    store_login(path, url, secret)
    tell(f"logged in to {url} as {me.user.name if me.user else 'nobody'}; the token is in {path}")


def logout(context: typer.Context) -> None:
    """Forget the token for a server."""
    from marey_client.credentials import forget_login, logins_path

    with connect(context, anonymous=True) as marey:
        url = marey.transport.url
    known = forget_login(logins_path(os.environ), url)
    tell(f"forgot the token for {url}" if known else f"no token is stored for {url}")


# -- tokens --


@token.command("create")
def create_token(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="What the token is for.")],
    scope: Annotated[
        list[str] | None, typer.Option(help="read, write, jobs, work or admin, perhaps with !project=NAME.")
    ] = None,
    days: Annotated[int, typer.Option(min=0, help="How long it lasts; 0 for ever.")] = 90,
    output: Annotated[
        Path | None, typer.Option(help="Write the secret to this file (0600), not to the screen.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a token. Its secret is shown once."""
    from marey_schemas.access import TokenCreate

    lasting = days * SECONDS_PER_DAY or None
    wanted = TokenCreate(name=name, expires_in_s=lasting, **({"scopes": tuple(scope)} if scope else {}))
    with connect(context) as marey:
        made = marey.tokens.create(wanted)
    if output is not None:
        with os.fdopen(os.open(output, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(made.secret + "\n")
        tell(f"token {made.id} is in {output}")
    elif as_json:
        print_json(made)
    else:
        tell(f"token {made.id}, scopes {', '.join(made.scopes)}; it is not shown again:")
        typer.echo(made.secret)


@token.command("ls")
def list_tokens(context: typer.Context, as_json: AsJson = False) -> None:
    """Show your tokens, without their secrets."""
    with connect(context) as marey:
        tokens = list(marey.tokens.list())
    if as_json:
        return print_json(tokens)
    rows = [(one.id, one.name, one.prefix, " ".join(one.scopes), one.expires_at, one.last_used_at) for one in tokens]
    return print_table(("id", "name", "prefix", "scopes", "expires", "last used"), rows)


@token.command("revoke")
def revoke_token(context: typer.Context, token_id: str) -> None:
    """Make a token useless, now."""
    with connect(context) as marey:
        marey.tokens.revoke(token_id)
    tell(f"{token_id} is revoked")


# -- users --


@user.command("create")
def create_user(
    context: typer.Context,
    name: str,
    display_name: Annotated[str | None, typer.Option(help="Name shown to people.")] = None,
    administrator: Annotated[bool, typer.Option("--administrator", help="May do everything everywhere.")] = False,
    without_password: Annotated[
        bool, typer.Option("--without-password", help="The user can sign in with tokens only.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Make a user; asks for the password, twice."""
    from marey_schemas.access import UserCreate

    password = None
    if not without_password:
        password = typer.prompt(f"Password for {name}", hide_input=True, confirmation_prompt=True, err=True)
    wanted = UserCreate(name=name, display_name=display_name, password=password, administrator=administrator)
    with connect(context) as marey:
        made = marey.users.create(wanted)
    if as_json:
        return print_json(made)
    return tell(f"user {made.name} exists now")


@user.command("ls")
def list_users(context: typer.Context, as_json: AsJson = False) -> None:
    """Show every user."""
    with connect(context) as marey:
        users = list(marey.users.list())
    if as_json:
        return print_json(users)
    rows = [
        (one.name, one.display_name, _yes(one.administrator), _yes(one.disabled), one.created_at.date())
        for one in users
    ]
    return print_table(("name", "shown as", "administrator", "disabled", "since"), rows)


@user.command("show")
def show_user(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="Left out: yourself.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show a user, or who you are."""
    with connect(context) as marey:
        found = marey.users.get(name) if name else marey.me()
    if as_json:
        return print_json(found)
    shown = found.model_dump(mode="json", exclude={"rev"})
    who = shown.pop("user", None)
    return print_pairs({**shown, **(who or {})}.items())


@user.command("password")
def change_password(
    context: typer.Context, name: Annotated[str | None, typer.Argument(help="Left out: yourself.")] = None
) -> None:
    """Set a new password; your own needs the current one."""
    from marey_schemas.access import UserChange

    with connect(context) as marey:
        me = marey.me().user
        who = name or (me.name if me else None)
        if who is None:
            raise WrongUsage("the token belongs to no user; say whose password to change")
        change = {"password": typer.prompt("New password", hide_input=True, confirmation_prompt=True, err=True)}
        if me is not None and who == me.name:
            change["current_password"] = typer.prompt("Current password", hide_input=True, err=True)
        marey.users.change(who, UserChange.model_validate(change))
    tell(f"the password of {who} is changed")


@user.command("disable")
def disable_user(context: typer.Context, name: str) -> None:
    """Take a user's access away; what they made stays."""
    with connect(context) as marey:
        marey.users.disable(name)
    tell(f"{name} is disabled")


def _yes(value: bool) -> str:
    return "yes" if value else ""
