"""Access to the server, worker and motion packages for the commands that need them, such as `serve` and `worker`.

These packages are imported only when such a command runs, so that the client can be installed alone.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from marey_client.credentials import Credential
from marey_client.errors import MareyError
from marey_client.extras import import_optional, needing
from marey_schemas.documents.differences import Difference
from marey_schemas.lineage import LineageGraph
from marey_schemas.queue.comparisons import RunComparison


def serve(**settings: Any) -> None:
    """Run a server until it is stopped; settings that are None come from the environment or `marey.toml`."""
    commands = import_optional("marey_server.commands", "server")
    with _refusals_of(commands), needing("server"):
        commands.serve(**_given(settings))


def database(action: str, *, data: Path | None, database_url: str | None, **options: Any) -> None:
    """Run the database command `action`, a function of `marey_server.commands`, with the options that are given."""
    commands = import_optional("marey_server.commands", "server")
    with _refusals_of(commands), needing("server"):
        getattr(commands, action)(**_given({"data": data, "database_url": database_url}), **options)


def examine(*, data: Path | None, database_url: str | None) -> list[tuple[str, str, str]]:
    """Check a server's machine; return for each check its name, its state (ok, warning or fault) and a detail."""
    commands = import_optional("marey_server.commands", "server")
    found: list[tuple[str, str, str]] = commands.examine(**_given({"data": data, "database_url": database_url}))
    return found


def examine_scripts() -> tuple[str, str, str]:
    """Check which limits and isolation this machine can enforce on scripts; return check, state and detail as texts."""
    found: tuple[str, str, str] = import_optional("marey_worker.kinds.script", "worker").examine()
    return found


def compute_capacity(**amounts: Any) -> dict[str, Any]:
    """Return the needed and available time of workers, servers and database, and the measured costs of the computation.

    `amounts` are the options of `marey capacity`.
    """
    answers = import_optional("marey_server.capacity.answers", "server")
    try:
        found: dict[str, Any] = answers.capacity(**amounts)
    except answers.NotComputable as error:
        raise MareyError(str(error)) from error
    return found


def predict_jobs(
    job: dict[str, float], known: tuple[int, float], workers: tuple[int, ...], work_s: float, seed: int
) -> dict[int, float]:
    """Return the jobs per second that a simulation of the queue predicts for each number of workers.

    `known` is a number of workers whose jobs per second were measured, and this measured value.
    """
    answers = import_optional("marey_server.capacity.answers", "server")
    try:
        fitted = answers.fit_idle(job, *known, work_s, seed)
        found: dict[int, float] = answers.predict(fitted, workers, work_s, seed)
    except answers.NotComputable as error:
        raise MareyError(str(error)) from error
    return found


def work(credential: Credential, **options: Any) -> None:
    """Run jobs of a server until the worker is stopped."""
    commands = import_optional("marey_worker.commands", "worker")
    with needing("worker"):
        commands.work(credential, **options)


def draw_difference(difference: Difference, file_type: str) -> bytes:
    """Return a picture of a difference as a file of the type `png` or `svg`."""
    picture: bytes = import_optional("marey_reports.differences.picture", "figures").draw_difference(
        difference, file_type
    )
    return picture


def draw_lineage(graph: LineageGraph, file_type: str) -> bytes:
    """Return a picture of a lineage graph as a file of the type `svg`, `png` or `dot`.

    Raises `MareyError` if the graph is too large for a picture.
    """
    try:
        picture: bytes = import_optional("marey_reports.lineage.picture", "figures").draw_lineage(graph, file_type)
    except ValueError as error:
        raise MareyError(str(error)) from error
    return picture


def draw_comparison(comparison: RunComparison, **options: Any) -> bytes:
    """Return a page or a picture of a comparison of runs; `options` are those of
    `marey_reports.comparisons.page.draw_comparison`.

    Raises `MareyError` if the runs have no values for the wanted chart.
    """
    try:
        chart: bytes = import_optional("marey_reports.comparisons.page", "figures").draw_comparison(
            comparison, **options
        )
    except ValueError as error:
        raise MareyError(str(error)) from error
    return chart


@contextmanager
def server_in_thread(data: Path, *, workers: int) -> Iterator[str]:
    """Run a server with workers on a free local port until the `with` block ends; yield the server's address."""
    app = import_optional("marey_server.app", "all")
    settings = import_optional("marey_server.process.settings", "all").Settings(
        data=data, host="127.0.0.1", port=0, local_workers=workers, log_form="text"
    )
    started: Future[str] = Future()
    stop = threading.Event()

    async def run() -> None:
        async with app.serving(settings) as running:
            started.set_result(running.address)
            await asyncio.get_running_loop().run_in_executor(None, stop.wait)

    def main() -> None:
        try:
            asyncio.run(run())
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)

    thread = threading.Thread(target=main, name="marey-server")
    thread.start()
    try:
        yield started.result()
    finally:
        stop.set()
        thread.join()


@contextmanager
def _refusals_of(commands: ModuleType) -> Iterator[None]:
    """Convert `CommandFailed` errors of the module `commands`, raised in the `with` block, into `MareyError`."""
    try:
        yield
    except commands.CommandFailed as refusal:
        raise MareyError(str(refusal)) from refusal


def _given(settings: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if value is not None}
