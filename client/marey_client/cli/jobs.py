"""`retarget`, `job` and `why`."""

from __future__ import annotations

import json
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, find_item, require_item
from marey_client.cli.failures import Refused, WrongUsage
from marey_client.cli.invocation import AsJson, JobId, ProjectName, connect
from marey_client.cli.output import Advance, print_json, print_pairs, print_table, progress, tell, tell_refused

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from marey_client.marey import Marey
    from marey_schemas.jobs import CollectionInput, InputSpec, ItemInput, Job, JobInput, JobKind

job = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Jobs.")


def add_to(app: typer.Typer) -> None:
    """Register the commands of this module."""
    app.command()(retarget)
    app.add_typer(job, name="job")
    app.command()(why)


def retarget(
    context: typer.Context,
    sources: Annotated[list[str], typer.Argument(help="Clips or folders of clips: project/folder[/name].")],
    to: Annotated[str, typer.Option(help="The skeleton: project/folder/name, or project/id.")],
    into: Annotated[str, typer.Option(help="The folder in the project that the results go to.")],
    scale: Annotated[float | None, typer.Option(help="Root scale; default: ratio of the hip heights.")] = None,
    suffix: Annotated[str, typer.Option(help="Appended to the names of the results.")] = "",
    tag: Annotated[list[str] | None, typer.Option(help="Tag of the results; may be repeated.")] = None,
    priority: Annotated[int, typer.Option(min=-100, max=100, help="Higher goes first.")] = 0,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until it has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Move clips to another skeleton, as a job."""
    from marey_schemas.job_params import RetargetParams
    from marey_schemas.kinds import Kind

    addresses = [Address.parse(source) for source in sources]
    target_address = Address.parse(to)
    if len({address.project for address in [*addresses, target_address]}) > 1:
        raise WrongUsage("the clips and the skeleton must be in one project")
    given = {"scale": scale, "suffix": suffix, "tags": tuple(tag or ())}
    params = RetargetParams.model_validate(
        {name: value for name, value in given.items() if value not in (None, "", ())}
    )
    with connect(context) as marey:
        clips = tuple(clips_at(marey, address) for address in addresses)
        target = require_item(marey, target_address, [Kind.SKELETON])
        project = marey.project(target_address.project)
        submitted = project.retarget(clips, target.id, into=into.strip("/"), params=params, priority=priority)
        if not wait:
            return print_json(submitted) if as_json else typer.echo(submitted.id)
        ended = follow(marey, submitted)
    return print_ended(ended, as_json)


def clips_at(marey: Marey, address: Address) -> ItemInput | CollectionInput:
    """What an address names as the input of a job: a clip, else a folder."""
    from marey_schemas.jobs import CollectionInput, ItemInput
    from marey_schemas.kinds import Kind

    clip = find_item(marey, address, [Kind.CLIP])
    return CollectionInput(collection=address.path) if clip is None else ItemInput(item=clip.id)


def follow(marey: Marey, submitted: Job, *, count: int | None = None, unit: str = "") -> Job:
    """Wait until a job has ended, with a bar; of `count` units if it is spread over tasks and they are told."""
    with watching(count, unit) as show:
        show(submitted)
        return marey.jobs.wait(submitted.id, on_progress=show)


@contextmanager
def watching(count: int | None = None, unit: str = "") -> Iterator[Callable[[Job], None]]:
    """A bar that follows a job while the block runs; who interrupts it is told that the job goes on."""
    seen: list[Job] = []
    try:
        with progress() as advance:

            def show(now: Job) -> None:
                seen[:] = [now]
                show_progress(now, advance, count, unit)

            yield show
    except KeyboardInterrupt:
        for job in seen:
            tell(f"{job.id} goes on without you; marey job show {job.id} shows it, marey job cancel {job.id} stops it")
        raise


def show_progress(now: Job, advance: Advance, count: int | None = None, unit: str = "") -> None:
    """How far a job is; the progress of one that gathers tasks is counted in tasks, or in what they count."""
    what = f"{now.kind} {now.state}"
    if now.progress is None:
        return advance(what, 0, None)
    if now.size is None or now.progress.total != now.size:
        return advance(now.progress.note or what, now.progress.done, now.progress.total)
    if count is None:
        return advance(what, now.progress.done, now.size)
    return advance(unit or what, round(now.progress.done / now.size * count), count)


def print_ended(ended: Job, as_json: bool) -> None:
    """How a job about clips ended; the exit status tells of refused ones."""
    result = ended.result or {}
    refused: list[dict[str, Any]] = list(result.get("refused", ()))
    if as_json:
        print_json(ended)
    else:
        tell_refused(refused)
        told = ", ".join(f"{value} {name}" for name, value in result.items() if isinstance(value, int))
        typer.echo(f"{ended.id} {ended.state}" + (f": {told}" if told else "") + f"; {len(refused)} refused")
    if refused:
        raise Refused


# -- jobs --


@job.command("kinds")
def list_kinds(
    context: typer.Context,
    name: Annotated[str | None, typer.Argument(help="Left out: every kind.")] = None,
    as_json: AsJson = False,
) -> None:
    """Show what can be asked for, or what one kind takes."""
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
    takes = [("--input", role, spec.kind, spec.description) for role, spec in kind.inputs.items()]
    given = [
        ("--param", key, json.dumps(spec.get("default")), spec.get("description", ""))
        for key, spec in kind.params_schema.get("properties", {}).items()
    ]
    return print_table(("", "name", "kind or default", "meaning"), [*takes, *given])


@job.command("submit")
def submit_job(
    context: typer.Context,
    project: ProjectName,
    kind: Annotated[str, typer.Argument(help="What to do; marey job kinds shows what there is.")],
    inputs: Annotated[
        list[str] | None,
        typer.Option("--input", help="name=folder, folder/item, or id of the job that makes it; may be repeated."),
    ] = None,
    params: Annotated[
        list[str] | None, typer.Option("--param", help="name=value, the value as JSON or plain text; may be repeated.")
    ] = None,
    into: Annotated[str, typer.Option(help="The folder in the project that the results go to.")] = "",
    priority: Annotated[int, typer.Option(min=-100, max=100, help="Higher goes first.")] = 0,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until it has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Hand in a job of any kind, and print its result."""
    from marey_schemas.jobs import JobCreate

    with connect(context) as marey:
        roles = _kind_of_job(marey, kind).inputs
        places: dict[str, list[Any]] = {}
        for role, place in map(_assigned, inputs or ()):
            if role not in roles:
                raise WrongUsage(f"{kind} has no input {role!r}; it has {', '.join(roles) or 'none'}")
            places.setdefault(role, []).append(_input_at(marey, Address(project, place.strip("/")), roles[role]))
        wanted = JobCreate(
            kind=kind,
            inputs={role: tuple(found) if roles[role].many else found[-1] for role, found in places.items()},
            params={name: json_or_text(value) for name, value in map(_assigned, params or ())},
            into=into.strip("/"),
            priority=priority,
        )
        submitted = marey.project(project).submit(wanted)
        if not wait:
            return print_json(submitted) if as_json else typer.echo(submitted.id)
        ended = follow(marey, submitted)
    tell(f"{ended.id} {ended.state}")
    return print_json(ended if as_json else ended.result)


def _kind_of_job(marey: Marey, name: str) -> JobKind:
    kinds = {kind.name: kind for kind in marey.jobs.kinds()}
    if name not in kinds:
        raise WrongUsage(f"{name!r} is no kind of job of this server; there are {', '.join(kinds)}")
    return kinds[name]


def _input_at(marey: Marey, address: Address, spec: InputSpec) -> JobInput:
    """An item, or where the input takes many, a folder; or what a job makes."""
    from marey_schemas.jobs import CollectionInput, ItemInput, JobOutputsInput

    if address.has_id and address.name.startswith("job_"):
        return JobOutputsInput(job=address.name)
    if not spec.many:
        return ItemInput(item=require_item(marey, address, [spec.kind]).id)
    item = find_item(marey, address, [spec.kind])
    return CollectionInput(collection=address.path) if item is None else ItemInput(item=item.id)


def _assigned(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise WrongUsage(f"{text!r}: write name=value")
    return name, value


def json_or_text(text: str) -> Any:
    """A value of a parameter: JSON where it is, else the text itself."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


@job.command("ls")
def list_jobs(
    context: typer.Context,
    project: ProjectName,
    state: Annotated[str | None, typer.Option(help="waiting, queued, running, succeeded, failed or cancelled.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="How many, newest first.")] = 50,
    as_json: AsJson = False,
) -> None:
    """Show the jobs of a project, newest first."""
    from itertools import islice

    with connect(context) as marey:
        jobs = list(islice(marey.project(project).jobs(filters={"state": state}), limit))
    if as_json:
        return print_json(jobs)
    rows = [(one.id, one.kind, one.state, _done(one), one.author, one.created_at) for one in jobs]
    return print_table(("id", "kind", "state", "done", "author", "submitted"), rows)


@job.command("show")
def show_job(context: typer.Context, job_id: JobId, as_json: AsJson = False) -> None:
    """Show how a job stands, and every try at it."""
    with connect(context) as marey:
        found = marey.jobs.get(job_id)
        attempts = list(marey.jobs.attempts(job_id))
    if as_json:
        return print_json({**found.model_dump(mode="json"), "attempts": attempts})
    shown = found.model_dump(mode="json", exclude={"rev", "inputs"}, exclude_none=True)
    print_pairs((name, json.dumps(value) if isinstance(value, dict) else value) for name, value in shown.items())
    rows = [(one.fence, one.worker, one.started_at, one.ended_at, one.outcome, one.detail) for one in attempts]
    return print_table(("fence", "worker", "started", "ended", "outcome", "detail"), rows)


@job.command("log")
def show_log(
    context: typer.Context,
    job_id: JobId,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on until the job has ended.")] = False,
) -> None:
    """Print what a job wrote."""
    with connect(context) as marey:
        for piece in marey.jobs.log(job_id, follow=follow):
            typer.echo(piece, nl=False)


@job.command("cancel")
def cancel_job(context: typer.Context, job_id: JobId, as_json: AsJson = False) -> None:
    """Ask a job to stop; a queued one is cancelled at once."""
    with connect(context) as marey:
        found = marey.jobs.cancel(job_id)
    if as_json:
        return print_json(found)
    return tell(f"{found.id} is {found.state}" + (", and will stop" if found.cancel_requested else ""))


@job.command("retry")
def retry_job(
    context: typer.Context,
    job_id: JobId,
    wait: Annotated[bool, typer.Option("--wait/--no-wait", help="Wait until it has ended.")] = False,
    as_json: AsJson = False,
) -> None:
    """Submit a job that failed or was cancelled again, with those it needs and those that failed because of it."""
    with connect(context) as marey:
        again = marey.jobs.retry(job_id)
        if not wait:
            return print_json(again) if as_json else typer.echo(again.id)
        ended = follow(marey, again)
    return print_ended(ended, as_json)


def why(
    context: typer.Context,
    job_id: Annotated[str, typer.Argument(help="A job that waits, runs for long, or failed.")],
    as_json: AsJson = False,
) -> None:
    """Explain why a job is where it is."""
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
    return f"{one.progress.done:g}" + (f"/{one.progress.total:g}" if one.progress.total else "")
