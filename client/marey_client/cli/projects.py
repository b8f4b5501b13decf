"""Commands of the groups `project` and `member`: projects, quotas, members and roles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.addresses import advice
from marey_client.cli.terminal.failures import ANONYMOUS_HINT, WrongUsage
from marey_client.cli.terminal.invocation import AsJson, ProjectName, connect
from marey_client.cli.terminal.output import print_json, print_message, print_pairs, print_table

if TYPE_CHECKING:
    from marey_client.project import ProjectHandle
    from marey_schemas.access import QuotasInUse
    from marey_schemas.items import Collection

project = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Manage projects.")
member = typer.Typer(no_args_is_help=True, rich_markup_mode=None, help="Manage the members of a project.")

MemberName = Annotated[
    str, typer.Argument(help="Name of the user; with `--folder`, '*' stands for all members except owners.")
]
ItemLimit = Annotated[
    int | None, typer.Option("--items", min=0, help="Set the maximum number of items. Default: unchanged.")
]
ByteLimit = Annotated[
    int | None,
    typer.Option(
        "--stored-bytes", min=0, help="Set the maximum total size of all revisions, in bytes. Default: unchanged."
    ),
]
DefaultLimits = Annotated[
    bool,
    typer.Option(
        "--defaults",
        help="Remove the limits set for this project or user: the limits in the server's settings apply, and "
        "the number of running jobs has no limit. Other options of the same command still set their limits.",
    ),
]


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module to the application `app`."""
    app.add_typer(project, name="project")
    app.add_typer(member, name="member")


