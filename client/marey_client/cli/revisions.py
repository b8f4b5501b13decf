"""Addresses with `@`: revisions of items, as in `lab/raw/walk@2`, and versions of datasets, as in `lab/gaits@v1/raw`.

Names may contain `@`, so an item or a folder whose name is the whole text takes precedence.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from marey_client.cli.addresses import Address, find_item, require_item
from marey_client.cli.terminal.failures import WrongUsage

if TYPE_CHECKING:
    from marey_client.items import ItemHandle
    from marey_client.marey import Marey
    from marey_schemas.kinds import Kind
    from marey_schemas.queue.jobs import DatasetInput

_REVISION = re.compile(r"(.+)@([1-9][0-9]{0,8})")
_VERSION = re.compile(r"([^/@]+)@([^/@]+)(?:/(.+))?")


RevisionNumber = Annotated[
    int | None, typer.Option("--revision", min=1, help="Number of the revision; the same as @NUMBER after the name.")
]


def at_revision(place: str, revision: int | None) -> str:
    """Return the address of a revision of the item at `place`; without a revision, `place` itself."""
    return place if revision is None else f"{place.rstrip('/')}@{revision}"


def require_revision(marey: Marey, address: Address, kinds: Sequence[Kind]) -> tuple[Any, int | None]:
    """Return the item at an address, and the revision number after `@`, or None if the address has no revision.

    Raises `WrongUsage` if there is no item.
    """
    found = find_revision(marey, address, kinds)
    return found if found is not None else (require_item(marey, address, kinds), None)


def find_revision(marey: Marey, address: Address, kinds: Sequence[Kind]) -> tuple[ItemHandle, int | None] | None:
    """Return the item at an address, and the number after `@`, if any; None instead of the pair if there is no item."""
    found = find_item(marey, address, kinds)
    if found is not None or address.is_folder:
        return None if found is None else (found, None)
    named = _REVISION.fullmatch(address.path)
    if named is None or (found := find_item(marey, Address(address.project, named[1]), kinds)) is None:
        return None
    return found, int(named[2])


def find_version(marey: Marey, address: Address) -> DatasetInput | None:
    """Return the version of a dataset, or the folder in a version, that an address names.

    Returns None if the address has no `@`, or is the path of a folder of the project. For every other address, raises
    `WrongUsage` unless the address has the form of a version.
    """
    from marey_schemas.queue.jobs import DatasetInput

    if "@" not in address.path or marey.project(address.project).collections.at(address.path) is not None:
        return None
    version = _VERSION.fullmatch(address.path)
    if version is None:
        raise WrongUsage(
            f"{address} is not the address of an item, a revision or a version; write project/folder/name for an "
            "item, project/folder/name@2 for a revision, and project/dataset@v1 or project/dataset@v1/folder for a "
            "version of a dataset"
        )
    return DatasetInput(dataset=version[1], version=version[2], path=version[3] or "")
