"""Tornado application of the server: construction, start and stop."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import shlex
import signal
import socket
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.routing import AnyMatches, Rule
from tornado.web import Application as TornadoApplication
from tornado.web import RequestHandler

from marey_schemas.address import ADMIN_TOKEN_FILE
from marey_schemas.processes.environment import clean_environment
from marey_schemas.processes.memory import keep_freed_memory
from marey_schemas.sizes import KIB, MIB
from marey_schemas.tracing.spans import AttributeValue
from marey_server.access.principal import SYSTEM
from marey_server.errors import StoppingProblem
from marey_server.handlers.catalogue import RESOURCES
from marey_server.handlers.health import RESOURCES as MONITORING
from marey_server.http.accepting import (
    ACCEPTED_AT_ONCE,
    ADDRESS_SHARE,
    Connections,
    address_of,
    default_connections,
    listen,
    raise_descriptor_limit,
)
from marey_server.http.resource import Resource
from marey_server.http.routes import RouteTable
from marey_server.launchers.pools import keeping_workers
from marey_server.process import programs
from marey_server.process.administrators import make_first_administrator
from marey_server.process.children import Children
from marey_server.process.computing import compute_on_one_thread_each
from marey_server.process.data_folder import BLOB_FOLDER, prepare_data_folder
from marey_server.process.feed import following_feed
from marey_server.process.housekeeping import running_housekeeping
from marey_server.process.notices import note_ready, note_stopping
from marey_server.process.observe import access_log, configure_logging
from marey_server.process.services import Services
from marey_server.process.setting_faults import misspelt_variables
from marey_server.process.settings import Settings
from marey_server.store import users
from marey_server.store.blob_backings import BlobBacking, DatabaseBlobs, DirectoryBlobs
from marey_server.store.database.connections import Database
from marey_server.store.database.opening import DatabaseUnusable, opening
from marey_server.store.database.schema import upgrade_schema
from marey_server.store.object_storage.backing import ObjectBlobs
from marey_server.store.object_storage.client import ObjectStorage
from marey_server.store.wakeups import wakeups
from marey_server.webhooks.delivering import delivering

log = logging.getLogger(__name__)

ABORT_S = 1.0
"""Greatest number of seconds that a stopping server waits until aborted requests are answered."""
READ_CHUNK_BYTES = 256 * KIB
READ_BUFFER_BYTES = MIB
FIRST_COMMAND = "marey project create lab"


class Application(TornadoApplication):
    """Tornado application: routes, and the services that their handlers share."""

    def __init__(self, resources: Sequence[type[Resource]], services: Services) -> None:
        self.services = services
        super().__init__([Rule(AnyMatches(), RouteTable(self, resources))], log_function=self.record_request)

    def record_request(self, handler: RequestHandler) -> None:
        """Log and count a request after its answer was written."""
        if not isinstance(handler, Resource):
            return
        duration_s = handler.request.request_time()
        route = handler.template()
        status = handler.get_status()
        method = handler.request.method if handler.request.method in handler.SUPPORTED_METHODS else "(unknown)"
        self.services.metrics.count_request(method, route, status, duration_s, handler.received_bytes)
        if handler.problem_code is not None:
            self.services.metrics.refusals.labels(handler.problem_code, route).inc()
        if handler.trace is not None:
            handler.trace.finish(
                f"{method} {route}",
                handler.principal,
                uneventful=handler.uneventful and status < 400,
                attributes=_span_attributes(handler, method, route, status),
            )
        level = logging.ERROR if status >= 500 and handler.problem_code != StoppingProblem.code else logging.INFO
        if handler.uneventful and status < 400:
            level = logging.DEBUG
        if access_log.isEnabledFor(level):
            access_log.log(level, "%s %s %d", method, route, status, extra=_fields(handler, route, status, duration_s))


def _span_attributes(handler: Resource, method: str, route: str, status: int) -> dict[str, AttributeValue]:
    attributes: dict[str, AttributeValue] = {
        "http.request.method": method,
        "http.route": route,
        "http.response.status_code": status,
        "marey.request_id": handler.request_id,
    }
    return attributes if status < 500 else {**attributes, "error.type": handler.problem_code or str(status)}


def _fields(handler: Resource, route: str, status: int, duration_s: float) -> dict[str, Any]:
    return {
        "request_id": handler.request_id,
        "trace_id": handler.trace_id,
        "principal": handler.principal.actor if handler.principal is not None else None,
        "method": handler.request.method,
        "route": route,
        "status": status,
        "duration_ms": round(duration_s * 1000, 2),
        "bytes_in": handler.received_bytes,
        "remote": handler.client_address,
    }


def create_app(settings: Settings, database: Database, children: Children | None = None) -> Application:
    """Return an application that uses a database with the current schema.

    Several applications may share the child processes `children`.
    """
    return Application(RESOURCES, Services(settings, database, children))


@dataclass(frozen=True)
class Running:
    """Server that accepts requests; `address` is the URL at which clients reach it."""

    app: Application
    address: str
    server: HTTPServer


@asynccontextmanager
async def listening(
    app: Application, sockets: Sequence[socket.socket] | None = None, *, linger_s: float = 0.0
) -> AsyncIterator[Running]:
    """Accept requests while the `async with` block runs, at `sockets` or at the address in the settings.

    At the end of the block, no more connections are accepted. For `linger_s` seconds, requests on open connections are
    still answered, and the answers ask clients to close the connections. Everything is closed when the running requests
    have ended, at the latest after `drain_s` more seconds. Raises `CannotListen` if the address cannot be used.
    """
    settings = app.services.settings
    if sockets is None:
        sockets = listen(settings.host, settings.port)
    server = HTTPServer(
        app,
        idle_connection_timeout=settings.header_timeout_s,
        body_timeout=settings.body_timeout_s,
        max_header_size=settings.max_header_bytes,
        max_body_size=2**62,
        chunk_size=READ_CHUNK_BYTES,
        max_buffer_size=READ_BUFFER_BYTES,
    )
    connections = accept_connections(app, server, sockets)
    address = address_of(sockets)
    try:
        async with running_housekeeping(app.services), following_feed(app.services), delivering(app.services):
            try:
                yield Running(app, address, server)
                await _linger(app.services, connections, linger_s)
            finally:  # first, because the end of housekeeping can wait long for a write
                await _drain(app.services, server, connections)
    finally:
        app.services.close()


@asynccontextmanager
async def showing_metrics(services: Services, sockets: Sequence[socket.socket]) -> AsyncIterator[None]:
    """Answer requests for metrics and health at `sockets`, too, while the `async with` block runs."""
    server = HTTPServer(
        Application(MONITORING, services),
        idle_connection_timeout=services.settings.header_timeout_s,
        max_header_size=services.settings.max_header_bytes,
    )
    server.add_sockets(sockets)
    try:
        yield
    finally:
        server.stop()
        await server.close_all_connections()


def accept_connections(app: Application, server: HTTPServer, sockets: Sequence[socket.socket]) -> Connections:
    """Accept as many connections as the settings allow; return the object that manages them."""
    settings, in_flight = app.services.settings, app.services.in_flight
    most = settings.max_connections or default_connections()
    connections = Connections(
        server,
        most=most,
        most_each=most if settings.trust_proxy else int(most * ADDRESS_SHARE),
        write_timeout_s=settings.write_timeout_s,
        busy=lambda: {request.stream for request in in_flight if not request.awaits_guest},
        count_closed=lambda reason: app.services.metrics.closed.labels(reason).inc(),
        at_once=ACCEPTED_AT_ONCE if settings.processes == 1 else 1,  # so that other processes get connections, too
    )
    app.services.metrics.connections.set_function(lambda: len(connections))
    connections.accept_from(sockets)
    return connections


async def _linger(services: Services, connections: Connections, linger_s: float) -> None:
    """Stop accepting connections; wait until clients have closed all connections, but at most `linger_s` seconds."""
    services.lingering = True
    connections.stop()
    deadline = time.monotonic() + linger_s
    while len(connections) and time.monotonic() < deadline:
        await asyncio.sleep(0.02)


async def _drain(services: Services, server: HTTPServer, connections: Connections) -> None:
    """Refuse new requests, wait for those in progress at most `drain_s` seconds, and close all connections."""
    services.draining.set()
    services.metrics.draining.set(1)
    wakeups.wake_everybody()
    connections.stop()
    deadline = time.monotonic() + services.settings.drain_s
    while services.in_flight and time.monotonic() < deadline:
        await asyncio.sleep(0.02)
    if services.in_flight:
        await _abort_requests(services)
    await server.close_all_connections()
    connections.close()


async def _abort_requests(services: Services) -> None:
    """Abort the requests that are in progress, while the threads and the database can still be used."""
    log.warning(
        "%d requests had not ended after the time for running requests (drain_s) and were aborted",
        len(services.in_flight),
    )
    for request in list(services.in_flight):
        request.abort()
    deadline = time.monotonic() + ABORT_S
    while services.in_flight and time.monotonic() < deadline:
        await asyncio.sleep(0.02)


def open_database(settings: Settings, *, while_serving: bool = False) -> Database:
    """Open the database of a server; create its folder, tables and first administrator if they are missing.

    Raises `DatabaseUnusable` if the database cannot be opened or upgraded; with `while_serving` also if other processes
    of the server, which may be of an earlier version, could not go on after the upgrade.
    """
    with opening(settings.resolved_database_url):
        prepare_data_folder(settings)
        upgraded = upgrade_schema(settings.resolved_database_url, while_serving=while_serving)
        if upgraded.waiting:
            log.info("when all servers have this version, run `marey db upgrade --finish`")
        database = connect_database(settings)
        database.write(SYSTEM, make_first_administrator, settings.data / ADMIN_TOKEN_FILE)
    return database


def connect_database(settings: Settings) -> Database:
    """Connect to the database without upgrading its tables."""
    return Database(
        settings.resolved_database_url,
        readers=settings.resolved_database_threads,
        blobs=_backing_of(settings),
        quotas=settings.quotas,
        pod_rules=None if settings.own_pods is None else settings.own_pods.rules,
    )


def _backing_of(settings: Settings) -> BlobBacking | ObjectBlobs:
    """Return the storage of blobs. Raises `DatabaseUnusable` if the package for object storage is not installed."""
    folder = settings.data / BLOB_FOLDER
    has_files = settings.blobs == "directory" or (settings.blobs == "s3" and folder.is_dir())
    local = DirectoryBlobs(folder) if has_files else DatabaseBlobs()
    if settings.bucket is None:
        return local
    try:
        storage = ObjectStorage(settings.bucket)
    except ModuleNotFoundError as error:
        raise DatabaseUnusable(
            'blobs in a bucket (the setting s3_bucket) need an optional package; run pip install "marey[s3]"'
        ) from error
    return ObjectBlobs(storage, local, stores_objects=settings.blobs == "s3")


async def serve(settings: Settings) -> None:
    """Run a server until SIGTERM or SIGINT."""
    prepare_process(settings)
    stop = stop_event()
    metrics_sockets = [] if settings.metrics_port is None else listen(settings.host, settings.metrics_port)
    async with (
        serving(settings) as running,
        showing_metrics(running.app.services, metrics_sockets),
        warming(running.app.services.children) if settings.warm_up else nullcontext(),
    ):
        finish_start(running)
        note_ready()
        await stop.wait()
        note_stopping()
        log.info("stopping")


def prepare_process(settings: Settings) -> None:
    """Set up the log and the limits of a process that will be a server."""
    configure_logging(settings.log_form, settings.log_level)
    for variable, meant in misspelt_variables(os.environ).items():
        log.warning("%s is not a setting and has no effect; did you mean %s?", variable, meant)
    keep_freed_memory()
    raise_descriptor_limit()
    compute_on_one_thread_each()


def stop_event() -> asyncio.Event:
    """Return an event that SIGTERM or SIGINT sets."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    return stop


