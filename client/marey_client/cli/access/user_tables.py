"""Command `user import`: users and memberships from a CSV file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
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
    """Row of the table: a user, and the project that the user joins, if any. Empty cells are None."""

    line: int
    name: str
    display_name: str | None
    administrator: bool | None
    project: str | None
    role: Role | None

    @property
    def statements(self) -> list[tuple[str, object]]:
        """Names and values that all rows of the user must agree on; the value of an empty cell is None."""
        joined = [(f"role in {self.project}", str(self.role))] if self.project else []
        return [("display_name", self.display_name), ("administrator", self.administrator), *joined]


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
    change_roles: Annotated[
        bool, typer.Option("--change-roles", help="Also give existing members the roles in the file.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Create the users in a CSV file, and add them to projects.

    New users have no password: they sign in with an identity provider, or after `marey user password NAME`. Existing
    users are not changed, but join the projects. If a row is wrong, contradicts another row, or would change the role
    of a member, nothing is created; with `--change-roles`, such roles are changed. Each user and each membership is
    stored by a request of its own. If the server refuses a request, everything stored before remains, and repeating
    the command continues.
    """
    rows = _read(table)
    with connect(context) as marey:
        known = {one.name for one in marey.users.list()}
        joining = _joining(marey, rows, table, change_roles=change_roles)  # errors come before anybody is created
        created = [one for one in _users(rows) if one.name not in known]
        if not dry_run:
            for one in created:
                marey.users.create(one)
            for row, project, role in joining:
                with _in_row(table, row):
                    marey.project(project).members.put(row.name, role)
    if as_json:
        joined = [(row.name, project, role) for row, project, role in joining]
        return print_json({"created": [one.name for one in created], "joined": joined, "dry_run": dry_run})
    done = "would be created" if dry_run else "created"
    existing = len({row.name for row in rows}) - len(created)
    print_message(f"{counted(len(created), 'user')} {done}, {existing} existed; {counted(len(joining), 'membership')}")
    return None


@contextmanager
def _in_row(table: Path, row: _Row) -> Iterator[None]:
    """Add the number of the row to errors that the server reports in the `with` block."""
    from marey_client.errors import RequestFailed

    try:
        yield
    except RequestFailed as error:
        error.add_note(f"{table}, row {row.line}; the rows before it are stored")
        raise


def _users(rows: Sequence[_Row]) -> list[UserCreate]:
    """Return the users of a table; the values of a user are collected from all rows of the user."""
    from marey_schemas.access import UserCreate

    by_name: dict[str, list[_Row]] = {}
    for row in rows:
        by_name.setdefault(row.name, []).append(row)
    return [
        UserCreate(
            name=name,
            display_name=next((row.display_name for row in own if row.display_name), None),
            administrator=any(row.administrator for row in own),
        )
        for name, own in by_name.items()
    ]


def _joining(marey: Marey, rows: Sequence[_Row], table: Path, *, change_roles: bool) -> list[tuple[_Row, str, Role]]:
    """Return the memberships to store: those that do not exist yet, and with `change_roles` those with another role.

    Raises `WrongUsage`, which names all members whose roles would change, and `NotFound` for a missing project.
    """
    wanted = {(row.project, row.name): row for row in rows if row.project}
    roles = {
        (project, one.user): one.role
        for project in sorted({row.project for row in rows if row.project})
        for one in marey.project(project).members.list()
    }
    joining = [
        (row, row.project, row.role)
        for place, row in wanted.items()
        if row.project and row.role and roles.get(place) != row.role
    ]
    changed = [
        f"{table}, row {row.line}: the role of {row.name} in {project} is {roles[project, row.name]}, and would become "
        f"{role}"
        for row, project, role in joining
        if (project, row.name) in roles
    ]
    if changed and not change_roles:
        raise WrongUsage("\n".join([*changed, "nobody was created; `--change-roles` changes the roles of members"]))
    return joining


def _read(table: Path) -> list[_Row]:
    """Return the rows of the file. Raises `WrongUsage`, which names all wrong rows."""
    rows = rows_of(table)
    names = [name for name in next(iter(rows.values())) if name]
    if "name" not in names or (unknown := [name for name in names if name not in COLUMNS]):
        odd = "has no column `name`" if "name" not in names else f"has an unknown column {unknown[0]!r}"
        raise WrongUsage(f"{table} {odd}; the columns are {', '.join(COLUMNS)}")
    found, wrong = [], []
    for number, row in rows.items():
        try:
            found.append(_row(number, {name: (text or "").strip() for name, text in row.items()}))
        except WrongUsage as error:
            wrong.append(f"{table}, row {number}: {error}")
    wrong += [f"{table}, {error}" for error in _contradictions(found)]
    if wrong:
        raise WrongUsage("\n".join([*wrong, "nobody was created"]))
    return found


def _contradictions(rows: Sequence[_Row]) -> Iterator[str]:
    """Yield a message for each value on which two rows of the same user disagree."""
    first: dict[tuple[str, str], tuple[int, object]] = {}
    for row in rows:
        for what, value in row.statements:
            if value is not None:
                line, before = first.setdefault((row.name, what), (row.line, value))
                if before != value:
                    yield f"rows {line} and {row.line}: they disagree on the {what} of {row.name}"


def _row(line: int, row: Mapping[str, str]) -> _Row:
    from marey_client.arguments import checked
    from marey_client.errors import BadArgument
    from marey_schemas.access import Role, UserCreate

    administrator = row.get("administrator", "").lower()
    if administrator not in (*YES, *NO):
        raise WrongUsage(f"administrator: {administrator!r} must be yes or no")
    project, role = row.get("project") or None, row.get("role") or None
    if (project is None) != (role is None):
        raise WrongUsage("give both a project and a role, or neither")
    if role is not None and role not in list(Role):
        raise WrongUsage(f"role: {role!r} must be {one_of([str(one) for one in Role])}")
    try:
        user = checked(UserCreate, name=row["name"], display_name=row.get("display_name") or None)
    except BadArgument as error:
        raise WrongUsage(str(error)) from None
    stated = administrator in YES if administrator else None
    return _Row(line, user.name, user.display_name, stated, project, None if role is None else Role(role))
