"""Program of one of several server processes that share a port: `python -m marey_server.process_program`.

Only the parent of the processes starts it (see `shared_port.parent`), with a socket as its standard input.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from collections.abc import Sequence
from contextlib import AsyncExitStack, nullcontext

from marey_schemas.processes.memory import loading_modules

with loading_modules():
    from marey_server.app import (
        Running,
        create_app,
        finish_start,
        listening,
        open_database,
        prepare_process,
        showing_metrics,
        stop_event,
        warming,
    )
    from marey_server.commands import CommandFailed, read_settings, run_server
    from marey_server.http.accepting import default_connections
    from marey_server.launchers.launcher import LauncherUnusable
    from marey_server.launchers.pools import find_launcher, keeping_workers
    from marey_server.process.settings import Settings
    from marey_server.shared_port.orders import KEEP_WORKERS, PROGRAM, READY, StartOrder

log = logging.getLogger(PROGRAM)  # `__name__` is `__main__`, since this module is run as a program

LINGER_S = 1.0
"""Seconds for which a stopping process still answers requests on open connections, so that no request is lost."""
FEWEST_CONNECTIONS = 16
FEWEST_THREADS = 2
FEWEST_CHILDREN = 2


def main() -> int:
    """Run a server process from the order on standard input; return its exit status."""
    control = socket.socket(fileno=os.dup(0))
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)  # so that no child process inherits the socket
    try:
        order = StartOrder.receive(control)
        settings = read_settings(**order.settings)
        run_server(serve_together(settings, order, control))
    except (CommandFailed, EOFError) as error:
        sys.stderr.write(f"server process {os.getpid()}: {error}\n")
        return 1
    return 0


async def serve_together(settings: Settings, order: StartOrder, control: socket.socket) -> None:
    """Run one of the processes of a server until SIGTERM or SIGINT, or until the parent has ended.

    Raises the errors of `listening`, `open_database` and `keeping_workers`.
    """
    own = share_of(settings)
    prepare_process(own)
    stop, keep_workers = stop_event(), asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, int)  # of a terminal; the parent decides what to do
    reader, writer = await asyncio.open_connection(sock=control)
    following = asyncio.create_task(_follow(reader, stop, keep_workers))
    if order.first:
        keep_workers.set()
    else:
        find_launcher(settings.launcher)
    async with AsyncExitStack() as stack:
        database = open_database(own, while_serving=not order.first)
        sockets, metrics_sockets = _opened(order.sockets), _opened(order.metrics_sockets)
        app = create_app(own, database)
        running = await stack.enter_async_context(listening(app, sockets, linger_s=LINGER_S))
        await stack.enter_async_context(showing_metrics(app.services, metrics_sockets))
        await stack.enter_async_context(warming(app.services.children) if own.warm_up else nullcontext())
        workers = await stack.enter_async_context(AsyncExitStack())
        if order.first:
            await workers.enter_async_context(keeping_workers(app.services, running.address))
        finish_start(running, greet=order.first)
        writer.write(READY)
        if not order.first:
            await _run_workers_when_asked(workers, running, stop, keep_workers)
        await stop.wait()
        log.info("server process %d is stopping", os.getpid())
    following.cancel()


def share_of(settings: Settings) -> Settings:
    """Return the settings of one process, with its share of each limit for all processes together."""
    count = settings.processes
    share = {
        "request_memory_bytes": settings.request_memory_bytes // count,
        "answer_cache_bytes": settings.answer_cache_bytes // count,
        "max_connections": max(FEWEST_CONNECTIONS, (settings.max_connections or default_connections()) // count),
        "database_threads": max(FEWEST_THREADS, -(-settings.resolved_database_threads // count)),
        "child_processes": max(FEWEST_CHILDREN, -(-settings.child_limits.children // count)),
        "child_requests": max(FEWEST_CHILDREN, settings.child_requests // count),
    }
    return settings.model_copy(update=share)


async def _follow(reader: asyncio.StreamReader, stop: asyncio.Event, keep_workers: asyncio.Event) -> None:
    """Read the messages of the parent process; when the parent has ended, stop this process."""
    while line := await reader.readline():
        if line == KEEP_WORKERS:
            keep_workers.set()
    stop.set()


async def _run_workers_when_asked(
    workers: AsyncExitStack, running: Running, stop: asyncio.Event, keep_workers: asyncio.Event
) -> None:
    """Wait until the parent asks this process to run the workers, and then run them.

    Return without running them if the process must stop first.
    """
    waiting = [asyncio.create_task(event.wait()) for event in (stop, keep_workers)]
    await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
    for task in waiting:
        task.cancel()
    if stop.is_set():
        return
    try:
        await workers.enter_async_context(keeping_workers(running.app.services, running.address))
    except LauncherUnusable as error:
        log.error("no workers can be started: %s", error)


def _opened(descriptors: Sequence[int]) -> list[socket.socket]:
    return [socket.socket(fileno=one) for one in descriptors]


if __name__ == "__main__":
    sys.exit(main())
