"""Opening of a database, with errors that are written for the person who starts the server."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from alembic.util import CommandError
from sqlalchemy import URL, Connection, NullPool, create_engine, exc, make_url

from marey_server.errors import StorageFullProblem, UnavailableProblem
from marey_server.store.database.clock import ClockFarAhead

_ERROR_NUMBER = re.compile(r"\[Errno -?\d+\] ")


class DatabaseUnusable(Exception):
    """Error of a database that cannot be opened; its text gives the reason and what to do, and contains no password."""


@contextmanager
def opening(url: str) -> Iterator[None]:
    """Convert errors in the `with` block, which opens the database at `url`, to `DatabaseUnusable`."""
    try:
        yield
    except (exc.ArgumentError, ImportError) as error:  # of a url no driver is known for
        if isinstance(error, ModuleNotFoundError) and url.startswith("postgresql"):
            raise DatabaseUnusable(
                f"a Postgres database needs the package {error.name}, which is not installed; run: "
                "pip install 'marey[postgres]'"
            ) from None
        raise DatabaseUnusable(
            "the setting `database_url` is not the URL of a supported database; write "
            "sqlite:////folder/file.db, or postgresql://user@host/name"
        ) from None
    except UnavailableProblem as error:
        if (file := sqlite_file(url)) is not None:
            raise DatabaseUnusable(
                f"the database {file} cannot be used: {_reason(error.__cause__)}; check that its folder exists, that "
                "you may write there, that the disk works and has free space, and that no other program has locked "
                "the file"
            ) from error
        raise DatabaseUnusable(
            f"the server of the database {_shown(url)} does not answer: {_reason(error.__cause__)}; start the server "
            "of the database, or correct the setting `database_url`"
        ) from error
    except StorageFullProblem as error:
        raise DatabaseUnusable(f"the database {_shown(url)} cannot be opened for writing: {error.detail}") from error
    except exc.DBAPIError as error:
        raise DatabaseUnusable(f"the database {_shown(url)} cannot be used: {_reason(error)}") from error
    except ClockFarAhead as error:
        raise DatabaseUnusable(str(error)) from None
    except CommandError as error:
        raise DatabaseUnusable(
            f"the tables of the database {_shown(url)} belong to another, perhaps newer, version of Marey "
            f"({error}); update Marey, or use another database"
        ) from error


def sqlite_file(url: str | URL) -> Path | None:
    """Return the file of an SQLite database, or None for other databases, such as SQLite in memory."""
    parsed = make_url(url)
    if (
        parsed.get_backend_name() != "sqlite"
        or not parsed.database
        or parsed.database.startswith((":memory:", "file:"))
    ):
        return None
    return Path(parsed.database)


@contextmanager
def alone(file: Path) -> Iterator[Connection]:
    """Open an SQLite file exclusively, and run the `with` block in one transaction.

    Raises `DatabaseUnusable` if another process has the file open.
    """
    engine = create_engine(f"sqlite:///{file}", poolclass=NullPool, connect_args={"timeout": 1.0})
    with engine.connect() as connection:
        try:
            connection.exec_driver_sql("PRAGMA locking_mode = EXCLUSIVE")  # also excludes those that only have it open
            connection.exec_driver_sql("BEGIN EXCLUSIVE")
        except exc.OperationalError as error:
            reason = f"{file} is in use or cannot be read ({_reason(error)}); stop the server first"
            raise DatabaseUnusable(reason) from None
        yield connection
        connection.commit()


def vacuum(file: Path) -> None:
    """Rewrite an SQLite file without its free pages.

    Raises the errors of `alone`, and `DatabaseUnusable` if SQLite fails, for example because the disk has no space for
    its temporary copy.
    """
    with alone(file) as connection:
        connection.commit()  # a vacuum runs outside of transactions; the lock stays
        try:
            connection.exec_driver_sql("VACUUM")
        except exc.OperationalError as error:
            reason = (
                f"{file} cannot be copied ({_reason(error)}); the copy needs as much free space as the database takes"
            )
            raise DatabaseUnusable(reason) from None


def _shown(url: str) -> str:
    return make_url(url).render_as_string(hide_password=True)


def _reason(error: BaseException | None) -> str:
    """Return the first line of the message of the driver's error, or of `error` if there is no driver's error.

    Numbers of the system's errors, as in `[Errno -2]`, are left out.
    """
    text = _ERROR_NUMBER.sub("", str(getattr(error, "orig", None) or error)).strip()
    return text.splitlines()[0] if text else "no reason is given"
