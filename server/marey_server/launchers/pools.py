"""Start and stop of all workers of a server: a fixed number on its own machine, and the pools in its settings."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol, cast
from urllib.parse import urlsplit

from marey_server.launchers.launcher import (
    ENTRY_POINTS,
    LaunchContext,
    Launcher,
    LauncherUnusable,
    MakeLauncher,
    WorkerRequest,
)
from marey_server.launchers.local import LocalLauncher
from marey_server.launchers.pool_keeper import PoolKeeper
from marey_server.launchers.worker_tokens import keep_pool_token, make_worker_token
from marey_server.process.data_folder import worker_token_file
from marey_server.process.services import Services
from marey_server.process.worker_pools import WorkerPool

log = logging.getLogger(__name__)

BUILT_IN = {
    "kubernetes": "marey_server.launchers.kubernetes.launcher:make_kubernetes_launcher",
    "local": "marey_server.launchers.local:LocalLauncher",
    "slurm": "marey_server.launchers.slurm:SlurmLauncher",
}
"""Launchers of this package, which are imported only if the settings name them."""
DISPATCHER = "marey_server.launchers.kubernetes.dispatcher:Dispatcher"
"""Class that starts a pod for each job that needs one; imported only if the settings need it."""
FIXED_POOL = "local"
"""First part of the names of the workers that the setting `local_workers` starts; machine and port follow."""


@asynccontextmanager
async def keeping_workers(services: Services, address: str) -> AsyncIterator[None]:
    """Run the workers of a server that listens on `address` while the `async with` block runs.

    At the end of the block, the workers on this machine are stopped. Workers of other engines continue, and the next
    server finds them. Raises `LauncherUnusable` if the launcher does not exist, or its options are invalid.
    """
    settings = services.settings
    make = find_launcher(settings.launcher)
    port = urlsplit(address).port or settings.port  # the setting is 0 for any free port
    controllers: list[WorkerController] = [
        PoolKeeper(
            pool,
            _launcher_of(pool, make, services, address, port),
            services.database,
            [other for other in settings.pools if other.name != pool.name],
        )
        for pool in settings.pools
    ]
    fixed = None
    if settings.local_workers:
        token = make_worker_token(services.database, settings, port)
        data = settings.data.absolute()
        variables = settings.worker_trace_variables
        fixed = LocalLauncher(
            LaunchContext(FIXED_POOL, address, token, data, settings.log_form, settings.log_level, variables=variables)
        )
        await fixed.start(WorkerRequest(), settings.local_workers, key=f"{socket.gethostname()}-{port}")
    if settings.own_pods is not None:
        controllers.append(_dispatcher(services, address))
    if (settings.pools or settings.own_pods) and settings.worker_url is None and settings.launcher != "local":
        log.info("workers in pools reach this server at %s; the setting worker_url names another address", address)
    tasks = [asyncio.create_task(controller.keep()) for controller in controllers]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.gather(*(controller.close() for controller in controllers), *([fixed.close()] if fixed else []))


class WorkerController(Protocol):
    """Interface of a task that starts and stops workers.

    There is one for each pool, and one for jobs with their own pods.
    """

    async def keep(self) -> None:
        """Adjust the workers at regular intervals, until the task is cancelled."""
        ...

    async def close(self) -> None:
        """Release the resources, stop workers that do not outlive the server, and let another server take the lead."""
        ...


def _dispatcher(services: Services, address: str) -> WorkerController:
    """Return the task that starts pods for single jobs. Raises `LauncherUnusable` if its options are invalid."""
    settings = services.settings
    make = _load(EntryPoint("kubernetes", DISPATCHER, ENTRY_POINTS))
    return cast(WorkerController, make(settings, services.database, settings.worker_url or address))


def find_launcher(name: str) -> MakeLauncher:
    """Return the function that makes launchers, by the name of the launcher in the settings.

    Raises `LauncherUnusable` if there is no such launcher, or if it cannot be loaded.
    """
    if name in BUILT_IN:
        found = EntryPoint(name, BUILT_IN[name], ENTRY_POINTS)
    else:
        others = {one.name: one for one in entry_points(group=ENTRY_POINTS)}
        if name not in others:
            known = ", ".join(sorted({*BUILT_IN, *others}))
            raise LauncherUnusable(f"launcher: there is no launcher {name!r}; choose one of {known}")
        found = others[name]
    return cast(MakeLauncher, _load(found))


def _load(found: EntryPoint) -> Any:
    try:
        return found.load()
    except (ImportError, AttributeError) as error:
        raise LauncherUnusable(f"launcher: the launcher {found.name!r} cannot be loaded: {error}") from error


def _launcher_of(pool: WorkerPool, make: MakeLauncher, services: Services, address: str, port: int) -> Launcher:
    settings = services.settings
    file = worker_token_file(settings.data, pool.name)
    token = keep_pool_token(services.database, settings, port, pool.name, pool.labels, file)
    return make(
        LaunchContext(
            pool.name,
            settings.worker_url or address,
            token,
            settings.data.absolute(),
            settings.log_form,
            settings.log_level,
            {**settings.launcher_options, **pool.options},
            pool.labels,
            settings.worker_trace_variables,
        )
    )
