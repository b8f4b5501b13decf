"""Commands `bench load` and `bench serve`, which measure how many jobs a server can run, and how soon they start."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.terminal.failures import WrongUsage, interrupted_by_sigterm
from marey_client.cli.terminal.invocation import AsJson, connect, refuse_ignored
from marey_client.cli.terminal.output import print_json, print_message, print_table
from marey_client.progress import progress

if TYPE_CHECKING:
    from marey_client.load.figures import RateFigures
    from marey_client.load.measuring import LoadPlan
    from marey_client.marey import Marey

bench = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Measure how many jobs a server can run, and how soon they start."
)

Rates = Annotated[str, typer.Option("--rate", help="Jobs submitted per second: one rate, or several with commas.")]
Seconds = Annotated[float, typer.Option(help="Number of seconds during which a run submits jobs.")]
Replicates = Annotated[
    int, typer.Option(help="Number of runs at each rate, from which the confidence intervals are computed.")
]
Workers = Annotated[int, typer.Option(min=1, help="Number of simulated workers, which compute nothing.")]
WorkMs = Annotated[float, typer.Option(min=0, help="Milliseconds for which a simulated worker works on each job.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(bench, name="bench")


@bench.command("load")
def load(
    context: typer.Context,
    rates: Rates = "10,50,100",
    seconds: Seconds = 20.0,
    replicates: Replicates = 3,
    workers: Workers = 4,
    other_workers: Annotated[
        bool,
        typer.Option("--other-workers", help="Let the workers of the server run the jobs, instead of simulated ones."),
    ] = False,
    work_ms: WorkMs = 0.0,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure a running server with tiny jobs in a scratch project, which is removed at the end.

    The command creates a project `bench-…`, submits jobs at each rate, and measures the time from the planned
    submission of a job to its start, the jobs per second, and the errors. By default, simulated workers claim these
    jobs, and no others, through the REST API; they run in this command. The test takes processor time of the server
    from other users. Stop it with Ctrl-C. For administrators, the output shows what the server used.
    """
    if other_workers:
        refuse_ignored(context, "with --other-workers", "workers", "work_ms")
    plan = _plan(rates, seconds, replicates, 0 if other_workers else workers, work_ms, seed)
    with connect(context) as marey, interrupted_by_sigterm():
        _measure(marey, plan, as_json)


@bench.command("serve")
def serve(
    database_url: Annotated[
        str | None,
        typer.Option(
            help="URL of an empty Postgres database, postgresql://...; default: an SQLite file in a temporary folder."
        ),
    ] = None,
    rates: Rates = "10,50,100",
    seconds: Seconds = 20.0,
    replicates: Replicates = 3,
    workers: Workers = 4,
    work_ms: WorkMs = 0.0,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Start a server on this machine, measure it as `marey bench load` does, and remove it.

    Server and simulated workers share this machine, so a separate server can be faster. A Postgres database must be
    empty. The tables of the test remain in it; drop the database afterwards.
    """
    plan = _plan(rates, seconds, replicates, workers, work_ms, seed)
    from marey_client.load.own_server import own_server

    if database_url is not None:
        from marey_client import embedded

        embedded.database("require_empty", data=None, database_url=database_url)
    with interrupted_by_sigterm(), own_server(database_url) as marey:
        _measure(marey, plan, as_json)


def _plan(rates: str, seconds: float, replicates: int, workers: int, work_ms: float, seed: int) -> LoadPlan:
    """Return the plan of a load test. Raises `WrongUsage` if an option is not valid."""
    from marey_client.load.measuring import LoadPlan

    try:
        numbers = tuple(float(rate) for rate in rates.split(","))
    except ValueError:
        raise WrongUsage(f"--rate {rates}: give numbers with commas between them, such as 10,50,100") from None
    try:
        return LoadPlan(numbers, seconds, replicates, workers, work_ms / 1000, seed)
    except ValueError as error:
        raise WrongUsage(str(error)) from error


def _measure(marey: Marey, plan: LoadPlan, as_json: bool) -> None:
    from dataclasses import asdict

    from marey_client.load.measuring import load_test

    with progress() as advance:
        found = list(load_test(marey, plan, advance))
    if as_json:
        return print_json({"plan": asdict(plan), "rates": [asdict(one) for one in found]})
    print_table(
        ("rate/s", "submitted", "unfinished", "cycles/s", "start p50 ms", "p95 ms", "p99 ms", "errors"),
        [_row(one) for one in found],
        right=("rate/s", "submitted", "unfinished", "cycles/s", "start p50 ms", "p95 ms", "p99 ms"),
    )
    for one in found:
        if one.server:
            print_message(_use(one))
    return None


def _row(one: RateFigures) -> tuple[object, ...]:
    delays = [one.start_ms[name].shown() if name in one.start_ms else "" for name in ("p50", "p95", "p99")]
    errors = ", ".join(f"{count} {what}" for what, count in sorted(one.errors.items()))
    return f"{one.rate:g}", f"{one.submitted:,}", f"{one.unfinished:,}", one.cycles_per_s.shown(), *delays, errors


def _use(one: RateFigures) -> str:
    use = one.server
    return (
        f"at {one.rate:g}/s, the server process used {use['processor_ms_per_job']:.2f} ms of processor time and "
        f"{use['database_bytes_per_job']:,.0f} bytes of database per job; greatest numbers at one time: "
        f"{use['most_database_connections']:.0f} connections to the database, {use['most_waiting_calls']:.0f} waiting "
        "calls"
    )
