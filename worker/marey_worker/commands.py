"""Command line of the worker."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast, get_args

from marey_client.credentials import Credential, resolve
from marey_client.errors import MareyError, NoCredential
from marey_client.retries import Retries
from marey_client.transport import Transport
from marey_schemas.queue.job_kinds import UnknownKindError, find_kind
from marey_schemas.queue.log_lines import LogForm, log_to_standard_error, usual_form
from marey_schemas.queue.scripts import REPOSITORIES_VARIABLE, SCRIPT
from marey_schemas.sizes import MIB
from marey_schemas.tracing.export import closing, open_optional_tracer
from marey_worker.one_job import NamedJob, OneJobWorker
from marey_worker.scratch import remove_abandoned
from marey_worker.supervisor import Supervisor, WorkerOptions, default_cache, runnable_kinds

SERVICE = "marey-worker"
"""Name under which collectors show a worker, unless a variable of OpenTelemetry names another."""
BRIEF = Retries(tries=6)
"""Retries of an attempt's requests, limited so that a stopping worker does not wait long for an unreachable server."""


def work(
    credential: Credential,
    *,
    slots: int = 1,
    kinds: tuple[str, ...] = (),
    labels: Mapping[str, str] = MappingProxyType({}),
    name: str | None = None,
    cache: Path | None = None,
    cache_mb: int | None = None,
    log_form: LogForm | None = None,
    attached: bool = False,
    job: str | None = None,
    task: int | None = None,
) -> None:
    """Run a worker until SIGTERM or SIGINT, and exit; the status is not 0 if a job was running at that time.

    With `job`, the worker runs only this job, or the task of this job with the position `task`, and then ends.

    Without `log_form`, the variable `MAREY_LOG_FORM` sets the form of the log. If neither is given, log lines are text
    if standard error is a terminal, otherwise JSON. With `attached`, the worker also stops when standard input closes,
    because then the process that started it has ended. Raises `NoCredential` if there is no token.
    """
    if credential.token is None:
        raise NoCredential(
            f"a worker needs a token with the scope `work` for the server {credential.url}; give it with --token-file"
        )
    log_to_standard_error(log_form or _form_named(os.environ.get("MAREY_LOG_FORM")), _level_of(os.environ))
    logging.getLogger("httpx").setLevel(logging.WARNING)
    given: dict[str, Any] = {} if name is None else {"name": name}
    if cache_mb is not None:
        given["cache_bytes"] = cache_mb * MIB
    options = WorkerOptions(
        slots=slots, kinds=_known_kinds(kinds), labels=labels,
        cache=cache or default_cache(os.environ), **given,
    )  # fmt: skip
    remove_abandoned()
    tracer = open_optional_tracer(SERVICE, os.environ)
    transport = Transport(credential.url, credential.bearer, retries=BRIEF)
    worker: Supervisor | OneJobWorker
    if job is None:
        worker = Supervisor(transport, options, tracer)
    else:
        worker = OneJobWorker(transport, options, NamedJob(job, task), tracer)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: threading.Thread(target=worker.stop).start())
    if attached:
        threading.Thread(target=_stop_at_end_of_input, args=(worker,), name="attached", daemon=True).start()
    with closing(tracer):
        status = worker.run()
    logging.shutdown()
    os._exit(status)  # threads that wait for work hold nothing


def main() -> None:
    """Run the command line of `python -m marey_worker`, with which launchers start workers."""
    parser = argparse.ArgumentParser(prog="python -m marey_worker", description="Run jobs of a Marey server.")
    parser.add_argument("--server", help="server address; default: MAREY_SERVER, the stored login, or this machine")
    parser.add_argument("--slots", type=int, default=1, help="number of jobs that run at the same time; default: 1")
    parser.add_argument(
        "--kind", action="append", default=[], help="run only jobs of this kind; may be repeated; default: all kinds"
    )
    parser.add_argument(
        "--label", action="append", default=[], type=_label, metavar="NAME=VALUE",
        help="label of the worker, such as site=lyon; jobs can require labels; may be repeated; default: none",
    )  # fmt: skip
    parser.add_argument("--name", help="name of the worker, shown to people; default: host name and process id")
    parser.add_argument(
        "--cache", type=Path, help="folder in which downloaded inputs are cached; default: marey/inputs below ~/.cache"
    )
    parser.add_argument(
        "--token-file", type=Path,
        help="file with a token of the scope `work`; default: MAREY_TOKEN, the stored login, or a local server's token",
    )  # fmt: skip
    parser.add_argument(
        "--attached", action="store_true",
        help="read the token from standard input, and stop the worker when standard input closes",
    )  # fmt: skip
    given = parser.parse_args()
    try:
        credential = resolve(given.server, given.token_file, {} if given.attached else None)
        if given.attached:
            credential = Credential(credential.url, sys.stdin.readline().strip())
        work(
            credential,
            slots=given.slots,
            kinds=tuple(given.kind),
            labels=dict(given.label),
            name=given.name,
            cache=given.cache,
            attached=given.attached,
        )
    except MareyError as error:
        parser.exit(1, f"marey worker: {error}\n")


def _label(text: str) -> tuple[str, str]:
    name, assigned, value = text.partition("=")
    if not (name and assigned):
        raise argparse.ArgumentTypeError(f"{text!r} is not a label; write it like site=lyon")
    return name, value


def _form_named(name: str | None) -> LogForm:
    if name is None:
        return usual_form()
    if name not in get_args(LogForm):
        raise MareyError(f"MAREY_LOG_FORM is {name!r}; it must be {' or '.join(get_args(LogForm))}")
    return cast(LogForm, name)


def _level_of(environment: Mapping[str, str]) -> str:
    level = environment.get("MAREY_LOG_LEVEL", "info")
    if level.upper() not in logging.getLevelNamesMapping():
        raise MareyError(f"MAREY_LOG_LEVEL is {level!r}; it must be debug, info, warning or error")
    return level


def _known_kinds(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the kinds that the worker runs; scripts are among them only if the environment allows a repository."""
    try:
        runnable = runnable_kinds(os.environ)
        found = tuple(find_kind(name).name for name in names)
    except (UnknownKindError, ValueError) as error:
        raise MareyError(str(error)) from error
    if SCRIPT in found and SCRIPT not in runnable:
        raise MareyError(
            f"this worker cannot run scripts: set {REPOSITORIES_VARIABLE} to the repositories that scripts may use"
        )
    return found or runnable


def _stop_at_end_of_input(supervisor: Supervisor | OneJobWorker) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    supervisor.stop()
