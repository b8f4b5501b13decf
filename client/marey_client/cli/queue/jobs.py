"""Commands of the group `job`, and `why`, which explains the state of a job."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, require_item
from marey_client.cli.terminal.failures import Refused, WrongUsage
from marey_client.cli.terminal.following import SEEDED_JOB, Into, Wait, follow, input_at, print_commit, print_ended
from marey_client.cli.terminal.invocation import AsJson, JobId, ProjectName, connect
from marey_client.cli.terminal.output import ago, print_json, print_message, print_pairs, print_table
from marey_client.cli.terminal.schema_options import Chosen, add_command
from marey_client.cli.terminal.typed_values import Schema, assignment, range_text, read_parameter, resolved, type_text
from marey_schemas.wording import counted, suggestion

if TYPE_CHECKING:
    from marey_client.marey import Marey
    from marey_client.reruns import ComparedOutput
    from marey_schemas.queue.jobs import InputSpec, Job, JobInput, JobKind

job = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Submit, watch and cancel jobs.")


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(job, name="job")
    add_command(job, submit_job, "submit", job=SEEDED_JOB)
    app.command()(why)


@job.command("kinds")
def list_kinds(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="Kind of job; default: all kinds.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show the kinds of jobs, or the inputs and parameters of one kind."""
    with connect(context) as marey:
        kinds = list(marey.jobs.kinds()) if name is None else [_kind_of_job(marey, name)]
    if as_json:
        return print_json(kinds if name is None else kinds[0])
    if name is None:
        return print_table(
            ("name", "inputs", "description"), [(x.name, " ".join(x.inputs), x.description) for x in kinds]
        )
    (kind,) = kinds
    typer.echo(kind.description)
    takes = [("--input", role, spec.kind, "", spec.description) for role, spec in kind.inputs.items()]
    given = [
        ("--param", key, _value_text(spec), json.dumps(spec.get("default")), spec.get("description", ""))
        for key, spec in resolved(kind.params_schema).items()
    ]
    return print_table(("", "name", "value", "default", "meaning"), [*takes, *given])


def _value_text(schema: Schema) -> str:
    """Return the type and the range of a parameter."""
    return ", ".join(filter(None, (type_text(schema), range_text(schema))))


def submit_job(
    context: typer.Context,
    project: ProjectName,
    kind: Annotated[
        str,
        typer.Argument(
            help="Kind of the job. `marey job kinds` lists all kinds. `marey job kinds KIND` lists the inputs and "
            "parameters of one kind."
        ),
    ],
    job: Chosen,
    inputs: Annotated[
        list[str] | None,
        typer.Option(
            "--input",
            help="Input as name=folder, name=folder/item[@revision] or name=dataset@version[/folder]; or name=ID "
            "with the id of a job whose outputs are the input; may be repeated.",
        ),
    ] = None,
    params: Annotated[
        list[str] | None,
        typer.Option(
            "--param",
            help="Parameter as name=value, where the value is JSON or plain text; may be "
            "repeated. Default: the defaults of the kind.",
        ),
    ] = None,
    into: Into = "",
    wait: Wait = True,
    as_json: AsJson = False,
) -> None:
    """Submit a job of any kind, and print its result."""
    from marey_schemas.queue.jobs import JobCreate

    with connect(context) as marey:
        declared = _kind_of_job(marey, kind)
        roles, schemas = declared.inputs, resolved(declared.params_schema)
        places: dict[str, list[Any]] = {}
        for role, place in map(assignment, inputs or ()):
            if role not in roles:
                raise WrongUsage(
                    f"jobs of the kind {kind} have no input {role!r}; their inputs are {', '.join(roles) or 'none'}"
                )
            places.setdefault(role, []).append(input_of_kind(marey, Address.within(project, place), roles[role]))
        wanted = JobCreate(
            kind=kind,
            inputs={role: tuple(found) if roles[role].many else found[-1] for role, found in places.items()},
            params={name: read_parameter(value, schemas.get(name)) for name, value in map(assignment, params or ())},
            into=into.strip("/"),
            **job,
        )
        ended = follow(marey, marey.project(project).submit(wanted), wait=wait, as_json=as_json)
    if ended is None:
        return
    print_message(f"{ended.id} {ended.state}")
    print_json(ended if as_json else ended.result)
    print_commit(ended)
    if (ended.result or {}).get("refused"):
        raise Refused


