"""Command `user import`: users and memberships from a CSV file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.access.accounts import user
from marey_client.cli.files.csv_files import rows_of
from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.invocation import AsJson, connect
from marey_client.cli.terminal.output import print_json, print_message
from marey_schemas.wording import counted, one_of

if TYPE_CHECKING:
    from marey_client.marey import Marey
    from marey_schemas.access import Role, UserCreate

COLUMNS = ("name", "display_name", "administrator", "project", "role")
YES, NO = ("yes", "true", "1"), ("", "no", "false", "0")


def add_to(_app: typer.Typer) -> None:
    """Register the command of this module in the group `user`."""
    user.command("import")(import_users)


@dataclass(frozen=True)
class _Row:
    """A user to create, and the project that the user joins, if any."""

    line: int
    user: UserCreate
    project: str | None
    role: Role | None


def import_users(
    context: typer.Context,
    table: Annotated[
        Path,
        typer.Argument(
            help="CSV file with one row for each user, or for each user and project: a column `name`, and optional "
            f"columns {', '.join(COLUMNS[1:])}."
        ),
    ],
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check the file, and create nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """Create the users in a CSV file, and add them to projects.

    The users have no password: they sign in with an identity provider, or after `marey user password NAME`. Users that
    exist are left as they are, but join the projects. If a row is wrong, nothing is created. Repeating the command
    continues where it was interrupted.
    """
    rows = _read(table)
    with connect(context) as marey:
        known = {one.name for one in marey.users.list()}
        for project in sorted({row.project for row in rows if row.project}):
            marey.project(project).read()  # a missing project is an error before anybody is created
        created = list(dict.fromkeys(row.user.name for row in rows if row.user.name not in known))
        joined = [(row.user.name, row.project, row.role) for row in rows if row.project and row.role]
        if not dry_run:
            _store(marey, rows, set(created))
    if as_json:
        return print_json({"created": created, "joined": joined, "dry_run": dry_run})
    done = "would be created" if dry_run else "created"
    existing = len({row.user.name for row in rows}) - len(created)
    print_message(f"{counted(len(created), 'user')} {done}, {existing} existed; {counted(len(joined), 'membership')}")
    return None


def _store(marey: Marey, rows: Sequence[_Row], new: set[str]) -> None:
    for row in rows:
        if row.user.name in new:
            marey.users.create(row.user)
            new.remove(row.user.name)
        if row.project and row.role:
            marey.project(row.project).members.put(row.user.name, row.role)


def _read(table: Path) -> list[_Row]:
    """Return the rows of the file. Raises `WrongUsage`, which names all wrong lines."""
    rows = rows_of(table)
    names = [name for name in rows[0] if name]
    if "name" not in names or (unknown := [name for name in names if name not in COLUMNS]):
        odd = "has no column `name`" if "name" not in names else f"has an unknown column {unknown[0]!r}"
        raise WrongUsage(f"{table} {odd}; the columns are {', '.join(COLUMNS)}")
    found, wrong = [], []
    for number, row in enumerate(rows, 2):
        try:
            found.append(_row(number, {name: (text or "").strip() for name, text in row.items()}))
        except WrongUsage as error:
            wrong.append(f"{table}, row {number}: {error}")
    if wrong:
        raise WrongUsage("\n".join([*wrong, "nobody was created"]))
    return found


def _row(line: int, row: Mapping[str, str]) -> _Row:
    from marey_client.arguments import checked
    from marey_client.errors import BadArgument
    from marey_schemas.access import Role, UserCreate

    administrator = row.get("administrator", "").lower()
    if administrator not in (*YES, *NO):
        raise WrongUsage(f"administrator: {administrator!r} is neither yes nor no")
    project, role = row.get("project") or None, row.get("role") or None
    if (project is None) != (role is None):
        raise WrongUsage("give both a project and a role, or neither")
    if role is not None and role not in list(Role):
        raise WrongUsage(f"role: {role!r} must be {one_of([str(one) for one in Role])}")
    try:
        wanted = checked(
            UserCreate, name=row["name"], display_name=row.get("display_name") or None,
            administrator=administrator in YES,
        )  # fmt: skip
    except BadArgument as error:
        raise WrongUsage(str(error)) from None
    return _Row(line, wanted, project, None if role is None else Role(role))
