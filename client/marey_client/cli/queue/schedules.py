"""Commands `schedule`, which submit jobs at certain times."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, ProjectName, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table
from marey_client.cli.terminal.typed_values import read_json

if TYPE_CHECKING:
    from marey_schemas.queue.schedules import Schedule

schedule = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Submit jobs at certain times.")

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the schedule.")]
Cron = Annotated[
    str,
    typer.Option(
        metavar="TIMES",
        help='Times as minute, hour, day, month and day of the week: "0 3 * * 1-5" means 3:00 from Monday to Friday.',
    ),
]
TimeZone = Annotated[str, typer.Option(metavar="ZONE", help="Time zone of the times, such as Europe/Berlin.")]
JobFile = Annotated[Path, typer.Option("--job", help="JSON file of the job to submit; - reads standard input.")]
Overlapping = Annotated[
    bool,
    typer.Option("--overlap/--no-overlap", help="Submit a job even if the previous job has not ended."),
]
Description = Annotated[str, typer.Option(help="Purpose of the schedule.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(schedule, name="schedule")


@schedule.command("create")
def create(
    context: typer.Context,
    project: ProjectName,
    name: Name,
    cron: Cron,
    job: JobFile,
    timezone: TimeZone = "UTC",
    overlap: Overlapping = False,
    paused: Annotated[
        bool, typer.Option("--paused", help="Submit no jobs until `marey schedule change --resume`.")
    ] = False,
    description: Description = "",
    as_json: AsJson = False,
) -> None:
    """Create a schedule: the server submits a job, as you, at the times of a cron expression.

    The file contains the job as `POST /projects/{project}/jobs` takes it, for example {"kind": "evaluate", "inputs":
    {"clips": {"collection": "studio"}}}. Inputs without a revision have their newest revision at each time.
    """
    from marey_schemas.queue.jobs import JobCreate

    wanted = JobCreate.model_validate(read_json(job))
    with connect(context) as marey:
        made = marey.project(project).schedules.create(
            name, cron, wanted, timezone=timezone, overlapping=overlap, paused=paused, description=description
        )
    first = "is paused" if made.paused else f"submits its first job at {_next(made)}"
    return print_json(made) if as_json else print_message(f"{name} {first}")


@schedule.command("ls")
def list_schedules(context: typer.Context, project: ProjectName, as_json: AsJson = False) -> None:
    """List the schedules of a project."""
    with connect(context) as marey:
        found = list(marey.project(project).schedules.list())
    if as_json:
        return print_json(found)
    rows = [
        (one.name, one.cron, one.timezone, one.job["kind"], _next(one), one.last_job, one.problem, one.author)
        for one in found
    ]
    return print_table(("name", "times", "time zone", "kind", "next", "last job", "problem", "author"), rows)


def _next(found: Schedule) -> str:
    if found.paused:
        return "paused"
    return "soon" if found.next_at is None else f"{found.next_at:%Y-%m-%d %H:%M}Z"


@schedule.command("show")
def show(context: typer.Context, project: ProjectName, name: Name, as_json: AsJson = False) -> None:
    """Show a schedule, its next time and its last job, and the reason if the last job was not submitted."""
    with connect(context) as marey:
        found = marey.project(project).schedules.at(name).read()
    return print_json(found) if as_json else print_pairs(list(found.model_dump(exclude={"project", "rev"}).items()))


@schedule.command("change")
def change(
    context: typer.Context,
    project: ProjectName,
    name: Name,
    cron: Annotated[
        str | None,
        typer.Option(
            metavar="TIMES",
            help="New times: minute, hour, day, month and day "
            "of the week, as for `marey schedule create`. "
            "Default: unchanged.",
        ),
    ] = None,
    timezone: Annotated[
        str | None, typer.Option(metavar="ZONE", help="New time zone, such as Europe/Berlin. Default: unchanged.")
    ] = None,
    job: Annotated[
        Path | None,
        typer.Option("--job", help="JSON file of the new job to submit; - reads standard input. Default: unchanged."),
    ] = None,
    overlap: Annotated[
        bool | None,
        typer.Option(
            "--overlap/--no-overlap",
            help="Submit a job even if the previous job has not ended, or "
            "skip the time in this case. Default: unchanged.",
        ),
    ] = None,
    pause: Annotated[
        bool | None, typer.Option("--pause/--resume", help="Pause the schedule, or resume it. Default: unchanged.")
    ] = None,
    description: Annotated[str | None, typer.Option(help="New purpose of the schedule. Default: unchanged.")] = None,
    as_json: AsJson = False,
) -> None:
    """Change, pause or resume a schedule.

    After any change except by --pause or --description, the schedule submits its jobs as you.
    """
    from marey_schemas.queue.jobs import JobCreate
    from marey_schemas.queue.schedules import ScheduleChange

    given: dict[str, Any] = {
        "cron": cron, "timezone": timezone, "overlapping": overlap, "paused": pause, "description": description,
        "job": None if job is None else JobCreate.model_validate(read_json(job)),
    }  # fmt: skip
    wanted = {field: value for field, value in given.items() if value is not None}
    if not wanted:
        raise WrongUsage(
            "give at least one of --cron, --timezone, --job, --overlap, --no-overlap, --pause, --resume and "
            "--description"
        )
    with connect(context) as marey:
        found = marey.project(project).schedules.at(name).change(ScheduleChange(**wanted))
    return print_json(found) if as_json else print_message(f"{name} is changed; next time: {_next(found)}")


@schedule.command("run")
def run(context: typer.Context, project: ProjectName, name: Name, as_json: AsJson = False) -> None:
    """Submit the job of a schedule now, as you. The times of the schedule stay as they are."""
    with connect(context) as marey:
        job = marey.project(project).schedules.at(name).run()
    return print_json(job) if as_json else print_pairs([("job", job.id), ("state", job.state)])


@schedule.command("rm")
def remove(context: typer.Context, project: ProjectName, name: Name) -> None:
    """Delete a schedule; its jobs remain."""
    with connect(context) as marey:
        marey.project(project).schedules.at(name).delete()
    return print_message(f"{name} is deleted")
