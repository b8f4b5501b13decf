"""Commands of `marey` for the server's own machine: serve, and maintenance of the database.

Functions print their results, and raise `CommandFailed` with an explanation if they fail.
"""

from __future__ import annotations

import asyncio
import os
import sqlite3
import sys
import time
import tomllib
from collections.abc import Callable, Coroutine, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_settings.exceptions import SettingsError

from marey_schemas.address import ADMIN_TOKEN_FILE, SETTINGS_FILE
from marey_schemas.processes.memory import loading_modules
from marey_schemas.queue.log_lines import usual_form
from marey_schemas.wording import counted
from marey_server.process.setting_faults import explain_faults, explain_variable
from marey_server.process.settings import Settings

PROGRESS_EVERY_S = 5.0


class CommandFailed(Exception):
    """Error of a command that failed; its text gives the reason and what to do."""


def serve(**settings: Any) -> None:
    """Run a server and the requested number of workers until SIGTERM or SIGINT."""
    chosen = read_settings(**settings)
    comfort = {"local_workers": 0 if chosen.pools else 1, "log_form": usual_form()}
    unset = {name: value for name, value in comfort.items() if name not in chosen.model_fields_set}
    if chosen.processes > 1:
        _serve_in_processes({**settings, **unset})
        return
    with loading_modules():
        from marey_server.app import serve as serve_until_stopped

    run_server(serve_until_stopped(read_settings(**settings, **unset)))


def _serve_in_processes(given: dict[str, Any]) -> None:
    """Run several server processes that share a port, until SIGTERM or SIGINT.

    The parent process passes the settings `given`, which come from the command line, to each server process.
    """
    from marey_server.shared_port.parent import serve_in_processes

    chosen = read_settings(**given)
    if sys.platform == "win32":
        raise CommandFailed("several server processes cannot share a port on Windows; set `processes` to 1")
    if chosen.resolved_database_url.startswith("sqlite"):
        raise CommandFailed(
            "several server processes need Postgres, because only one process may write to an SQLite file; "
            "name a database with --database-url, or set `processes` to 1"
        )
    run_server(serve_in_processes(chosen, {**given, "processes": chosen.processes}))


def run_server(server: Coroutine[Any, Any, None]) -> None:
    """Run the coroutine of a server until it ends. Raises `CommandFailed` with the reason if it cannot start."""
    with loading_modules():
        from marey_schemas.tracing.export import TracesUnusable
        from marey_server.http.accepting import CannotListen
        from marey_server.launchers.launcher import LauncherUnusable
        from marey_server.process.computing import leave
        from marey_server.shared_port.parent import ProcessesFailed
        from marey_server.store.database.opening import DatabaseUnusable

    try:
        with asyncio.Runner(loop_factory=_new_event_loop) as runner:
            runner.run(server)
    except (DatabaseUnusable, ProcessesFailed) as error:
        raise CommandFailed(str(error)) from error
    except CannotListen as error:
        raise CommandFailed(
            f"{error}; choose another address with --host, or another port with --port (0: any free port)"
        ) from error
    except (LauncherUnusable, TracesUnusable) as error:
        raise CommandFailed(f"invalid setting: {error}") from error
    leave()


def _new_event_loop() -> asyncio.AbstractEventLoop:
    """Return a new event loop of uvloop; if uvloop is not installed, as on Windows, return one of asyncio."""
    try:
        uvloop = import_module("uvloop")
    except ModuleNotFoundError:
        return asyncio.new_event_loop()
    loop: asyncio.AbstractEventLoop = uvloop.new_event_loop()
    return loop


