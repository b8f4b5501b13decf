"""Global options of `marey`, and the connection to the server that they name."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator

    from marey_client.credentials import Credential
    from marey_client.marey import Marey

ProjectName = Annotated[str, typer.Argument(help="Name of the project; `marey project ls` lists all names.")]
UserName = Annotated[str, typer.Argument(help="Name of the user; `marey user ls` lists all names.")]
JobId = Annotated[str, typer.Argument(help="Id of the job; `marey job ls` lists the ids.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
QueryText = Annotated[
    str | None,
    typer.Option(
        "--query",
        "-q",
        help="Select only items that meet a query, such as 'subject = 02 and frames > 120', including items in "
        "subfolders. The fields are listed in the reference of queries, in the documentation.",
    ),
]
AllowExpiredConsent = Annotated[
    str | None,
    typer.Option(
        metavar="REASON",
        help="Export clips although the consent of the performer has ended. The server records the reason; requires "
        "the role maintainer.",
    ),
]


def output_option(help: str) -> Any:  # noqa: A002
    """Return the option that names the file or folder to write, which all commands spell alike."""
    return typer.Option("--out", "--output", "-o", help=help)


@dataclass(frozen=True)
class Invocation:
    """Values of the global options of `marey` in one call: server, token file, and verbosity."""

    server: str | None
    token_file: Path | None
    verbose: bool


MOST_PROJECTS = 1000
"""Greatest number of projects whose names are compared with a misspelt name."""
NO_OPTIONS = Invocation(None, None, False)


def credential_of(context: typer.Context) -> Credential:
    """Return the server and the token, as given by options, by the environment, or by an earlier `marey login`."""
    from marey_client.credentials import resolve

    given = context.find_object(Invocation) or NO_OPTIONS
    return resolve(given.server, given.token_file)


def refuse_ignored(context: typer.Context, when: str, *names: str) -> None:
    """Raise `WrongUsage` if the user has given an option that would have no effect.

    `names` are the names of the options' parameters. `when` is a part of the error text, such as "without --out".
    """
    from marey_client.cli.terminal.failures import WrongUsage

    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name) if parameter.name in names else None
        if source is not None and source.name == "COMMANDLINE":
            raise WrongUsage(f"{parameter.opts[0]} has no effect {when}; leave it out")


@contextmanager
def connect_other(url: str | None, token_file: Path | None, first: Marey) -> Iterator[Marey]:
    """Return a connection to the other server of a command, at `url`; without `url`, the connection `first`."""
    from marey_client.cli.terminal.failures import WrongUsage
    from marey_client.credentials import resolve_other
    from marey_client.errors import Unauthenticated
    from marey_client.marey import Marey

    if url is None:
        if token_file is not None:
            raise WrongUsage("--other-token-file is for another server; name that server with --to or --from")
        yield first
        return
    found = resolve_other(url, token_file)
    with Marey(found.url, found.bearer) as marey:
        try:
            yield marey
        except Unauthenticated as error:
            error.add_note(f"if {found.url} refused the token: `marey login --server {found.url}` stores a new token")
            raise


@contextmanager
def connect(context: typer.Context, *, anonymous: bool = False) -> Iterator[Marey]:
    """Return a connection to the server named by the options, the environment or `marey login`."""
    from marey_client.errors import Forbidden, NotFound, Unauthenticated
    from marey_client.marey import Marey

    if (context.find_object(Invocation) or NO_OPTIONS).verbose:
        import logging

        logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    from marey_client.cli.terminal.output import print_message
    from marey_client.retries import Retries

    found = credential_of(context)
    with Marey(found.url, None if anonymous else found.bearer, retries=Retries(notice=print_message)) as marey:
        try:
            yield marey
        except Unauthenticated as error:
            if found.origin and not anonymous:
                error.add_note(f"the token comes from {found.origin}; marey login creates a new one")
            raise
        except NotFound as error:
            if error.code == "no-project" and not error.anonymous:
                error.add_note(_nearest_project(marey, str(error.context.get("project", ""))))
            if error.code in _LISTED:
                error.add_note(_LISTED[error.code])
            if error.code == "not-found" and (path := urlsplit(found.url).path):
                error.add_note(f"the address of the server, {found.url}, may be right without {path}")
            raise
        except Forbidden as error:
            if error.code == "insufficient-scope" and found.origin:
                error.add_note(f"the token comes from {found.origin}; marey login creates one with all your rights")
            raise


_LISTED = {
    "no-job": "`marey job ls PROJECT` lists the jobs of a project",
    "no-user": "`marey user ls` lists the users, for administrators",
    "no-dataset": "`marey dataset ls PROJECT` lists the datasets of a project",
    "no-script": "`marey script ls PROJECT` lists the scripts of a project",
    "no-schedule": "`marey schedule ls PROJECT` lists the schedules of a project",
    "no-webhook": "`marey webhook ls PROJECT` lists the webhooks of a project",
}
"""Advice on how to find what does not exist, by the code of the error."""


def _nearest_project(marey: Marey, name: str) -> str:
    """Return advice for the name of a project that does not exist: the most similar name, or how to list all."""
    from itertools import islice

    from marey_schemas.wording import nearest

    near = nearest(name, (one.name for one in islice(marey.projects(), MOST_PROJECTS)))
    return f"did you mean {near}?" if near else "`marey project ls` lists the projects that you may see"
