"""Model of the rights to write in folders: folders, items and roles in memory. It predicts outcomes of random calls.

The model repeats the rules of roles in folders in a simpler form: at each call, it goes from the folder upwards to the
nearest role.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from tests.support.store_fixtures import Lab, declared, skeleton_tree
from tests.support.who_may import RANK

from marey_schemas.access import EVERY_MEMBER, FolderRoleChange, Role
from marey_schemas.items import CollectionChange, CollectionCreate, ItemChange, ItemCreate, ItemRevert
from marey_schemas.kinds import Kind
from marey_server.access.principal import Principal
from marey_server.errors import ForbiddenProblem
from marey_server.store import collections, items
from marey_server.store.folder_roles import managing

MEMBERS = ("owner", "maintainer", "contributor", "reader")
DEEPEST = 4
COLLECTIONS, ITEMS = "/projects/{project}/collections", "/projects/{project}/{kind}"
ROLES = f"{COLLECTIONS}/{{collection}}/roles/{{user}}"


@dataclass
class Folder:
    """Folder of the model, with the roles in this folder, by kind of member or `*` for all members."""

    id: str
    name: str
    above: Folder | None
    roles: dict[str, Role] = field(default_factory=dict)
    deleted: bool = False
    deleted_at: str = ""
    """Path of the folder when it was deleted; a restoration uses this path."""

    @property
    def line(self) -> Iterator[Folder]:
        """The folder and all folders above it, nearest first."""
        folder: Folder | None = self
        while folder is not None:
            yield folder
            folder = folder.above

    @property
    def path(self) -> str:
        """The path, which is empty for the top folder."""
        return "/".join(one.name for one in reversed(list(self.line)) if one.name)

    def role(self, who: str) -> Role:
        """Return the member's role in this folder: the nearest role on the way up, or else the role in the project.

        A role of the member comes before a role of all members in the same folder.
        """
        if who == "owner":
            return Role.OWNER
        for folder in self.line:
            for name in (who, EVERY_MEMBER):
                if name in folder.roles:
                    return folder.roles[name]
        return Role(who)

    def allows(self, who: str, least: Role) -> bool:
        """Return whether a member has at least a role here."""
        return RANK[self.role(who)] >= RANK[least]


@dataclass
class Thing:
    """Item of the model."""

    id: str
    folder: Folder
    deleted: bool = False


class WritingProgram:
    """Random calls of the members of a lab; `differences` collects the calls whose outcomes the model did not expect.

    Calls can fail only because of a role: names are never used twice, and only what exists is changed.
    """

    def __init__(self, lab: Lab, seed: int) -> None:
        self.lab = lab
        self.chance = random.Random(seed)
        self.top = Folder("", "", None)
        self.folders: list[Folder] = []
        self.things: list[Thing] = []
        self.differences: list[str] = []
        self.allowed = self.refused = 0
        self._names = 0
        for _ in range(6):
            self.create_folder("owner")
            self.create_item("owner")

    def run(self, count: int) -> None:
        """Make calls until an outcome differs from the model, or all calls are made."""
        kinds: tuple[Callable[[str], None], ...] = (
            self.create_item, self.edit_item, self.revert_item, self.rename_item, self.move_item, self.delete_item,
            self.restore_item, self.create_folder, self.move_folder, self.delete_folder, self.restore_folder,
            self.put_role, self.put_role, self.remove_role, self.read_roles,
        )  # fmt: skip
        for _ in range(count):
            if not self.differences:
                self.chance.choice(kinds)(self.chance.choice(MEMBERS))

    # -- what exists ---------------------------------------------------------------------------------------------------

    def _alive(self) -> list[Folder]:
        return [one for one in self.folders if not any(above.deleted for above in one.line)]

    def _somewhere(self) -> Folder:
        return self.chance.choice([self.top, *self._alive()])

    def _below(self, folder: Folder) -> list[Folder]:
        """Return a folder, and the folders below it that were not deleted on their own."""
        inside = [one for one in self.folders if folder in one.line]
        return [one for one in inside if one is folder or not any(up.deleted for up in _until(one, folder))]

    def _thing(self, *, deleted: bool = False) -> Thing | None:
        """Return a random item in a folder that exists; None if there is no such item."""
        there = {id(one) for one in (self.top, *self._alive())}
        found = [one for one in self.things if one.deleted is deleted and id(one.folder) in there]
        return self.chance.choice(found) if found else None

    def _name(self) -> str:
        self._names += 1
        return f"n{self._names}"

    # -- calls on items ------------------------------------------------------------------------------------------------

    def create_item(self, who: str) -> None:
        folder = self._somewhere()
        request = ItemCreate(name=self._name(), collection=folder.path, parts={"hierarchy": skeleton_tree()})
        allowed = folder.allows(who, Role.CONTRIBUTOR)
        made = self._call(who, allowed, "POST", ITEMS, items.create_item, Kind.SKELETON, request)
        if made is not None:
            self.things.append(Thing(made.id, folder))

    def edit_item(self, who: str) -> None:
        if (thing := self._thing()) is not None:
            tree = skeleton_tree(bone_m=self.chance.uniform(0.1, 1))
            self._on(who, thing, "PUT", "/parts/{part}", items.put_part, "hierarchy", tree)

    def revert_item(self, who: str) -> None:
        if (thing := self._thing()) is not None:
            self._on(who, thing, "POST", "/revert", items.revert_item, ItemRevert(revision=1))

    def rename_item(self, who: str) -> None:
        if (thing := self._thing()) is not None:
            self._on(who, thing, "PATCH", "", items.change_item, ItemChange(name=self._name(), tags=("t",)))

    def move_item(self, who: str) -> None:
        thing, target = self._thing(), self._somewhere()
        if thing is not None:
            allowed = all(folder.allows(who, Role.CONTRIBUTOR) for folder in (thing.folder, target))
            change = ItemChange(collection=target.path)
            if self._on(who, thing, "PATCH", "", items.change_item, change, allowed=allowed):
                thing.folder = target

    def delete_item(self, who: str) -> None:
        thing = self._thing()
        if thing is not None:
            allowed = thing.folder.allows(who, Role.MAINTAINER)
            thing.deleted = self._on(who, thing, "DELETE", "", items.delete_item, allowed=allowed)

    def restore_item(self, who: str) -> None:
        thing = self._thing(deleted=True)
        if thing is not None:
            allowed = thing.folder.allows(who, Role.MAINTAINER)
            thing.deleted = not self._on(who, thing, "POST", "/restore", items.restore_item, allowed=allowed)

    def _on(
        self, who: str, thing: Thing, method: str, path: str, function: Any, *args: Any, allowed: bool | None = None
    ) -> bool:
        """Call a function for an item; by default, the call must succeed for contributors in the item's folder."""
        expected = thing.folder.allows(who, Role.CONTRIBUTOR) if allowed is None else allowed
        state = {"expected_rev": None}
        given = (Kind.SKELETON, thing.id, *args)
        self._call(who, expected, method, f"{ITEMS}/{{item}}{path}", function, *given, **state)
        return expected

    # -- calls on folders ----------------------------------------------------------------------------------------------

    def create_folder(self, who: str) -> None:
        above, name = self._somewhere(), self._name()
        if len(list(above.line)) > DEEPEST:
            return
        request = CollectionCreate(path=f"{above.path}/{name}".lstrip("/"))
        allowed = above.allows(who, Role.CONTRIBUTOR)
        made = self._call(who, allowed, "POST", COLLECTIONS, collections.create_collection, request)
        if made is not None:
            self.folders.append(Folder(made.id, name, above))

    def move_folder(self, who: str) -> None:
        folder, target, name = self._folder(), self._somewhere(), self._name()
        if folder is None or folder in target.line or len(list(target.line)) > DEEPEST:
            return
        allowed = self._entry_allows(who, folder, Role.CONTRIBUTOR) and target.allows(who, Role.CONTRIBUTOR)
        change = CollectionChange(path=f"{target.path}/{name}".lstrip("/"))
        path = f"{COLLECTIONS}/{{collection}}"
        self._call(who, allowed, "PATCH", path, collections.move_collection, folder.id, change, expected_rev=None)
        if allowed:
            folder.above, folder.name = target, name

    def delete_folder(self, who: str) -> None:
        folder = self._folder()
        if folder is None or self.chance.random() < 0.5:
            return
        allowed = self._entry_allows(who, folder, Role.MAINTAINER)
        path = f"{COLLECTIONS}/{{collection}}"
        self._call(who, allowed, "DELETE", path, collections.delete_collection, folder.id, expected_rev=None)
        folder.deleted, folder.deleted_at = allowed, folder.path

    def restore_folder(self, who: str) -> None:
        gone = [one for one in self.folders if one.deleted and self._is_free(one)]
        if not gone:
            return
        inside = [one for one in gone if one.above is not None and any(up.deleted for up in one.above.line)]
        folder = self.chance.choice(inside or gone)
        was, above = folder.above, folder.path.rpartition("/")[0]
        allowed = self._entry_allows(who, folder, Role.MAINTAINER)
        folder.above = self._nearest(above)
        allowed = allowed and self._entry_allows(who, folder, Role.MAINTAINER)
        folder.above = was
        path = f"{COLLECTIONS}/{{collection}}/restore"
        self._call(who, allowed, "POST", path, collections.restore_collection, folder.id)
        if allowed:
            folder.deleted, folder.above = False, self._made(above)

    def _is_free(self, folder: Folder) -> bool:
        """Return whether a deleted folder can be restored: no other folder has its path, or can be restored to it."""
        alive = {id(one) for one in self._alive()}
        line = {one.path: one for one in folder.line}
        others = [one for one in self.folders if line.get(one.path, one) is not one]
        taken = any(one.path == folder.path for one in others)
        return folder.path == folder.deleted_at and not taken and all(id(one) in alive for one in others)

    def _nearest(self, path: str) -> Folder:
        """Return the folder at a path, or the nearest existing one above it."""
        while path:
            for one in self._alive():
                if one.path == path:
                    return one
            path = path.rpartition("/")[0]
        return self.top

    def _made(self, path: str) -> Folder:
        """Return the folder at a path.

        If the model lacks the folder, add it: the restoration of an item or a folder below it has created it.
        """
        found = self._nearest(path)
        if found.path == path:
            return found
        above, _, name = path.rpartition("/")
        shown = self.lab.read(collections.list_collections, "lab", path=path, limit=1).items[0]
        made = Folder(shown.id, name, self._made(above))
        self.folders.append(made)
        return made

    def _folder(self) -> Folder | None:
        alive = self._alive()
        return self.chance.choice(alive) if alive else None

    def _entry_allows(self, who: str, folder: Folder, least: Role) -> bool:
        assert folder.above is not None
        return all(one.allows(who, least) for one in (folder.above, *self._below(folder)))

    # -- calls on roles ------------------------------------------------------------------------------------------------

    def put_role(self, who: str) -> None:
        folder = self._folder()
        if folder is None:
            return
        about = self.chance.choice((*MEMBERS[1:], EVERY_MEMBER))
        role = self.chance.choice((Role.READER, Role.CONTRIBUTOR, Role.MAINTAINER))
        given = (folder.id, self._user(about), FolderRoleChange.model_validate({"role": role}))
        if self._call(who, who == "owner", "PUT", ROLES, managing.put_folder_role, *given) is not None:
            folder.roles[about] = role

    def remove_role(self, who: str) -> None:
        found = [(folder, about) for folder in self._alive() for about in folder.roles]
        if not found:
            return
        folder, about = self.chance.choice(found)
        given = (folder.id, self._user(about))
        self._call(who, who == "owner", "DELETE", ROLES, managing.remove_folder_role, *given, expected_rev=None)
        if who == "owner":
            del folder.roles[about]

    def read_roles(self, who: str) -> None:
        page = self.lab.read(collections.list_collections, "lab", limit=1000, who=getattr(self.lab, who))
        shown = {one.path: one.role for one in page.items}
        if shown != (expected := {one.path: one.role(who) for one in self._alive()}):
            self.differences.append(f"{who} sees the roles {shown}, not {expected}")

    def _user(self, about: str) -> str:
        return about if about == EVERY_MEMBER else str(getattr(self.lab, about).user_name)

    # -- calling -------------------------------------------------------------------------------------------------------

    def _call(self, who: str, allowed: bool, method: str, path: str, function: Any, *args: Any, **kwargs: Any) -> Any:
        """Call a function of the store as the operation at `path` does; return its result, or None if it is refused."""
        principal: Principal = getattr(self.lab, who)
        try:
            answer = self.lab.write(function, "lab", *args, who=principal, required=declared(method, path), **kwargs)
        except ForbiddenProblem as error:
            self.refused += 1
            if allowed:
                self.differences.append(f"{who} may call {function.__name__}{args}, but: {error.detail}")
            return None
        self.allowed += 1
        if not allowed:
            self.differences.append(f"{who} may not call {function.__name__}{args}")
        return answer


def _until(folder: Folder, stop: Folder) -> Iterator[Folder]:
    for one in folder.line:
        if one is stop:
            return
        yield one
