"""`lab/raw/walk`: a project, a folder in it, an item in that."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from marey_client.cli.failures import WrongUsage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from marey_client.items import ItemHandle
    from marey_client.marey import Marey
    from marey_schemas.kinds import Kind

_ID = re.compile(r"([a-z]+)_[0-9a-hjkmnp-tv-z]{26}")


@dataclass(frozen=True)
class Address:
    """A project and a path in it; the path may name a folder or an item."""

    project: str
    path: str

    @classmethod
    def parse(cls, text: str) -> Address:
        """Read `project` or `project/path`."""
        project, _, path = text.strip("/").partition("/")
        if not project:
            raise WrongUsage(f"{text!r} names no project; write project/folder/name")
        return cls(project, path)

    def __str__(self) -> str:
        return f"{self.project}/{self.path}" if self.path else self.project

    @property
    def name(self) -> str:
        """The last name of the path, which may also be an item's id."""
        return self.path.rpartition("/")[2]

    @property
    def has_id(self) -> bool:
        """Whether the last name is an id rather than a name."""
        return _ID.fullmatch(self.name) is not None


def find_item(marey: Marey, address: Address, kinds: Sequence[Kind]) -> ItemHandle | None:
    """The item an address names, of the first of `kinds` that has one; None if there is none."""
    project = marey.project(address.project)
    if not address.path:
        return None
    for kind in kinds:
        items = project.items(kind)
        if address.has_id:
            if address.name.startswith(f"{kind.value}_"):
                return _existing(items, address.name)
            continue
        named: ItemHandle | None = next(items.list(path=address.path, page_size=1), None)
        if named is not None:
            return named
    return None


def require_item(marey: Marey, address: Address, kinds: Sequence[Kind]) -> Any:
    """The item an address names. Raises `WrongUsage` where there is none."""
    found = find_item(marey, address, kinds)
    if found is None:
        wanted = " or ".join(kind.value for kind in kinds) if len(kinds) <= 2 else "item"
        raise WrongUsage(f"there is no {wanted} at {address}; marey ls {address.project} shows what there is")
    return found


def _existing(items: Any, item_id: str) -> ItemHandle | None:
    from marey_client.errors import NotFound

    try:
        found: ItemHandle = items.get(item_id)
    except NotFound:
        return None
    return found
