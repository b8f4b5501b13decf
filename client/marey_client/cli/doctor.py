"""Command `doctor`, which checks this machine and the server, and says what to do."""

from __future__ import annotations

import os
from importlib.metadata import version
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.processes import DatabaseUrl, DataFolder
from marey_client.cli.terminal.failures import interrupted_by_sigterm
from marey_client.cli.terminal.invocation import AsJson, connect, credential_of, refuse_ignored
from marey_client.cli.terminal.output import print_json, print_message
from marey_client.progress import progress

if TYPE_CHECKING:
    from collections.abc import Iterator

    from marey_client.marey import Marey

Finding = tuple[str, str, str]
"""Result of a check: name of the check; state (ok, warning or fault); and a detail, which says what to do."""


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    app.command()(doctor)


def doctor(
    context: typer.Context,
    data: DataFolder = None,
    database_url: DatabaseUrl = None,
    local: Annotated[
        bool,
        typer.Option("--local/--no-local", help="Check the data folder and the database of a server on this machine."),
    ] = True,
    remote: Annotated[bool, typer.Option("--remote/--no-remote", help="Check the running server.")] = True,
    chaos: Annotated[
        bool,
        typer.Option(
            "--chaos",
            help="Instead of the checks, inject faults into the running server, in a scratch project that is "
            "removed at the end.",
        ),
    ] = False,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of --chaos; default: a random seed, which is printed.")
    ] = None,
    faults: Annotated[
        int, typer.Option(min=1, max=100, help="Number of faults of --chaos; each kind happens at least once.")
    ] = 8,
    as_json: AsJson = False,
) -> None:
    """Check settings, clock, disk, data folder, database, kernels, scripts, the running server, and its workers.

    Prints one line for each check: ok, warning or fault, and what to do. The exit status is 1 if there are faults. On a
    machine without a server's data folder, use --no-local; while the server is stopped, use --no-remote. Only the token
    of an administrator shows workers and the reason why a server is not ready. If MAREY_SCRIPT_REPOSITORIES is set, the
    command also checks which limits and isolation this machine can enforce on scripts.

    With --chaos, the command creates a project, of which you are the owner, starts workers for this project only, kills
    and pauses them, ignores answers, and repeats requests with wrong times. Then the command checks that each job has
    exactly one visible result, and removes the project. With the usual leases of a minute, this takes a few minutes.
    """
    findings: list[Finding] = []
    if chaos:
        refuse_ignored(context, "with --chaos", "local", "remote", "data", "database_url")
        return _print(_inject_faults(context, seed, faults), as_json)
    refuse_ignored(context, "without --chaos", "seed", "faults")
    if not local:
        refuse_ignored(context, "with --no-local", "data", "database_url")
    if local:
        from marey_client import embedded

        findings += embedded.examine(data=data, database_url=database_url)
    findings += _check_scripts()
    if remote:
        from marey_client.marey import Marey
        from marey_client.retries import ONCE

        credential = credential_of(context)
        with Marey(credential.url, credential.bearer, retries=ONCE, timeout_s=10.0) as marey:
            findings += check_server(marey)
    return _print(findings, as_json)


def _check_scripts() -> list[Finding]:
    """Return the finding about the isolation of scripts; no finding unless workers of this machine run scripts."""
    from marey_client import embedded
    from marey_schemas.queue.scripts import REPOSITORIES_VARIABLE

    return [embedded.examine_scripts()] if REPOSITORIES_VARIABLE in os.environ else []


def _print(findings: list[Finding], as_json: bool) -> None:
    if as_json:
        print_json([{"check": check, "state": state, "detail": detail} for check, state, detail in findings])
    else:
        for check, state, detail in findings:
            typer.echo(f"{state:<7}  {check}: {detail}")
    if any(state == "fault" for _, state, _ in findings):
        raise typer.Exit(1)


def _inject_faults(context: typer.Context, seed: int | None, faults: int) -> list[Finding]:
    """Inject faults into the running server; the seed is printed first, so that it is known even after a crash."""
    import secrets

    from marey_client.chaos.running import run_chaos

    chosen = secrets.randbelow(2**31) if seed is None else seed
    print_message(f"seed {chosen}")
    with connect(context) as marey, interrupted_by_sigterm(), progress() as advance:
        found = list(run_chaos(marey, chosen, faults, advance))
    return [(one.check, "fault" if one.fault else "ok", one.fault or one.detail) for one in found]


def check_server(marey: Marey) -> Iterator[Finding]:
    """Yield the findings about the running server: ready, version, and workers."""
    from marey_client.errors import MareyError, RequestFailed, Unreachable

    transport = marey.transport
    try:
        found = transport.send("GET", f"{transport.url}/").json()
        transport.send("GET", f"{transport.url}/readyz")
    except Unreachable as error:
        yield "server", "fault", f"{error}; start it with `marey serve`, or name it with --server"
        return
    except MareyError as error:
        yield "server", "fault", str(error)
        return
    yield "server", "ok", f"{transport.url} is ready"
    own, its = version("marey"), found["version"]
    advice = "the same as here" if own == its else f"here it is {own}; install the same version"
    yield "version of the server", "ok" if own == its else "warning", f"{its}, {advice}"
    try:
        yield _check_workers(marey, its)
    except RequestFailed as error:
        yield "workers", "ok", f"not checked, because the token may not list workers ({error})"


def _check_workers(marey: Marey, its: str) -> Finding:
    alive = [worker for worker in marey.workers() if worker.alive]
    other = sorted(worker.name for worker in alive if worker.kinds is not None and worker.version != its)
    if not alive:
        return "workers", "warning", "no worker is alive, so jobs wait; start one with `marey worker`"
    if other:
        return "workers", "warning", f"{', '.join(other)}: not of version {its}; install it there and restart them"
    return "workers", "ok", f"{len(alive)} alive"