@project.command("create")
def create_project(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Name of the project: lower-case letters, digits, - and _.")],
    title: Annotated[str | None, typer.Option(help="Title of the project, shown beside its name.")] = None,
    description: Annotated[str, typer.Option(help="Purpose of the project.")] = "",
    public: Annotated[
        bool, typer.Option("--public", help="Make the project public: everybody who can reach the server may read it.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Create a project; you become its owner."""
    from marey_schemas.access import ProjectCreate, Visibility

    visibility = Visibility.PUBLIC if public else Visibility.PRIVATE
    wanted = ProjectCreate(name=name, title=title, description=description, visibility=visibility)
    with connect(context) as marey:
        made = marey.create_project(wanted).read()
    if as_json:
        return print_json(made)
    return print_message(f"project {made.name} is created")


@project.command("ls")
def list_projects(context: typer.Context, as_json: AsJson = False) -> None:
    """Show every project that you may read."""
    with connect(context) as marey:
        projects = list(marey.projects())
        if not projects and marey.transport.anonymous:
            print_message(ANONYMOUS_HINT)
    if as_json:
        return print_json(projects)
    rows = [(one.name, one.title, one.visibility, one.role, one.updated_at.date()) for one in projects]
    return print_table(("name", "title", "visibility", "your role", "changed"), rows)


@project.command("show")
def show_project(context: typer.Context, name: ProjectName, as_json: AsJson = False) -> None:
    """Show a project: its title, purpose and visibility, and your role in it."""
    with connect(context) as marey:
        found = marey.project(name).read()
    if as_json:
        return print_json(found)
    return print_pairs(found.model_dump(mode="json", exclude={"rev"}).items())


@project.command("change")
def change_project(
    context: typer.Context,
    name: ProjectName,
    title: Annotated[str | None, typer.Option(help="New title of the project. Default: unchanged.")] = None,
    description: Annotated[str | None, typer.Option(help="New purpose of the project. Default: unchanged.")] = None,
    visibility: Annotated[
        str | None,
        typer.Option(
            help="New visibility. private: only members may read the project; public: everybody who can reach "
            "the server may. Default: unchanged."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Change the title, the description and the visibility of a project."""
    from marey_schemas.access import ProjectChange

    given = {"title": title, "description": description, "visibility": visibility}
    change = ProjectChange.model_validate({key: value for key, value in given.items() if value is not None})
    with connect(context) as marey:
        changed = marey.project(name).change(change)
    if as_json:
        return print_json(changed)
    return print_message(f"project {changed.name} is changed")


@project.command("quota")
def project_quota(
    context: typer.Context,
    name: ProjectName,
    items: ItemLimit = None,
    stored_bytes: ByteLimit = None,
    running_jobs: Annotated[
        int | None,
        typer.Option(
            "--running-jobs", min=0, help="Set the maximum number of jobs that run at once. Default: unchanged."
        ),
    ] = None,
    defaults: DefaultLimits = False,
    as_json: AsJson = False,
) -> None:
    """Show the quotas of a project: items, bytes and running jobs, and the limits. Administrators can change limits."""
    from marey_schemas.access import ProjectQuotaChange

    wanted = changed_limits(defaults, items=items, stored_bytes=stored_bytes, running_jobs=running_jobs)
    with connect(context) as marey:
        handle = marey.project(name)
        found = handle.change_quotas(ProjectQuotaChange.model_validate(wanted)) if wanted else handle.quotas()
    if as_json:
        return print_json(found)
    return print_quotas(found)


def changed_limits(defaults: bool, **given: int | None) -> dict[str, int | None]:
    """Return the limits that options change, by name; None means the limit in the server's settings, or no limit."""
    return {name: limit for name, limit in given.items() if defaults or limit is not None}


def print_quotas(quotas: QuotasInUse) -> None:
    """Print a table of the quotas with their use and limits."""
    known = quotas.model_dump(exclude_none=True).items()
    rows = [(name.replace("_", " "), quota["used"], quota.get("allowed")) for name, quota in known]
    columns = ("quota", "used", "allowed")
    print_table(columns, [(name, f"{used:,}", _limit_text(allowed)) for name, used, allowed in rows], right=columns[1:])


def _limit_text(allowed: int | None) -> str:
    return "no limit" if allowed is None else f"{allowed:,}"


@project.command("delete")
def delete_project(context: typer.Context, name: ProjectName) -> None:
    """Delete a project; `marey project restore` restores it."""
    with connect(context) as marey:
        marey.project(name).delete()
    print_message(f"project {name} is deleted; to undo this, run marey project restore {name}")


@project.command("restore")
def restore_project(context: typer.Context, name: ProjectName) -> None:
    """Restore the project of this name that was deleted last."""
    with connect(context) as marey:
        marey.project(name).restore()
    print_message(f"project {name} is restored")


@member.command("ls")
def list_members(
    context: typer.Context,
    project_name: ProjectName,
    folder: Annotated[
        str | None,
        typer.Option(
            help="Show the roles in this folder and the folders below it, instead of roles in the project. / shows "
            "the roles in all folders."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show the members of a project and their roles, or their roles in folders."""
    with connect(context) as marey:
        found = marey.project(project_name).members
        if folder is not None:
            roles = list(found.in_folders.list(folder.strip("/")))
            if as_json:
                return print_json(roles)
            rows = [(one.folder, one.user, one.role, one.since.date()) for one in roles]
            return print_table(("folder", "user", "role", "since"), rows)
        members = list(found.list())
    if as_json:
        return print_json(members)
    return print_table(("user", "role", "since"), [(one.user, one.role, one.since.date()) for one in members])


@member.command("put")
def put_member(
    context: typer.Context,
    project_name: ProjectName,
    user: MemberName,
    role: Annotated[str, typer.Argument(help="Role: reader, contributor, maintainer or owner.")],
    folder: Annotated[
        str | None,
        typer.Option(
            help="Give the role only in this folder and everything below it. The role may be reader, contributor or "
            "maintainer, and higher or lower than the role in the project."
        ),
    ] = None,
) -> None:
    """Give a user a role in a project, or give a member another role in a folder."""
    from marey_schemas.access import FolderRoleChange, MemberChange

    wanted = (MemberChange if folder is None else FolderRoleChange).model_validate({"role": role}).role
    with connect(context) as marey:
        project_handle = marey.project(project_name)
        if folder is None:
            project_handle.members.put(user, wanted)
        else:
            project_handle.members.in_folders.put(_folder(project_handle, folder), user, wanted)
    print_message(f"{_named(user)} {wanted} {_place(project_name, folder)}")


@member.command("remove")
def remove_member(
    context: typer.Context,
    project_name: ProjectName,
    user: MemberName,
    folder: Annotated[
        str | None, typer.Option(help="Remove only the role in this folder; the member stays in the project.")
    ] = None,
) -> None:
    """Remove a user from a project, or remove the role of a member in a folder."""
    with connect(context) as marey:
        project_handle = marey.project(project_name)
        if folder is None:
            project_handle.members.remove(user)
        else:
            project_handle.members.in_folders.remove(_folder(project_handle, folder), user)
    if folder is None:
        return print_message(f"{user} is no longer a member of {project_name}")
    return print_message(f"the role in {project_name}/{folder.strip('/')} is removed")


def _folder(project_handle: ProjectHandle, path: str) -> Collection:
    """Return a folder of a project. Raises `WrongUsage` if there is none with this path."""
    found = project_handle.collections.at(path.strip("/")) if path.strip("/") else None
    if found is None:
        raise WrongUsage(
            f"there is no folder {path!r} in {project_handle.name}; {advice(project_handle, path.strip('/'), ())}"
        )
    return found


def _named(user: str) -> str:
    return "all members are" if user == "*" else f"{user} is"


def _place(project_name: str, folder: str | None) -> str:
    return f"of {project_name}" if folder is None else f"in {project_name}/{folder.strip('/')}"
