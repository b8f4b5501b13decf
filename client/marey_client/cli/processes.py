"""Commands `serve`, `worker`, `demo` and `db`, which do their work on this machine, and `worker ls`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_table
from marey_schemas.address import DATABASE_FILE, DEFAULT_DATA, DEFAULT_HOST, DEFAULT_PORT, SETTINGS_FILE
from marey_schemas.queue.log_lines import LogForm

db = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Manage the database of a server on this machine.")

workers = typer.Typer(invoke_without_command=True, rich_markup_mode=None)

DataFolder = Annotated[
    Path | None,
    typer.Option(
        help=f"Data folder of the server; default: MAREY_DATA, otherwise `data` in {SETTINGS_FILE}, otherwise "
        f"./{DEFAULT_DATA}."
    ),
]
DatabaseUrl = Annotated[
    str | None,
    typer.Option(
        help=f"URL of a Postgres database, postgresql://...; default: the SQLite file {DATABASE_FILE} in the data "
        "folder. Other users of this machine can see the options of a command: if the URL contains a password, set "
        "the environment variable MAREY_DATABASE_URL instead."
    ),
]

READY_TIMEOUT_S = 10.0


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.command()(serve)
    app.add_typer(workers, name="worker")
    app.command()(ready)
    app.command()(demo)
    app.add_typer(db, name="db")


def serve(
    data: DataFolder = None,
    host: Annotated[str | None, typer.Option(help=f"Address to listen on; default: {DEFAULT_HOST}.")] = None,
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help=f"Port to listen on; 0: any free port; default: {DEFAULT_PORT}."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=0, help="Number of worker processes that the server starts; default: 1.")
    ] = None,
    processes: Annotated[
        int | None,
        typer.Option(min=1, help="Number of server processes that share the port; needs Postgres; default: 1."),
    ] = None,
    database_url: DatabaseUrl = None,
    log_form: Annotated[
        LogForm | None, typer.Option(help="Format of the log: text (the default at a terminal) or json.")
    ] = None,
) -> None:
    """Run a server, with its database and a local worker, until the server is stopped."""
    from marey_client import embedded

    embedded.serve(
        data=data,
        host=host,
        port=port,
        local_workers=workers,
        processes=processes,
        database_url=database_url,
        log_form=log_form,
    )


@workers.callback()
def worker(
    context: typer.Context,
    slots: Annotated[
        int, typer.Option(min=1, help="Number of jobs that run at the same time, each in its own process.")
    ] = 1,
    kind: Annotated[
        list[str] | None, typer.Option(help="Run only jobs of this kind; may be repeated. Default: all kinds.")
    ] = None,
    label: Annotated[
        list[str] | None,
        typer.Option(
            help="Label of the worker, as name=value; may be repeated. A job can require labels of its worker."
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the worker, shown to people; default: host and process id.")
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option(
            help="Folder for a cache of downloaded inputs, which later jobs "
            "read again. Default: marey/inputs below ~/.cache."
        ),
    ] = None,
    cache_mb: Annotated[
        int | None, typer.Option(min=16, help="Greatest size of the cache, in MiB; default: 2048.")
    ] = None,
    log_form: Annotated[
        LogForm | None, typer.Option(help="Format of the log: text (the default at a terminal) or json.")
    ] = None,
    job: Annotated[
        str | None,
        typer.Option(
            help="Id of the only job to run; then the worker ends. Pods that the server "
            "starts for one job use this option."
        ),
    ] = None,
    task: Annotated[
        int | None,
        typer.Option(min=0, help="With --job: run only the task of the job that has this position, counted from 0."),
    ] = None,
) -> None:
    """Run a worker, which runs the jobs of a server until you stop the worker. The token must have the scope `work`."""
    if context.invoked_subcommand is not None:
        return
    from marey_client import embedded
    from marey_client.cli.terminal.invocation import credential_of
    from marey_client.cli.terminal.typed_values import assignment

    embedded.work(
        credential_of(context),
        slots=slots,
        kinds=tuple(kind or ()),
        labels=dict(map(assignment, label or ())),
        name=name,
        cache=cache,
        cache_mb=cache_mb,
        log_form=log_form,
        job=job,
        task=task,
    )


def ready(context: typer.Context) -> None:
    """Check once whether a server is ready for requests; the exit status is 0 only if it is ready."""
    from marey_client.cli.terminal.invocation import credential_of
    from marey_client.cli.terminal.output import print_message
    from marey_client.marey import Marey
    from marey_client.retries import ONCE

    url = credential_of(context).url
    with Marey(url, retries=ONCE, timeout_s=READY_TIMEOUT_S) as marey:
        marey.transport.send("GET", f"{marey.transport.url}/readyz")
    print_message(f"{url} is ready")


@workers.command("ls")
def list_workers(context: typer.Context, as_json: AsJson = False) -> None:
    """List the workers that the server knows, and whether they are alive. Only administrators may list them.

    A server knows the workers that run jobs, and the workers that claimed jobs from it in the last 24 hours. If several
    servers share a database, workers that wait for jobs of another server are missing. Times are in UTC.
    """
    with connect(context) as marey:
        found = list(marey.workers())
    if as_json:
        return print_json(found)
    return print_table(
        ("worker", "state", "running", "last seen", "version", "labels", "kinds"),
        [
            (
                one.name,
                "alive" if one.alive else "away",
                one.running,
                one.seen_at,
                one.version,
                " ".join(f"{name}={value}" for name, value in sorted((one.labels or {}).items())),
                " ".join(one.kinds or ()),
            )
            for one in found
        ],
        right=("running",),
    )


def demo(
    motion: Annotated[Path | None, typer.Argument(help="A folder of motion files; default: generated walks.")] = None,
    data: Annotated[Path, typer.Option(help="Data folder of the demonstration's server.")] = Path("marey-demo"),
    serve_on: Annotated[
        bool, typer.Option("--serve", help="Keep the server running after the demonstration, until you stop it.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Demonstrate Marey on this machine: import, retarget and evaluate takes; make a table, a picture and a report."""
    from marey_client.cli.demo.story import demonstrate

    demonstrate(motion, data=data, keep_serving=serve_on, as_json=as_json)