def finish_start(running: Running, *, greet: bool = True) -> None:
    """Print the greeting of a server that has started, unless `greet` is false.

    Also exclude all existing objects from the garbage collection of Python. Nearly all of them belong to modules. If a
    full garbage collection examined them, it would stop the server for 0.1 s each time.
    """
    gc.freeze()
    if greet:
        services = running.app.services
        for line in greeting(services.settings, running.address, services.database):
            log.info("%s", line)


@asynccontextmanager
async def warming(children: Children) -> AsyncIterator[None]:
    """Compile all numeric kernels in a separate process, then start the child processes in `children`.

    The server answers requests meanwhile. At the end of the `async with` block, an unfinished compilation is stopped.
    """
    process = await programs.start_program("-m", "marey_motion.warm_up", environment=clean_environment())

    async def warm() -> None:
        await process.wait()
        children.warm()

    warming = asyncio.create_task(warm())
    try:
        yield
    finally:
        warming.cancel()
        if process.returncode is None:
            process.kill()
            await process.wait()


@asynccontextmanager
async def serving(settings: Settings) -> AsyncIterator[Running]:
    """Run a server with its database and workers while the `async with` block runs; then stop, workers first.

    Workers of engines such as Slurm continue. Raises `CannotListen` if the address cannot be used, and
    `LauncherUnusable` if workers cannot be started as the settings demand.
    """
    database = open_database(settings)
    async with (
        listening(create_app(settings, database)) as running,
        keeping_workers(running.app.services, running.address),
    ):
        yield running