def read_settings(**given: Any) -> Settings:
    """Return the settings from flags, environment variables and `marey.toml`.

    Raises `CommandFailed`, with an explanation in one line, if a setting is not valid.
    """
    try:
        return Settings(**given)
    except ValidationError as error:
        raise CommandFailed(f"invalid setting: {explain_faults(error, given)}") from None
    except SettingsError as error:  # of a variable for a list or an object
        raise CommandFailed(f"invalid setting: {explain_variable(error)}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CommandFailed(f"{SETTINGS_FILE} cannot be read as TOML: {error}") from None
    except OSError as error:
        raise CommandFailed(f"{error.filename or SETTINGS_FILE} cannot be read: {error.strerror}") from None


def upgrade(*, while_serving: bool = False, finish: bool = False, **settings: Any) -> None:
    """Upgrade the tables to the schema of this version; with `finish`, also remove what only earlier versions used.

    Raises `CommandFailed` if the upgrade fails; with `while_serving`, also if running servers of the earlier version
    could not use the upgraded tables.
    """
    from marey_server.process.data_folder import prepare_data_folder
    from marey_server.store.database.opening import sqlite_file
    from marey_server.store.database.schema import upgrade_schema

    chosen = read_settings(**settings)
    with _database_of(chosen) as url:
        prepare_data_folder(chosen)
        done = upgrade_schema(url, while_serving=while_serving, finish=finish)
    if not done.known:
        _say("a newer version of Marey has added to the tables; this version can serve them")
        return
    if done.created:
        _say(f"there were no tables; they were created in {sqlite_file(url) or 'the Postgres database'}")
        return
    _say("the database's schema is up to date")
    if done.applied and done.additive:
        _say("servers of the earlier version can go on, because the upgrade has only added to the tables")
    elif done.applied:
        _say("servers of earlier versions can no longer use this database; do not start them")
    if done.waiting:
        _say("when all servers have this version, run `marey db upgrade --finish`")


def require_empty(**settings: Any) -> None:
    """Raise `CommandFailed` if the database has tables; nothing is changed."""
    from marey_server.access.principal import SYSTEM
    from marey_server.app import connect_database
    from marey_server.store.database.schema import list_tables

    chosen = read_settings(**settings)
    with _database_of(chosen), closing(connect_database(chosen)) as database:
        tables = database.read(SYSTEM, lambda tx: list_tables(tx.connection))
    if tables:
        raise CommandFailed(
            f"the database is not empty ({counted(len(tables), 'table')}, such as {tables[0]}); create another one for "
            "the test, for example with `createdb`"
        )


def backup(*, target: Path, **settings: Any) -> None:
    """Copy an SQLite database to the file `target`, in a consistent state even while a server is writing to it.

    Raises `CommandFailed` if the file exists already, or if its folder does not exist.
    """
    source = _sqlite_file(read_settings(**settings), must_exist=True)
    if target.exists():
        raise CommandFailed(f"the file {target} exists already; choose a file that does not exist")
    if not target.parent.is_dir():
        raise CommandFailed(f"{target}: there is no folder {target.parent}; create it, or name another file")
    partial = target.with_name(f"{target.name}.partial")
    partial.unlink(missing_ok=True)
    _copy_database(source, partial)
    partial.replace(target)
    _say(f"{target}: {target.stat().st_size:,} bytes")


def restore(*, source: Path, **settings: Any) -> None:
    """Restore a database from a backup. Raises `CommandFailed` if the database in the settings exists already."""
    chosen = read_settings(**settings)
    target = _sqlite_file(chosen, must_exist=False)
    # A log that stays behind would be played into the backup.
    for left in (target, target.with_name(f"{target.name}-wal"), target.with_name(f"{target.name}-shm")):
        if left.exists():
            raise CommandFailed(
                f"the file {left} exists already and would be replaced; stop the server and move the file away first"
            )
    if not source.is_file():
        raise CommandFailed(f"there is no file {source}; name a file that `marey db backup` wrote")
    chosen.data.mkdir(parents=True, exist_ok=True, mode=0o700)
    partial = target.with_name(f"{target.name}.partial")
    partial.unlink(missing_ok=True)
    _copy_database(source, partial)
    partial.replace(target)
    _say(f"{target} is restored from {source}; `marey db fsck` verifies it")


def fsck(*, repair: bool = False, as_json: bool = False, **settings: Any) -> None:
    """Verify every digest, reference and counter; with `repair`, correct the counters.

    Raises `CommandFailed` if there are faults.
    """
    from marey_server.app import connect_database
    from marey_server.store.fsck import check_store

    chosen = read_settings(**settings)
    if chosen.database_url is None:
        _sqlite_file(chosen, must_exist=True)
    checked: dict[str, int] = {}
    with _database_of(chosen), closing(connect_database(chosen)) as database:
        findings = list(check_store(database, progress=checked.__setitem__, repair=repair))
    if as_json:
        import json

        _say(json.dumps({"checked": checked, "findings": [vars(finding) for finding in findings]}, default=str))
    else:
        for finding in findings:
            _say(str(finding))
        amounts = ", ".join(counted(count, what.removesuffix("s")) for what, count in checked.items())
        _say(f"checked {amounts or 'nothing'}")
    if findings:
        raise CommandFailed(f"the database has faults ({len(findings)}), which are listed above")


def examine(**settings: Any) -> list[tuple[str, str, str]]:
    """Check this machine; return for each check its name, its state (ok, warning or fault) and a detail."""
    from marey_server.app import connect_database
    from marey_server.process.doctor import examine as examine_machine

    try:
        chosen = read_settings(**settings)
    except CommandFailed as error:
        return [("settings", "fault", str(error))]
    findings = examine_machine(chosen, os.environ, connect_database, settings.get("database_url"))
    return [(one.check, one.state, one.detail) for one in findings]


def clock(*, set_now: bool = False, **settings: Any) -> None:
    """Print the clock stored in an SQLite database and the clock of this machine.

    With `set_now`, set the stored clock to the time of this machine.
    """
    from marey_server.store.clock_setting import read_clock, set_clock
    from marey_server.store.database.opening import alone

    chosen = read_settings(**settings)
    with _database_of(chosen), alone(_sqlite_file(chosen, must_exist=True)) as connection:
        state = read_clock(connection)
        moved = set_clock(connection) if set_now else None
    _say(str(state))
    if moved is not None:
        _say(f"the clock of the database now has the time of this machine; {moved:,} later times were set back")


def purge(**settings: Any) -> None:
    """Delete data that is older than the settings allow or that nothing refers to; then shrink the SQLite file."""
    from marey_server.app import connect_database
    from marey_server.store.garbage import collect_garbage
    from marey_server.store.retention import retire

    chosen = read_settings(**settings)
    if chosen.database_url is None:
        _sqlite_file(chosen, must_exist=True)
    with _database_of(chosen), closing(connect_database(chosen)) as database:
        for done in (retire(database, chosen.retention), collect_garbage(database)):
            for name, count in asdict(done).items():
                _say(f"deleted {count:,} {name.replace('_', ' ')}")
        on_sqlite = database.is_sqlite
    if on_sqlite:
        _shrink(_sqlite_file(chosen, must_exist=True))


def move_blobs(**settings: Any) -> None:
    """Move all blobs to the storage that the setting `blobs` names, while servers run.

    If the command is stopped, the next run moves the other blobs. Raises `CommandFailed` if blobs cannot be moved.
    """
    from marey_server.app import connect_database
    from marey_server.errors import ApiProblem
    from marey_server.store.object_upkeep.moving import CannotMove, Moved, move_blobs

    chosen = read_settings(**settings)
    if chosen.database_url is None:
        _sqlite_file(chosen, must_exist=True)
    moved = Moved()
    with _database_of(chosen), closing(connect_database(chosen)) as database:
        try:
            move_blobs(database, moved, progress=_progress())
        except KeyboardInterrupt:
            raise CommandFailed(
                f"stopped; {moved} were moved before; run the command again to move the other blobs"
            ) from None
        except (CannotMove, ApiProblem) as error:
            raise CommandFailed(f"{error} Before this, the command moved {moved}.") from None
    _say(f"moved {moved}")
    for digest in moved.damaged:
        _say(f"not moved: {digest}, because its bytes are damaged")
    if moved.damaged:
        raise CommandFailed(f"damaged blobs were not moved ({len(moved.damaged)}); `marey db fsck` lists all faults")


def _progress() -> Callable[[object], None]:
    """Return a function that prints its argument to standard error, at most once per `PROGRESS_EVERY_S` seconds."""
    printed_s = time.monotonic()

    def show(state: object) -> None:
        nonlocal printed_s
        if time.monotonic() >= printed_s + PROGRESS_EVERY_S:
            printed_s = time.monotonic()
            sys.stderr.write(f"moved {state}\n")

    return show


def _shrink(file: Path) -> None:
    """Shrink the file of an SQLite database by its free pages. Raises `CommandFailed` if a server is running."""
    from marey_server.store.database.opening import DatabaseUnusable, vacuum

    before = file.stat().st_size
    try:
        vacuum(file)
    except DatabaseUnusable as error:
        raise CommandFailed(f"the file of the database could not be shrunk: {error}") from None
    _say(f"the database takes {file.stat().st_size:,} bytes; it took {before:,}")


def admin_token(*, user: str | None = None, **settings: Any) -> None:
    """Create a token for an administrator, and write it to `admin.token` in the data folder.

    `user` is the name of the administrator; None: the one who was created first. Raises `CommandFailed` if there is no
    such administrator.
    """
    from marey_server.access.principal import SYSTEM
    from marey_server.app import connect_database
    from marey_server.errors import NotFoundProblem
    from marey_server.process.administrators import give_token

    chosen = read_settings(**settings)
    if chosen.database_url is None:
        _sqlite_file(chosen, must_exist=True)
    chosen.data.mkdir(parents=True, exist_ok=True, mode=0o700)
    file = chosen.data / ADMIN_TOKEN_FILE
    with _database_of(chosen), closing(connect_database(chosen)) as database:
        try:
            database.write(SYSTEM, partial(give_token, name="made where the server is"), user, file)
        except NotFoundProblem:
            reason = f"there is no enabled administrator named {user!r}; name another one with --user"
            raise CommandFailed(reason) from None
    _say(f"{file} contains a new token; earlier tokens remain valid: see `marey token ls` and `marey token revoke`")


@contextmanager
def _database_of(settings: Settings) -> Iterator[str]:
    """Yield the URL of the database; convert `DatabaseUnusable`, raised in the `with` block, to `CommandFailed`."""
    from marey_server.store.database.opening import DatabaseUnusable, opening

    try:
        with opening(settings.resolved_database_url):
            yield settings.resolved_database_url
    except DatabaseUnusable as error:
        raise CommandFailed(str(error)) from error


def _sqlite_file(settings: Settings, *, must_exist: bool) -> Path:
    from marey_server.store.database.opening import sqlite_file

    file = sqlite_file(settings.resolved_database_url)
    if file is None:
        raise CommandFailed("this command works only with SQLite; for Postgres, use pg_dump and pg_restore")
    if must_exist and not file.is_file():
        raise CommandFailed(f"there is no database {file}; name its folder with --data")
    return file


def _copy_database(source: Path, target: Path) -> None:
    os.close(os.open(target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    try:
        with (
            closing(sqlite3.connect(f"{source.absolute().as_uri()}?mode=ro", uri=True)) as reading,
            closing(sqlite3.connect(target)) as writing,
        ):
            reading.backup(writing)
            (state,) = writing.execute("PRAGMA quick_check").fetchone()
    except sqlite3.DatabaseError as error:
        target.unlink()
        raise CommandFailed(f"cannot copy {source} as an SQLite database to {target}: {error}") from None
    if state != "ok":
        target.unlink()
        raise CommandFailed(f"the database {source} is damaged: {state}")
    with open(target, "rb") as file:
        os.fsync(file.fileno())


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
