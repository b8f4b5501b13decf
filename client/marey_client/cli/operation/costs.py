"""Command `bench costs`, which measures the costs of a job, and predicts jobs per second from them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.operation.bench import Seed, WorkMs, bench
from marey_client.cli.terminal.failures import WrongUsage, interrupted_by_sigterm
from marey_client.cli.terminal.invocation import AsJson
from marey_client.cli.terminal.output import print_json, print_pairs, print_table
from marey_client.progress import progress

if TYPE_CHECKING:
    from marey_client.load.calibrating import Calibration

CHECKED = "2,8"
MOST_CHECKED = 64
FURTHER = 32
"""Number of workers for which jobs per second are always predicted, but not measured."""


def add_to(_app: typer.Typer) -> None:
    """Register the command of this module in the group `bench`."""
    bench.command("costs")(measure_costs)


def measure_costs(
    database_url: Annotated[
        str | None, typer.Option(help="URL of an empty Postgres database; default: an SQLite file.")
    ] = None,
    workers: Annotated[
        str, typer.Option(help="Numbers of workers for which jobs per second are predicted and measured.")
    ] = CHECKED,
    rounds: Annotated[
        int, typer.Option(min=1, max=20, help="Number of rounds; each round measures every number of workers once.")
    ] = 5,
    work_ms: WorkMs = 0.0,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Measure the costs of a job on a new server, predict jobs per second from them, and compare with measurements.

    The costs come from runs with 1, 4 and 16 workers. A simulation of the queue predicts the jobs per second of
    other numbers of workers, which are measured in the same rounds. The server is removed at the end.
    """
    from dataclasses import asdict

    from marey_client import embedded
    from marey_client.load.calibrating import ALONE, CROWDED, SOME, calibrate
    from marey_client.load.own_server import own_server

    counts = _counts(workers, (ALONE, SOME, CROWDED))
    if database_url is not None:
        embedded.database("require_empty", data=None, database_url=database_url)
    with interrupted_by_sigterm(), own_server(database_url) as marey, progress() as advance:
        found = calibrate(
            marey, counts, rounds=rounds, work_s=work_ms / 1000, on_drain=lambda what: advance(what, 0, None)
        )
    known = (SOME, found.some_per_s)
    predicted = embedded.predict_jobs(_job_costs(found), known, (*counts, FURTHER), found.work_s, seed)
    if as_json:
        print_json({**asdict(found), "predicted": predicted, "difference": _differences(found, predicted)})
    else:
        _print(found, predicted)


def _counts(text: str, used: tuple[int, ...]) -> tuple[int, ...]:
    """Parse numbers of workers. Raises `WrongUsage` if a number is not valid, or is one of `used`."""
    try:
        counts = tuple(int(one) for one in text.split(","))
    except ValueError:
        counts = ()
    if not counts or not all(1 < count <= MOST_CHECKED and count not in used for count in counts):
        raise WrongUsage(
            f"--workers {text}: give numbers from 2 to {MOST_CHECKED} with commas between them, such as {CHECKED}; "
            f"leave out {', '.join(map(str, used))}, because the costs are measured with these numbers"
        )
    return counts


def _job_costs(found: Calibration) -> dict[str, float]:
    """Return the costs of a job for a simulation of the queue, which does not need the costs of the database."""
    return {
        "claim_s": found.claim_s, "complete_s": found.complete_s, "busy_s": found.busy_s,
        "variation": found.variation, "database_s": 0.0, "database_bytes": 0.0,
    }  # fmt: skip


def _differences(found: Calibration, predicted: dict[int, float]) -> dict[int, float]:
    """Return the relative error of the prediction, predicted / measured - 1, by number of workers."""
    return {count: predicted[count] / measured - 1 for count, measured in found.checked.items()}


def _print(found: Calibration, predicted: dict[int, float]) -> None:
    differences = _differences(found, predicted)
    rows = [
        (
            count,
            f"{expected:.1f}",
            f"{found.checked[count]:.1f}" if count in differences else "",
            f"{100 * differences[count]:+.1f} %" if count in differences else "",
        )
        for count, expected in predicted.items()
    ]
    columns = ("workers", "predicted jobs/s", "measured jobs/s", "difference")
    print_table(columns, rows, right=columns)
    print_pairs(
        [
            ("claim", f"{1e3 * found.claim_s:.2f} ms"),
            ("completion", f"{1e3 * found.complete_s:.2f} ms"),
            ("variation of requests", f"{found.variation:.2f}"),
            ("work", f"{1e3 * found.work_s:.2f} ms"),
            ("server occupied", f"{1e3 * found.busy_s:.2f} ms per job"),
            ("processor time", f"{1e3 * found.processor_s:.2f} ms per job"),
            ("database", f"{found.database_bytes:,.0f} bytes per job"),
        ]
    )