def _kind_of_job(marey: Marey, name: str) -> JobKind:
    kinds = {kind.name: kind for kind in marey.jobs.kinds()}
    if name not in kinds:
        raise WrongUsage(f"this server has no job kind {name!r}; {suggestion(name, kinds, 'job kinds')}")
    return kinds[name]


def input_of_kind(marey: Marey, address: Address, spec: InputSpec) -> JobInput:
    """Return the input at an address: an item, a folder if several items are accepted, or the outputs of a job."""
    from marey_schemas.queue.jobs import ItemInput, JobOutputsInput

    if address.has_id and address.name.startswith("job_"):
        return JobOutputsInput(job=address.name)
    if not spec.many and "@" not in address.path:
        return ItemInput(item=require_item(marey, address, [spec.kind]).id)
    return input_at(marey, address, spec.kind, pinned=False)


@job.command("ls")
def list_jobs(
    context: typer.Context,
    project: ProjectName,
    state: Annotated[
        list[str] | None,
        typer.Option(
            help="List only jobs in this state: waiting, queued, running, succeeded, failed or cancelled; may be "
            "repeated."
        ),
    ] = None,
    kind: Annotated[
        list[str] | None, typer.Option(help="List only jobs of this kind, such as retarget; may be repeated.")
    ] = None,
    author: Annotated[
        str | None, typer.Option(help="List only jobs that this user submitted. Default: of all users.")
    ] = None,
    tasks_of: Annotated[
        str | None,
        typer.Option(
            metavar="JOB", help="List the tasks into which this job was split. By default, tasks are not listed."
        ),
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Greatest number of jobs to list, newest first.")] = 50,
    as_json: AsJson = False,
) -> None:
    """Show the jobs of a project, newest first."""
    from itertools import islice

    filters = {
        "state": ",".join(state or ()) or None, "kind": ",".join(kind or ()) or None, "author": author,
        "parent": tasks_of,
    }  # fmt: skip
    with connect(context) as marey:
        jobs = list(islice(marey.project(project).jobs(filters=filters), limit))
    if as_json:
        return print_json(jobs)
    if not jobs:
        return print_message(f"{project} has no such jobs" if any(filters.values()) else f"{project} has no jobs yet")
    now = datetime.now(UTC)
    rows = [(one.id, one.kind, one.state, _done(one), one.author, ago(one.created_at, now)) for one in jobs]
    return print_table(("id", "kind", "state", "done", "author", "submitted"), rows)


@job.command("show")
def show_job(context: typer.Context, job_id: JobId, as_json: AsJson = False) -> None:
    """Show a job: its parameters, state and result, the commits of its inputs, and its attempts.

    The option --json also shows the inputs.
    """
    from marey_schemas.queue.jobs import commits_of

    with connect(context) as marey:
        found = marey.jobs.get(job_id)
        attempts = list(marey.jobs.attempts(job_id))
    if as_json:
        return print_json({**found.model_dump(mode="json"), "attempts": attempts})
    shown = found.model_dump(mode="json", exclude={"rev", "inputs"}, exclude_none=True)
    if commits := commits_of(found.inputs):
        shown["from commits"] = ", ".join(sorted(commits))
    print_pairs((name, json.dumps(value) if isinstance(value, dict) else value) for name, value in shown.items())
    rows = [(one.fence, one.worker, one.started_at, one.ended_at, one.outcome, one.detail) for one in attempts]
    return print_table(("fence", "worker", "started", "ended", "outcome", "detail"), rows)


@job.command("log")
def show_log(
    context: typer.Context,
    job_id: JobId,
    go_on: Annotated[bool, typer.Option("--follow", "-f", help="Follow the log until the job has ended.")] = False,
) -> None:
    """Print the log of a job, of all its attempts."""
    with connect(context) as marey:
        for piece in marey.jobs.log(job_id, follow=go_on):
            typer.echo(piece, nl=False)


@job.command("cancel")
def cancel_job(context: typer.Context, job_id: JobId, as_json: AsJson = False) -> None:
    """Ask a job to stop; a job that does not run yet is cancelled at once."""
    with connect(context) as marey:
        found = marey.jobs.cancel(job_id)
    if as_json:
        return print_json(found)
    return print_message(f"{found.id} is {found.state}" + (", and will stop" if found.cancel_requested else ""))


@job.command("retry")
def retry_job(
    context: typer.Context,
    job_id: JobId,
    dependants: Annotated[
        bool,
        typer.Option(
            "--dependants/--no-dependants",
            help="Also retry jobs that failed or were cancelled only because this job did not succeed.",
        ),
    ] = True,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until the job has ended.")] = False,
    as_json: AsJson = False,
) -> None:
    """Submit a failed or cancelled job again.

    Unsuccessful jobs on which the job depends are submitted again, too. By default, so are later jobs that failed or
    were cancelled only because one of these jobs did not succeed.
    """
    with connect(context) as marey:
        ended = follow(marey, marey.jobs.retry(job_id, dependants=dependants), wait=wait, as_json=as_json)
    if ended is not None:
        print_ended(ended, as_json)


@job.command("rerun")
def rerun_job(
    context: typer.Context,
    job_id: JobId,
    into: Annotated[
        str | None,
        typer.Option(
            help="Folder for the results of the repetition; default: reruns/ID, where ID is the id of the job."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Repeat a job from its record, and compare the results.

    The repetition reads the same revisions, with the same parameters and seed, and uses no cached result. The exit
    status is 1 if a result differs.
    """
    from marey_client.reruns import CannotRerun, compare_outputs, rerun_request

    with connect(context) as marey:
        first = marey.jobs.get(job_id)
        try:
            tasks = marey.jobs.list(first.project, filters={"parent": first.id}) if first.size else ()
            request = rerun_request(first, _kind_of_job(marey, first.kind), tasks, into=into and into.strip("/"))
        except CannotRerun as error:
            raise WrongUsage(str(error)) from None
        project = marey.project(first.project)
        again = follow(marey, project.submit(request))
        assert again is not None
        outputs = (list(marey.jobs.outputs(one.id)) for one in (first, again))
        compared = list(compare_outputs(project, *outputs))
    described = [(one, _difference_of(one)) for one in compared]
    differing = [(one.name, lines) for one, lines in described if lines]
    if not compared and first.result != again.result:
        differing.append(("result", [f"{json.dumps(first.result)} before, {json.dumps(again.result)} now"]))
    if as_json:
        found = [{"name": one.name, "comparison": one.agreement, "lines": lines} for one, lines in described]
        print_json({"job": again.id, "outputs": found})
    else:
        for name, lines in differing:
            typer.echo("\n".join((f"{name}:", *(f"  {line}" for line in lines))))
        identical = sum(one.agreement == "identical" for one in compared)
        print_message(
            f"{again.id} repeats {first.id} in {request.into}: {counted(len(compared), 'output')}, {identical} "
            f"identical, {len(compared) - identical - len(differing)} with equal content, {len(differing)} different"
        )
    if differing:
        raise Refused


def _difference_of(one: ComparedOutput) -> list[str]:
    """Return lines that say how an output differs from the repeated output; no lines if both have the same content."""
    from marey_client.cli.difference.words import NO_DIFFERENCE, changes_in_words

    if one.difference is not None:
        lines = list(changes_in_words(one.difference))
        return [] if lines == [NO_DIFFERENCE] else lines
    only = "the first job" if one.second is None else "the repetition"
    texts = {"missing": f"only {only} has this output", "deleted": "cannot be compared, because its item was deleted"}
    return [texts[one.agreement]] if one.agreement in texts else []


def why(
    context: typer.Context,
    job_id: Annotated[str, typer.Argument(help="Id of a job that is waiting, slow or failed.")],
    as_json: AsJson = False,
) -> None:
    """Explain what a job waits for, which worker runs it, or why it has failed."""
    from marey_client.explanations import explain_job

    with connect(context) as marey:
        reasons = explain_job(marey, job_id)
    if as_json:
        return print_json(reasons)
    for reason in reasons:
        typer.echo(reason)
    return None


def _done(one: Job) -> str:
    if one.size:
        return f"{one.children.get('succeeded', 0)}/{one.size}"
    if one.progress is None:
        return ""
    if one.state == "succeeded":  # the last report of progress is older than the end
        return f"{one.progress.total:g}/{one.progress.total:g}" if one.progress.total else ""
    return f"{one.progress.done:g}" + (f"/{one.progress.total:g}" if one.progress.total else "")
