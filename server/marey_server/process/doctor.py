"""Checks of a server's machine: settings, disk, database, kernels, and sign-in.

The checks also work while no server runs. They do not change stored data, and do not create a missing database.
"""

from __future__ import annotations

import asyncio
import os
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from typing import Literal, NamedTuple
from urllib.parse import urlsplit

from marey_motion.warm_up import kernels_are_compiled
from marey_schemas.address import ADMIN_TOKEN_FILE
from marey_server.access.principal import SYSTEM
from marey_server.errors import ApiProblem, UnavailableProblem
from marey_server.process.disk_space import DiskSpace
from marey_server.process.identity_provider import IdentityProvider
from marey_server.process.setting_faults import misspelt_variables
from marey_server.process.settings import PREFIX, Settings
from marey_server.store.clock_setting import read_clock
from marey_server.store.database.connections import Database
from marey_server.store.database.opening import DatabaseUnusable, opening, sqlite_file
from marey_server.store.monitoring.readiness import find_faults

CLOCK_AHEAD_S = 60
"""Number of seconds by which the stored clock may be ahead of the clock of this machine."""


class Finding(NamedTuple):
    """Result of one check; the detail of a warning or fault says what to do."""

    check: str
    state: Literal["ok", "warning", "fault"]
    detail: str


def examine(
    settings: Settings,
    environment: Mapping[str, str],
    connect: Callable[[Settings], Database],
    url_in_command: str | None = None,
) -> Iterator[Finding]:
    """Yield one finding for each check of this machine; `connect` opens the database of the settings.

    `url_in_command` is the URL of the database if the command line names it.
    """
    yield _check_variables(environment)
    yield _check_disk(settings)
    yield _check_rights(settings)
    yield _check_secrets(settings, url_in_command)
    yield from _check_database(settings, connect)
    if settings.oidc_issuer is not None:
        yield _check_identity_provider(settings)
    compiled = kernels_are_compiled()
    missing = "not all kernels are compiled, so first uses wait; run `python -m marey_motion.warm_up`"
    yield Finding("kernels", "ok" if compiled else "warning", "compiled" if compiled else missing)


def _check_variables(environment: Mapping[str, str]) -> Finding:
    wrong = [f"{name} has no effect; did you mean {meant}?" for name, meant in misspelt_variables(environment).items()]
    return Finding("settings", "warning" if wrong else "ok", " ".join(wrong) or "valid")


def _check_disk(settings: Settings) -> Finding:
    fault = DiskSpace(settings.data, settings.min_free_bytes).fault()
    return Finding("disk", "fault" if fault else "ok", fault or "enough space is free")


def _check_rights(settings: Settings) -> Finding:
    folder = settings.data
    if not folder.is_dir():
        return Finding("data folder", "fault", f"there is no folder {folder}; name it with --data, or start the server")
    if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
        return Finding("data folder", "fault", f"{folder} cannot be written by this user; run as the server's user")
    if stat.S_IMODE(folder.stat().st_mode) & 0o077:
        return Finding("data folder", "warning", f"other users can open {folder}; run `chmod 700 {folder}`")
    return Finding("data folder", "ok", f"only its owner can open {folder}")


def _check_identity_provider(settings: Settings) -> Finding:
    provider = IdentityProvider(settings)
    try:
        asyncio.run(provider.check())
    except UnavailableProblem as error:
        return Finding("identity provider", "fault", error.detail)
    return Finding("identity provider", "ok", f"it answers; register the redirect URI {provider.redirect_uri} there")


def _check_secrets(settings: Settings, url_in_command: str | None) -> Finding:
    """Check who can read the files that contain secrets, and that the command line contains no password."""
    files = (
        settings.database_password_file,
        settings.s3_secret_key_file,
        settings.oidc_client_secret_file,
        settings.data / ADMIN_TOKEN_FILE,
    )
    readable = [file for file in files if file is not None and file.is_file() and file.stat().st_mode & 0o007]
    warnings = [f"all users can open {file}; run `chmod o-rwx {file}`." for file in readable]
    if url_in_command is not None and urlsplit(url_in_command).password is not None:
        warnings.append(
            "other users can read the password in --database-url in the list of processes; name a file with "
            f"{PREFIX}DATABASE_PASSWORD_FILE, or give the whole URL in the variable {PREFIX}DATABASE_URL."
        )
    return Finding("secrets", "warning" if warnings else "ok", " ".join(warnings) or "not readable by all users")


def _check_database(settings: Settings, connect: Callable[[Settings], Database]) -> Iterator[Finding]:
    file = sqlite_file(settings.resolved_database_url)
    if file is not None and not file.is_file():
        yield Finding("database", "fault", f"there is no database {file}; name its folder with --data")
        return
    try:
        with opening(settings.resolved_database_url), closing(connect(settings)) as database:
            faults = database.read(SYSTEM, find_faults)
            clock = database.read(SYSTEM, lambda tx: read_clock(tx.connection)) if database.is_sqlite else None
    except (DatabaseUnusable, ApiProblem) as error:
        yield Finding("database", "fault", str(error))
        return
    yield Finding("database", "fault" if faults else "ok", "; ".join(faults) or "reachable, with the current tables")
    if clock is not None:
        ahead = clock.stored_us - clock.wall_us > CLOCK_AHEAD_S * 1_000_000
        advice = "; correct the clock of this machine, or stop the server and run `marey db clock --set`"
        yield Finding("clock", "warning" if ahead else "ok", f"{clock}{advice if ahead else ''}")