def greeting(settings: Settings, address: str, database: Database) -> Iterator[str]:
    """Return the lines that a server prints when it has started; they contain no secret."""
    yield f"listening on {address}"
    data = settings.data.absolute()
    yield f"data: {data}; database: {database.shown}"
    administrator = database.read(SYSTEM, users.administrator_principal).user_name
    token_file = data / ADMIN_TOKEN_FILE
    if token_file.is_file():
        yield f"administrator: {administrator}; a token of an administrator is in {token_file}"
    else:
        yield (
            f"administrator: {administrator}; if no token of an administrator is left, `marey db admin-token` "
            "creates one"
        )
    yield f"next, in another terminal{next_command(settings, address)}"


def next_command(settings: Settings, address: str) -> str:
    """Return the end of the sentence "next, in another terminal": the first command to run, with needed options."""
    reachable = address.replace("//0.0.0.0:", "//127.0.0.1:").replace("//[::]:", "//[::1]:")
    defaults = Settings.model_fields
    usual_address = f"http://{defaults['host'].default}:{defaults['port'].default}"
    if reachable == usual_address and settings.data.absolute() == defaults["data"].default.absolute():
        return f" in this folder: {FIRST_COMMAND}"
    token_file = settings.data.absolute() / ADMIN_TOKEN_FILE
    if not token_file.is_file():
        return f": marey login --server {reachable}"
    program, words = FIRST_COMMAND.split(" ", 1)
    return f": {program} --server {reachable} --token-file {shlex.quote(str(token_file))} {words}"
