"""A project with users in every role, and small documents for its items."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.support.kept_rows import made_once

from marey_schemas.access import MemberChange, ProjectChange, ProjectCreate, Role, UserCreate, Visibility
from marey_schemas.items import Event, Item, ItemCreate
from marey_schemas.kinds import Kind
from marey_server.access.folder_rights import FolderRights
from marey_server.access.principal import ANONYMOUS, SYSTEM, Principal
from marey_server.access.roles import RequiredRole
from marey_server.handlers.catalogue import RESOURCES
from marey_server.store import events, items, members, projects, users
from marey_server.store.database.connections import Database
from marey_server.store.transaction import Transaction

ALL_RIGHTS = FolderRights("lab", Role.OWNER)
ALL_SCOPES = ("read", "write", "jobs", "work", "admin")


def skeleton_tree(joints: int = 3, *, bone_m: float = 0.5) -> dict[str, Any]:
    """Return the document of a skeleton whose joints `j0`, `j1` and so on form a chain."""
    chain = [{"name": f"j{i}", "parent": i - 1, "offset": [0, bone_m if i else 0, 0]} for i in range(joints)]
    return {"schema": "marey/skeleton@1", "joints": chain}


def random_poses(frames: int, joints: int, seed: int) -> NDArray[np.float32]:
    """Return poses with random places of the root, and random rotations."""
    poses = np.random.default_rng(seed).normal(size=(frames, 3 + 4 * joints))
    rotations = poses[:, 3:].reshape(frames, joints, 4)
    rotations /= np.linalg.norm(rotations, axis=2, keepdims=True)
    return poses.astype("<f4")


def motion_tree(
    skeleton: Mapping[str, object] | Item, *, frames: int = 5, joints: int = 3, seed: int = 0
) -> dict[str, Any]:
    """Return the document of a random motion of `skeleton_tree`; `skeleton` is an item, or a reference."""
    ref = {"item": skeleton.id, "revision": skeleton.revision} if isinstance(skeleton, Item) else skeleton
    return {
        "schema": "marey/motion@1",
        "skeleton": ref,
        "frame_rate_hz": 120.0,
        "joints": [f"j{i}" for i in range(joints)],
        "poses": random_poses(frames, joints, seed),
    }


def _new_user(tx: Transaction, name: str, *, administrator: bool = False) -> Principal:
    made = users.create_user(tx, UserCreate(name=name, administrator=administrator))
    return Principal("user", made.id, made.name, administrator, ALL_SCOPES)


READ = RequiredRole(Role.READER, "read")
WRITE = RequiredRole(Role.CONTRIBUTOR, "write")


def requiring(required: RequiredRole, function: Callable[..., Any]) -> Any:
    """Return a function that runs `function` as part of an operation that requires the role `required`."""

    def run(tx: Transaction, *args: Any, **kwargs: Any) -> Any:
        tx.required_role = required
        return function(tx, *args, **kwargs)

    return run


def declared(method: str, path: str) -> RequiredRole:
    """Return the role that the REST operation with this method and path requires."""
    (found,) = (resource for resource in RESOURCES if resource.path == path)
    return found.operations[method].required_role


class Lab:
    """The project `lab` in a database, and its members."""

    def __init__(self, database: Database, name: str = "lab") -> None:
        self.database = database
        self.name = name
        database.write(SYSTEM, self._furnish)

    def _furnish(self, tx: Transaction) -> None:
        self.owner, self.maintainer, self.contributor, self.reader, self.stranger = (
            _new_user(tx, f"{who}-{self.name}") for who in ("owner", "maintainer", "contributor", "reader", "stranger")
        )
        self.anonymous = ANONYMOUS
        tx.principal = self.owner
        projects.create_project(tx, ProjectCreate(name=self.name))
        for who in (self.maintainer, self.contributor, self.reader):
            role = Role(str(who.user_name).partition("-")[0])
            members.put_member(tx, self.name, str(who.user_name), MemberChange(role=role))

    def sign_up(self, name: str, *, administrator: bool = False) -> Principal:
        """Create a user, and return a principal of this user with every scope."""
        return self.database.write(SYSTEM, _new_user, name, administrator=administrator)

    def read(
        self,
        function: Callable[..., Any],
        *args: Any,
        who: Principal | None = None,
        required: RequiredRole = READ,
        **kwargs: Any,
    ) -> Any:
        """Run a function that reads, as the owner or as `who`, and return its result.

        The operation of the request declares the role `required`.
        """
        return self.database.read(who or self.owner, requiring(required, function), *args, **kwargs)

    def write(
        self,
        function: Callable[..., Any],
        *args: Any,
        who: Principal | None = None,
        required: RequiredRole = WRITE,
        **kwargs: Any,
    ) -> Any:
        """Run a function that writes, as the owner or as `who`, and return its result.

        The operation of the request declares the role `required`.
        """
        return self.database.write(who or self.owner, requiring(required, function), *args, **kwargs)

    def events(self, after: int = 0, **kwargs: Any) -> list[Event]:
        """Return the events after the one numbered `after`."""
        self.database.write(SYSTEM, events.number_events)
        found: list[Event] = self.read(events.list_events, self.name, after=after, **kwargs).items
        return found

    def make_public(self) -> None:
        """Make the project public, so that every user can read it."""
        change = ProjectChange(visibility=Visibility.PUBLIC)
        self.write(projects.change_project, self.name, change, expected_rev=None)

    def add_skeleton(self, name: str = "rig", **kwargs: Any) -> Item:
        """Create a skeleton in the project, and return it."""
        request = ItemCreate(name=name, parts={"hierarchy": skeleton_tree(**kwargs)})
        return self.write(items.create_item, self.name, Kind.SKELETON, request)

    def add_clip(
        self,
        skeleton: Mapping[str, object] | Item,
        name: str = "walk",
        *,
        collection: str = "",
        tags: tuple[str, ...] = (),
        who: Principal | None = None,
        info: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> Item:
        """Create a clip of random poses in the project, and return it."""
        parts = {"motion": motion_tree(skeleton, **kwargs)} | ({"info": info} if info else {})
        request = ItemCreate(name=name, collection=collection, tags=tags, parts=parts)
        return self.write(items.create_item, self.name, Kind.CLIP, request, who=who)


@pytest.fixture
def lab(database: Database) -> Lab:
    """A project with people in every role, on SQLite and on Postgres."""
    return made_once(Lab, database)
