"""The application behind the command `marey`, with the commands of all modules and the global options."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperGroup
from typer.main import get_command_name
from typer.models import CommandInfo

from marey_client.cli import (
    audit,
    clip_jobs,
    comparisons,
    doctor,
    evaluations,
    holdings,
    improvements,
    lineage,
    models,
    organise,
    processes,
    projects,
    purging,
    searches,
    skeletons,
    viewing,
    webhooks,
)
from marey_client.cli.access import accounts, invitations, tokens, user_tables
from marey_client.cli.completion.shells import SCRIPTS
from marey_client.cli.datasets import archives, proposals, versions
from marey_client.cli.difference import diff
from marey_client.cli.editing import annotating, edits
from marey_client.cli.files import downloading, listing, records, uploading
from marey_client.cli.operation import bench, capacity, costs
from marey_client.cli.perception import metrics, quality
from marey_client.cli.queue import jobs, pipelines, schedules, scripts
from marey_client.cli.studies import conducting, results
from marey_client.cli.terminal.failures import usage_in_plain_words
from marey_client.cli.terminal.invocation import Invocation
from marey_schemas.address import ADMIN_TOKEN_FILE, SERVER_VARIABLES

OTHER_NAMES = {
    "cancel": "job cancel",
    "clip": "ls",
    "clips": "ls",
    "delete": "rm",
    "export": "download",
    "get": "download",
    "health": "ready",
    "import": "upload",
    "info": "show",
    "init": "project create",
    "jobs": "job ls",
    "list": "ls",
    "move": "mv",
    "play": "view",
    "query": "ls --query",
    "remove": "rm",
    "rename": "mv",
    "skeletons": "ls --kind skeleton",
    "start": "serve",
    "status": "ready",
    "undelete": "restore",
    "undo": "revert",
    "users": "user ls",
    "version": "--version",
    "whoami": "user show",
}
"""Suggested command of `marey`, by the name of the similar command of another program that a user may type."""


class CommandGroup(TyperGroup):
    """Command group that suggests a command if the user types the name of a similar command of another program."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Return the name of the command, the command, and its arguments; fail if there is no such command."""
        if args[0] == "help":
            ctx.fail(f"No such command 'help'. Type: {' '.join(['marey', *args[1:], '--help'])}")
        if args[0] not in self.commands and args[0].lower() in self.commands:
            ctx.fail(f"No such command {args[0]!r}. Type: marey {args[0].lower()}")
        if args[0] not in self.commands and args[0] in OTHER_NAMES:
            ctx.fail(f"No such command {args[0]!r}. Type: marey {OTHER_NAMES[args[0]]}")
        groups = [name for name, one in self.commands.items() if args[0] in getattr(one, "commands", ())]
        if args[0] not in self.commands and groups:
            ctx.fail(f"No such command {args[0]!r}. Type: {' or '.join(f'marey {one} {args[0]}' for one in groups)}")
        return super().resolve_command(ctx, args)

    def make_context(self, *given: Any, **more: Any) -> Any:
        """Parse the global options of `marey`; errors are in plain words."""
        with usage_in_plain_words():
            return super().make_context(*given, **more)

    def invoke(self, ctx: Any) -> Any:
        """Parse the arguments of the command, and run it; errors of usage are in plain words."""
        with usage_in_plain_words():
            return super().invoke(ctx)


app = typer.Typer(
    name="marey",
    cls=CommandGroup,
    help="Motion data and model management.",
    no_args_is_help=True,
    rich_markup_mode=None,
    add_completion=False,  # its scripts add a space after each folder; see `completion`
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


UNTRACED = ("serve", "worker")
"""Long-running commands that are not traced as a whole; they record each of their requests and jobs themselves."""


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"marey {version('marey')}")
        raise typer.Exit


def _install_completion(wanted: bool) -> None:
    if wanted:
        from typer.completion import install  # pyrefly: ignore[implicit-reexport]  # defined in a private module

        shell, path = install(prog_name="marey")
        if shell in SCRIPTS:
            Path(path).write_text(SCRIPTS[shell], encoding="utf-8")
        typer.echo(f"completion for {shell} is installed in {path}; it works in shells that you start from now on")
        raise typer.Exit


def _show_completion(shell: str | None) -> None:
    if shell is not None:
        typer.echo(SCRIPTS[shell], nl=False)
        raise typer.Exit


@app.callback()
def marey(
    context: typer.Context,
    server: Annotated[
        str | None,
        typer.Option(
            envvar=list(SERVER_VARIABLES),
            help="Address of the server. Default: the server of your last login, else a server on this machine.",
        ),
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(
            help="File that contains a token and nothing else. Default: the token in the variable MAREY_TOKEN, else "
            f"the token of `marey login`, else the token in {ADMIN_TOKEN_FILE} in the data folder of a server on this "
            "machine."
        ),
    ] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show log messages, and tracebacks of errors.")
    ] = False,
    version: Annotated[  # noqa: ARG001 - its callback does it
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    install_completion: Annotated[  # noqa: ARG001 - its callback does it
        bool,
        typer.Option(
            "--install-completion",
            callback=_install_completion,
            is_eager=True,
            help="Install completion of commands, projects, paths, jobs and versions for the current shell, and exit.",
        ),
    ] = False,
    show_completion: Annotated[  # noqa: ARG001 - its callback does it
        Literal["bash", "zsh", "fish"] | None,
        typer.Option(
            "--show-completion",
            callback=_show_completion,
            is_eager=True,
            help="Print the completion script for this shell, and exit.",
        ),
    ] = None,
) -> None:
    """Store, check, retarget, edit and evaluate motion data on a Marey server."""
    context.obj = Invocation(server, token_file, verbose)
    if context.invoked_subcommand not in (None, *UNTRACED):
        from marey_client.tracing import tracing_command

        context.with_resource(tracing_command(str(context.invoked_subcommand)))


for register in (
    processes,
    doctor,
    bench,
    costs,
    capacity,
    accounts,
    user_tables,
    tokens,
    projects,
    invitations,
    uploading,
    listing,
    holdings,
    downloading,
    organise,
    purging,
    records,
    diff,
    lineage,
    viewing,
    versions,
    archives,
    proposals,
    skeletons,
    clip_jobs,
    annotating,
    edits,
    evaluations,
    comparisons,
    improvements,
    metrics,
    quality,
    models,
    searches,
    jobs,
    pipelines,
    schedules,
    scripts,
    conducting,
    results,
    webhooks,
    audit,
):
    register.add_to(app)


def with_one_command(name: str | None) -> typer.Typer:
    """Return `app` with only the command or group called `name`, or with all commands if there is none of this name.

    Typer builds the parameters of all commands before it runs a command; for a single command, this takes a tenth of
    the time.
    """
    chosen = copy.copy(app)
    chosen.registered_commands = [command for command in app.registered_commands if _name(command) == name]
    chosen.registered_groups = [group for group in app.registered_groups if group.name == name]
    known = chosen.registered_commands or chosen.registered_groups or name in OTHER_NAMES
    return chosen if known else app


def _name(command: CommandInfo) -> str:
    assert command.callback is not None
    return command.name or get_command_name(command.callback.__name__)
