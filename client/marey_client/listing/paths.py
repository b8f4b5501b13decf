"""Paths that do not exist: errors that name the nearest folder or item."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import islice

from marey_client.errors import NoSuchPath
from marey_client.paging import pages
from marey_client.transport import Transport
from marey_schemas.items import Collection, Item
from marey_schemas.kinds import Kind
from marey_schemas.wording import listed, nearest

MOST_COMPARED = 10_000
"""Greatest number of names in a folder with which a misspelt name is compared."""


def require_folder(transport: Transport, project: str, folder: str) -> None:
    """Raise `NoSuchPath`, which names the nearest folder, if a project has no folder with this path."""
    if not is_folder(transport, project, folder):
        raise NoSuchPath(_missing_folder(transport, project, folder))


def is_folder(transport: Transport, project: str, folder: str) -> bool:
    """Return whether a project has a folder with this path."""
    found = pages(transport, Collection, f"/projects/{project}/collections", {"path": folder, "limit": 1})
    return any(one.path == folder for one in found)


def missing_path(transport: Transport, project: str, kind: Kind, path: str) -> str:
    """Return a message about a path at which a project has no item of a kind, with the nearest path that it has."""
    path = path.strip("/")
    folder, _, name = path.rpartition("/")
    if is_folder(transport, project, path):
        return f"{path!r} is a folder of {project}; {kind.plural}.where({path!r}) selects the {kind.plural} in it"
    if folder and not is_folder(transport, project, folder):
        return _missing_folder(transport, project, folder)
    known = _names_in(transport, project, kind, folder)
    if not folder:
        known += sorted(_folders(transport, project))
    near = nearest(name, known)
    if near:
        hint = f"did you mean {f'{folder}/{near}'.lstrip('/')!r}?"
    elif known:
        hint = f"it has {listed(known)}"
    else:
        hint = f"no {kind.plural} are directly in it"
    return f"there is no {kind} {name!r} in {folder or project}; {hint}"


def nearest_path(transport: Transport, project: str, path: str, kinds: Iterable[Kind]) -> str | None:
    """Return the path of the folder, or of the item of these kinds, that is spelled most like `path`.

    If the folder in `path` does not exist, the folder that is spelled most like it is searched instead. If nothing in
    the folder is spelled like the last name in `path`, the path of the folder is returned. Returns
    None if this folder is the top folder of the project, or if no folder is spelled like the one in `path`.
    """
    folders = _folders(transport, project)
    folder, _, name = path.strip("/").rpartition("/")
    found = folder if folder in ("", *folders) else nearest(folder, folders)
    if found is None:
        return None
    names = [one.rpartition("/")[2] for one in folders if one.rpartition("/")[0] == found]
    for kind in kinds:
        names += _names_in(transport, project, kind, found)
    near = nearest(name, names)
    return "/".join(filter(None, (found, near))) or None


def _missing_folder(transport: Transport, project: str, folder: str) -> str:
    known = _folders(transport, project)
    near = nearest(folder, known)
    hint = f"did you mean {near!r}?" if near else f"the folders are {', '.join(known[:5]) or 'none yet'}"
    return f"there is no folder {folder!r} in {project}; {hint}"


def _names_in(transport: Transport, project: str, kind: Kind, folder: str) -> list[str]:
    listed = pages(transport, Item, f"/projects/{project}/{kind.plural}", {"directly_in": folder, "limit": 500})
    return [one.name for one in islice(listed, MOST_COMPARED)]


def _folders(transport: Transport, project: str) -> list[str]:
    return [one.path for one in pages(transport, Collection, f"/projects/{project}/collections")]
