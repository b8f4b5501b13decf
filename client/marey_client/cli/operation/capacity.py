"""Command `capacity`, which computes how busy an amount of work keeps workers, servers and database."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from marey_client.cli.terminal.invocation import AsJson
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table

MOST = 10**15
"""Greatest value of each option, far below the greatest float, so that the computation cannot overflow."""


def add_to(app: typer.Typer) -> None:
    """Add the command of this module to the application `app`."""
    app.command()(capacity)


def capacity(
    clips: Annotated[int, typer.Option(min=1, max=MOST, help="Number of clips to import and process.")] = 10_000_000,
    jobs_per_clip: Annotated[float, typer.Option(min=0, max=MOST, help="Number of jobs for each clip.")] = 1.0,
    clip_bytes: Annotated[float, typer.Option(min=1, max=MOST, help="Size of an uploaded file, in bytes.")] = 500_000.0,
    days: Annotated[float, typer.Option(min=0.001, max=MOST, help="Number of days in which all work is done.")] = 30.0,
    workers: Annotated[int, typer.Option(min=1, max=MOST, help="Number of workers, each with one slot.")] = 1000,
    servers: Annotated[
        int, typer.Option(min=1, max=MOST, help="Number of server processes that share the database.")
    ] = 100,
    database_processors: Annotated[
        int, typer.Option(min=1, max=MOST, help="Number of processors of the machine on which the database runs.")
    ] = 8,
    costs: Annotated[
        Path | None, typer.Option(help="File of measured costs; default: the file that is part of this version.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compute how busy a number of clips keeps workers, servers and database, and which of them saturates first.

    The numbers are computed from measured costs of a job, a clip and a byte; this command measures nothing. The numbers
    hold for machines like the one on which the costs were measured. Pauses, failures and networks are not included.
    """
    from marey_client import embedded

    found = embedded.compute_capacity(
        costs=costs, clips=clips, jobs_per_clip=jobs_per_clip, clip_bytes=clip_bytes, days=days, workers=workers,
        servers=servers, database_processors=database_processors,
    )  # fmt: skip
    if as_json:
        return print_json(found)
    print_table(
        ("part", "needed hours", "available hours", "used"),
        [
            (
                part["name"],
                f"{part['needed_s'] / 3600:,.1f}",
                f"{part['available_s'] / 3600:,.1f}",
                _percent(part["share"]),
            )
            for part in found["parts"]
        ],
        right=("needed hours", "available hours", "used"),
    )
    print_pairs(
        [
            ("saturates first", f"{found['first']}, at {found['clips_per_day']:,.0f} clips per day"),
            ("blobs", f"{found['blob_bytes'] / 1e12:,.2f} TB"),
            ("rows of jobs", f"{found['database_bytes'] / 1e9:,.1f} GB"),
        ]
    )
    measured = found["measured"]
    print_message(f"costs measured on {measured['date']}: {measured['machine']}; {measured['load']}")
    return None


def _percent(share: float) -> str:
    return f"{100 * share:,.{1 if share >= 0.001 else 2}f} %"