# -- the database --


@db.command("upgrade")
def upgrade_database(
    while_serving: Annotated[
        bool,
        typer.Option(
            "--while-serving",
            help="Refuse the upgrade if running servers of the earlier version could not use the upgraded database.",
        ),
    ] = False,
    finish: Annotated[
        bool,
        typer.Option(
            "--finish",
            help="Also remove the parts of the schema that only earlier versions use; no server of an earlier version "
            "may run.",
        ),
    ] = False,
    data: DataFolder = None,
    database_url: DatabaseUrl = None,
) -> None:
    """Upgrade the schema of the database, and print whether servers of the earlier version can still use it."""
    _database("upgrade", data, database_url, while_serving=while_serving, finish=finish)


@db.command("backup")
def backup_database(
    target: Annotated[Path, typer.Argument(help="The file to write; it must not exist.")],
    data: DataFolder = None,
    database_url: DatabaseUrl = None,
) -> None:
    """Write a consistent copy of an SQLite database; the server may be running. For Postgres, use pg_dump."""
    _database("backup", data, database_url, target=target)


@db.command("restore")
def restore_database(
    source: Annotated[Path, typer.Argument(help="A file that `marey db backup` wrote.")],
    data: DataFolder = None,
    database_url: DatabaseUrl = None,
) -> None:
    """Restore a backup as a new SQLite database, which must not exist yet. For Postgres, use pg_restore."""
    _database("restore", data, database_url, source=source)


@db.command("fsck")
def check_database(
    repair: Annotated[
        bool,
        typer.Option(
            "--repair",
            help="Correct wrong counters of items and bytes. Other writes to the database wait until the correction "
            "is done.",
        ),
    ] = False,
    data: DataFolder = None,
    database_url: DatabaseUrl = None,
    as_json: AsJson = False,
) -> None:
    """Verify all digests, references and counters in the database."""
    _database("fsck", data, database_url, repair=repair, as_json=as_json)


@db.command("purge")
def purge_database(data: DataFolder = None, database_url: DatabaseUrl = None) -> None:
    """Delete data that is older than the settings allow or that nothing refers to, and make an SQLite file smaller.

    A running server deletes such data every hour by itself. The file can be made smaller only while no server runs.
    """
    _database("purge", data, database_url)


@db.command("move-blobs")
def move_blobs(data: DataFolder = None, database_url: DatabaseUrl = None) -> None:
    """Move all blobs to the storage that the setting `blobs` names: files or object storage. Servers may be running.

    The command verifies every blob. It can be stopped with Ctrl-C and run again. First restart all servers with the new
    settings; otherwise, they cannot read the moved blobs.
    """
    _database("move_blobs", data, database_url)


@db.command("clock")
def set_clock(
    set_now: Annotated[
        bool, typer.Option("--set", help="Set the stored clock to the clock of this machine, even if that is earlier.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Set the clock without asking for confirmation.")] = False,
    data: DataFolder = None,
) -> None:
    """Compare the time that an SQLite database stores with the clock of this machine. The server must be stopped.

    The stored clock never goes back by itself. If a server has run with a clock that was years ahead, its tokens have
    expired and its leases (the rights of workers to work on jobs) do not end for a long time. --set corrects this: it
    sets every stored time that is later than now to the present time, and ends all leases. Tokens and time limits that
    were created with the wrong clock keep their durations.
    """
    if set_now and not yes:
        _database("clock", data, None)
        typer.confirm("Set the clock of the database to the time of this machine?", abort=True)
    _database("clock", data, None, set_now=set_now)


@db.command("admin-token")
def make_admin_token(
    user: Annotated[
        str | None, typer.Option(help="Name of the administrator; default: the administrator that was created first.")
    ] = None,
    data: DataFolder = None,
    database_url: DatabaseUrl = None,
) -> None:
    """Write a new token for an administrator to admin.token in the data folder, for example if the token was lost."""
    _database("admin_token", data, database_url, user=user)


def _database(action: str, data: Path | None, database_url: str | None, **options: Any) -> None:
    from marey_client import embedded

    embedded.database(action, data=data, database_url=database_url, **options)
