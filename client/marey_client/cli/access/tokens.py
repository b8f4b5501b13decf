"""Commands of the group `token`: creating, listing, rotating and revoking tokens."""

from __future__ import annotations

import os
import secrets
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect, credential_of, output_option, refuse_ignored
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_schemas.sizes import DAY_S, LONGEST_TOKEN_DAYS
from marey_schemas.wording import counted

if TYPE_CHECKING:
    from marey_client.credentials import Credential
    from marey_client.marey import Marey
    from marey_schemas.access import NewToken, Token, TokenCreate

token = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Manage your tokens.")

SOON_DAYS = 14
"""For tokens that expire in fewer days than this, lists show the number of days left."""
RESERVED_BYTES = 1000
"""Number of bytes that are written to a file to reserve space for a token; no token is longer."""


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(token, name="token")


@token.command("create")
def create_token(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Purpose of the token, for your own reference.")],
    scope: Annotated[
        list[str] | None,
        typer.Option(
            help="Scope: read, write, jobs, work or admin. To limit a scope to one project, append !project= and "
            "the name of the project, as in read!project=lab. May be repeated. Default: read, write and "
            "jobs."
        ),
    ] = None,
    days: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=LONGEST_TOKEN_DAYS,
            help="Number of days for which the token is valid; 0: the token does not expire. Default: 90, but not "
            "longer than your own token.",
        ),
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(
            help="Label that a worker with this token may announce, as name=value; may be repeated. Allowed only if "
            "the token has the scope work. Default: the labels of your own token; if it has none, any label."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        output_option(
            "Write the secret to this new file, which only you can read, instead of the screen.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Create a token. Its secret is shown only once."""
    from marey_client.cli.terminal.typed_values import assignment
    from marey_schemas.access import TokenCreate

    given: dict[str, Any] = {"scopes": tuple(scope)} if scope else {}
    if days is not None:
        given["expires_in_s"] = days * DAY_S or None
    if label:
        given["labels"] = dict(map(assignment, label))
    wanted = TokenCreate(name=name, **given)
    with connect(context) as marey:
        made = marey.tokens.create(wanted) if output is None else _token_in_file(marey, wanted, output)
    if output is not None:
        print_message(f"token {made.id} is in {output}")
    elif as_json:
        print_json(made)
    else:
        print_message(f"token {made.id}, scopes {', '.join(made.scopes)}; it is not shown again:")
        typer.echo(made.secret)


def _token_in_file(marey: Marey, wanted: TokenCreate, path: Path) -> NewToken:
    """Create a token and write its secret to a new file; create no token if the file cannot be written."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        try:
            file.write(" " * RESERVED_BYTES)  # so that a full disk is noticed before the token is created
            file.flush()
            os.fsync(file.fileno())
            made = marey.tokens.create(wanted)
            file.seek(0)
            file.write(made.secret + "\n")
            file.truncate()
        except BaseException:
            path.unlink()
            raise
    return made


@token.command("ls")
def list_tokens(
    context: typer.Context,
    user: Annotated[
        str | None, typer.Option(help="List the tokens of this user (for administrators). Default: your own.")
    ] = None,
    everybody: Annotated[
        bool, typer.Option("--everybody", help="List the tokens of all users (for administrators).")
    ] = False,
    prefix: Annotated[
        str | None,
        typer.Option(help="List only the token whose secret begins with marey_PREFIX_, for example one that leaked."),
    ] = None,
    expiring: Annotated[
        int | None, typer.Option(min=0, help="List only tokens that expire within this number of days.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show your tokens, without their secrets.

    The column `scopes` shows what a token allows, and in which projects. The column `labels` shows the labels that a
    worker may announce with this token.
    """
    if everybody:
        refuse_ignored(context, "with --everybody", "user")
    within_s = None if expiring is None else expiring * DAY_S
    with connect(context) as marey:
        tokens = list(marey.tokens.list(user=user, everybody=everybody, prefix=prefix, ends_within_s=within_s))
    if as_json:
        return print_json(tokens)
    rows = [
        (one.id, one.user, one.name, one.prefix, " ".join(one.scopes), _labels_of(one), _end_of(one), one.last_used_at)
        for one in tokens
    ]
    return print_table(("id", "user", "name", "prefix", "scopes", "labels", "expires", "last used"), rows)


def _labels_of(token: Token) -> str:
    """Return the labels to which a token is bound, as text.

    The text is empty if the token is not bound to labels, and `none` if it is bound to an empty set of labels.
    """
    if token.labels is None:
        return ""
    return " ".join(f"{name}={value}" for name, value in sorted(token.labels.items())) or "none"


def _end_of(token: Token) -> str:
    """Return the expiry date of a token as text, with the number of days left if it is less than `SOON_DAYS`."""
    if token.expires_at is None:
        return "never"
    left = token.expires_at - datetime.now(UTC)
    shown = f"{token.expires_at:%Y-%m-%d}"
    if left.total_seconds() <= 0:
        return f"{shown} (expired)"
    return f"{shown} (in {counted(left.days, 'day')})" if left.days < SOON_DAYS else shown


@token.command("rotate")
def rotate_token(
    context: typer.Context,
    grace_minutes: Annotated[
        int,
        typer.Option(min=1, max=7 * 24 * 60, help="Minutes for which the replaced token stays valid."),
    ] = 60,
    as_json: AsJson = False,
) -> None:
    """Replace the token in use by a new token with the same rights and expiry; store the new token in the same file.

    The new token is not shown. If the command is interrupted, run it again: the server returns the same new token.
    """
    found = credential_of(context)
    with connect(context) as marey:
        made = _rotate_stored_token(marey, found, grace=timedelta(minutes=grace_minutes))
    if as_json:
        return print_json(made.model_dump(mode="json", exclude={"secret"}))
    return print_message(
        f"token {made.id} is in {found.file or found.logins}; {made.successor_of}, which it replaces, is valid for "
        f"{counted(grace_minutes, 'minute')} at most"
    )


def _rotate_stored_token(marey: Marey, credential: Credential, *, grace: timedelta) -> NewToken:
    """Replace the token that `marey` uses by a new token, on the server and in the file that contains the token.

    A random id of this replacement is stored next to the token's file before the request is sent. If the program ends
    before the new token is stored, the next call sends the same id and gets the same new token. Raises
    `BadCredentialFile` if no file contains the token.
    """
    from marey_client.access import Tokens
    from marey_client.credentials import replace_token
    from marey_client.errors import BadCredentialFile

    file = credential.file or credential.logins
    if file is None or credential.token is None:
        raise BadCredentialFile(
            f"the token comes from {credential.origin or 'no file'}, so its successor cannot be stored; write the "
            "token to a file that only you can read, and name the file with --token-file"
        )
    begun = file.with_name(f"{file.name}.rotation")
    tokens = Tokens(marey.transport.with_token(credential.token))
    made = tokens.rotate(_rotation_id(begun, credential.token), grace=grace)
    replace_token(credential, made.secret)
    begun.unlink()
    return made


def _rotation_id(begun: Path, token: str) -> str:
    """Return the id for the replacement of this token from the file `begun`; if the file has none, store a new id."""
    from marey_client.credentials import write_private

    prefix = token.split("_")[1] if token.count("_") > 1 else ""
    stored = begun.read_text(encoding="ascii").split() if begun.exists() else []
    if len(stored) == 2 and stored[0] == prefix:
        return stored[1]
    rotation_id = secrets.token_hex(16)
    write_private(begun, f"{prefix} {rotation_id}\n")
    return rotation_id


@token.command("rm", help="Revoke a token at once; the same as `marey token revoke`.")
@token.command("revoke")
def revoke_token(
    context: typer.Context,
    token_id: Annotated[str | None, typer.Argument(help="Id of the token; `marey token ls` lists the ids.")] = None,
    with_created: Annotated[
        bool, typer.Option("--with-created", help="Also revoke the tokens that were created with this token.")
    ] = False,
    all_of: Annotated[
        str | None,
        typer.Option(
            "--all-of",
            metavar="USER",
            help="Instead of one token, revoke all tokens of a user, except the token in use.",
        ),
    ] = None,
) -> None:
    """Revoke a token at once. Administrators may also revoke tokens of other users."""
    if (token_id is None) == (all_of is None):
        raise WrongUsage("give either the id of a token, or a user with --all-of")
    with connect(context) as marey:
        if all_of is not None:
            marey.users.end_tokens(all_of)
            return print_message(f"all tokens of {all_of} are revoked, except the one in use")
        assert token_id is not None
        marey.tokens.revoke(token_id, with_created=with_created)
    return print_message(f"{token_id} is revoked")
