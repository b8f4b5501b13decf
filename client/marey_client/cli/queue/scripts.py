"""Commands `script`, which run commands of pinned Git commits as jobs and compare their runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address
from marey_client.cli.queue.comparing import ScriptName, compare
from marey_client.cli.queue.jobs import input_of_kind
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.following import SCRIPT_RUN, Into, Wait, follow, print_commit
from marey_client.cli.terminal.invocation import AllowExpiredConsent, AsJson, ProjectName, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_client.cli.terminal.schema_options import Chosen, add_command
from marey_client.cli.terminal.typed_values import assignment, json_or_text, read_json

if TYPE_CHECKING:
    from marey_schemas.queue.scripts import ScriptRun

script = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Run scripts (commands in the code of a Git commit), and compare their runs.",
)

OWN_COLUMNS = ("job", "state", "commit", "seed", "author", "created_at", "finished_at")
"""Names of columns that every script has, in addition to its parameters and logged fields."""


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    add_command(script, run, job=SCRIPT_RUN)
    app.add_typer(script, name="script")


@script.command("register")
def register(
    context: typer.Context,
    project: ProjectName,
    name: ScriptName,
    file: Annotated[Path, typer.Option("--file", help="JSON file that describes the script; - reads standard input.")],
    commit: Annotated[
        str | None,
        typer.Option(help="Full name of the commit (`git rev-parse HEAD`), instead of the commit in the file."),
    ] = None,
    repository: Annotated[
        str | None, typer.Option(help="Address of the repository, instead of the address in the file.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Register a script; this requires the role maintainer, and a repository that the server allows.

    The file contains the script as `POST /projects/{project}/scripts` takes it, without its name.
    """
    from marey_schemas.queue.scripts import ScriptCreate

    given = {"name": name, "commit": commit, "repository": repository}
    document = read_json(file)
    if not isinstance(document, dict):
        raise WrongUsage(f"{file} must contain a JSON object")
    wanted = ScriptCreate.model_validate(document | {key: value for key, value in given.items() if value is not None})
    with connect(context) as marey:
        made = marey.project(project).scripts.register(wanted)
    return print_json(made) if as_json else print_message(f"{name} is registered at {made.declaration.commit}")


@script.command("ls")
def list_scripts(context: typer.Context, project: ProjectName, as_json: AsJson = False) -> None:
    """List the scripts of a project."""
    with connect(context) as marey:
        found = list(marey.project(project).scripts.list())
    if as_json:
        return print_json(found)
    rows = [
        (one.name, one.declaration.repository, one.declaration.commit[:12], one.author, one.description)
        for one in found
    ]
    return print_table(("name", "repository", "commit", "author", "description"), rows)


@script.command("show")
def show(context: typer.Context, project: ProjectName, name: ScriptName, as_json: AsJson = False) -> None:
    """Show a script: its command, parameters, inputs, outputs and limits."""
    with connect(context) as marey:
        found = marey.project(project).scripts.at(name).read()
    if as_json:
        return print_json(found)
    declared = found.declaration
    print_pairs(
        [
            ("name", found.name), ("description", found.description), ("repository", declared.repository),
            ("commit", declared.commit), ("command", " ".join(declared.argv)), ("author", found.author),
            *((f"limit {limit}", value) for limit, value in declared.limits if limit != "network"),
            ("network", "allowed" if declared.limits.network else "not allowed"),
        ]
    )  # fmt: skip
    rows: list[tuple[object, ...]] = [
        ("parameter", key, one.type, one.default, one.description) for key, one in declared.parameters.items()
    ]
    rows += [
        ("input", key, f"{one.kind} as {one.format}", None, one.description) for key, one in declared.inputs.items()
    ]
    rows += [("output", key, one.kind, None, one.description) for key, one in declared.outputs.items()]
    return print_table(("", "name", "type", "default", "meaning"), rows)


def run(
    context: typer.Context,
    project: ProjectName,
    name: ScriptName,
    job: Chosen,
    values: Annotated[
        list[str] | None, typer.Option("--value", help="Value of a parameter as name=value; may be repeated.")
    ] = None,
    inputs: Annotated[
        list[str] | None,
        typer.Option("--input", help="Input as name=folder or name=folder/item[@revision]; may be repeated."),
    ] = None,
    into: Into = "",
    allow_expired_consent: AllowExpiredConsent = None,
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Run a script as a job, and print the fields that it logged."""
    with connect(context) as marey:
        handle = marey.project(project).scripts.at(name)
        declared = handle.read().declaration
        specs = declared.input_specs()
        found: dict[str, list[Any]] = {}
        for role, place in map(assignment, inputs or ()):
            if role not in specs:
                raise WrongUsage(f"{name} has no input {role!r}; its inputs are {', '.join(specs) or 'none'}")
            found.setdefault(role, []).append(input_of_kind(marey, Address.within(project, place), specs[role]))
        given = {}
        for key, text in map(assignment, values or ()):
            is_text = key in declared.parameters and declared.parameters[key].type == "text"
            given[key] = text if is_text else json_or_text(text)
        submitted = handle.run(
            given,
            inputs={role: tuple(some) if specs[role].many else some[-1] for role, some in found.items()},
            into=into.strip("/"),
            allow_expired_consent=allow_expired_consent,
            **job,
        )
        ended = follow(marey, submitted, wait=wait, as_json=as_json)
    if ended is None:
        return None
    if as_json:
        return print_json(ended)
    print_message(f"{ended.id} {ended.state}")
    print_commit(ended)
    return print_pairs((ended.result or {}).get("fields", {}).items())


@script.command("runs")
def list_runs(
    context: typer.Context,
    project: ProjectName,
    name: ScriptName,
    columns: Annotated[
        list[str] | None,
        typer.Option(
            "--column",
            help=f"Column to show: a parameter, a logged field, {', '.join(OWN_COLUMNS[:-1])} or "
            f"{OWN_COLUMNS[-1]}; may be repeated. Default: job, state, and all parameters and fields.",
        ),
    ] = None,
    sort: Annotated[
        str,
        typer.Option(
            metavar="ORDER",
            help="Order of the runs: created_at, fields.NAME for a logged field, or values.NAME "
            "for a parameter; a leading - sorts in descending order.",
        ),
    ] = "-created_at",
    limit: Annotated[int, typer.Option(min=1, max=1000, help="Greatest number of runs to list.")] = 50,
    as_json: AsJson = False,
) -> None:
    """List the runs of a script: a table of their parameters and logged fields."""
    with connect(context) as marey:
        found = marey.project(project).scripts.at(name).runs(sort=sort, limit=limit)
    if as_json:
        return print_json(found)
    names = {key: None for one in found for key in (*one.values, *one.fields)}
    shown = tuple(columns or ("job", "state", *names))
    if unknown := [column for column in shown if found and column not in (*OWN_COLUMNS, *names)]:
        raise WrongUsage(f"no run has the column {unknown[0]!r}; choose from {', '.join((*OWN_COLUMNS, *names))}")
    return print_table(shown, [[_cell(one, column) for column in shown] for one in found])


def _cell(one: ScriptRun, column: str) -> object:
    """Return the value of a column: of the run itself, of a logged field, or of a parameter."""
    if column in OWN_COLUMNS:
        return getattr(one, column)
    return one.fields.get(column, one.values.get(column))


script.command("compare")(compare)


@script.command("rm")
def remove(context: typer.Context, project: ProjectName, name: ScriptName) -> None:
    """Delete a script; its runs remain."""
    with connect(context) as marey:
        marey.project(project).scripts.at(name).delete()
    return print_message(f"{name} is deleted")
