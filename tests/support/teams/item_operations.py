"""Operations of users on items: creation, revisions, renaming, deletion, restoration, purges and uploads of files."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any

from tests.support.teams.contents import Content, Info, Labels, Motion, document
from tests.support.teams.model import Model, ModelItem
from tests.support.teams.operations import Clients, Operation, Outcome, Refused, accepted, refuse

from marey_client.items import ItemHandle
from marey_schemas.access import Role
from marey_schemas.encoding.digests import digest_of
from marey_schemas.items import ItemChange
from marey_schemas.kinds import Kind
from marey_schemas.purges import PurgeAnswer


@dataclass(frozen=True)
class Revision:
    """Revision of an item, as the target of a reference in a document."""

    item: str
    number: int
    content: Content

    @property
    def reference(self) -> dict[str, Any]:
        return {"item": self.item, "revision": self.number}


@dataclass(frozen=True)
class CreateItem(Operation):
    """Creation of an item with a content; `of` is the revision to which documents of the item refer."""

    name: str
    folder: str
    content: Content
    of: Revision | None = None
    tags: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        return f"Create{self.content.kind.value.title()}"

    def send(self, clients: Clients) -> Any:
        reference = None if self.of is None else self.of.reference
        parts = {name: document(value, reference) for name, value in self.content.parts}
        items = clients.project(self.lab).items(self.content.kind)
        return items.create(self.name, parts, collection=self.folder, tags=self.tags).item

    def place(self, model: Model) -> str:
        return self.folder

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        project = self.project(model)
        refers = frozenset() if self.of is None else frozenset({self.of.item})
        key = f"{self.folder}/{self.name}".lstrip("/"), self.content.kind
        if project.occupied(key):
            refuse(outcome, "name-taken")
            return
        made = accepted(outcome)
        assert made.id not in project.items
        project.items[made.id] = ModelItem(
            made.id, made.kind, self.folder, self.name, (self.content,), refers, frozenset(self.tags)
        )
        for _, value in self.content.parts:
            if isinstance(value, Info) and value.file is not None:
                project.loose_files.pop(value.file, None)


@dataclass(frozen=True)
class OnItem(Operation):
    """Operation on an item, which may be present, deleted or purged."""

    item: str
    kind: Kind

    def forbidden(self, model: Model, outcome: Outcome) -> None:
        """Fail if the outcome is not a refusal because of the user's role, or because the item is absent.

        The server looks up the item before it checks the role.
        """
        refuse(outcome, 403, *(() if self.found(model).status == "present" else (404, 410)))

    def read(self, clients: Clients) -> ItemHandle:
        """Return the item as it is now."""
        handle: ItemHandle = clients.project(self.lab).items(self.kind).get(self.item)
        return handle

    def found(self, model: Model) -> ModelItem:
        return self.project(model).items[self.item]

    def absent(self, model: Model, outcome: Outcome) -> bool:
        """Return whether the item is deleted or purged in the model; if so, check that reading it was refused."""
        absent = self.found(model).status != "present"
        if absent:
            refuse(outcome, 404)
        return absent


@dataclass(frozen=True)
class Revise(OnItem):
    """Change of one part of an item; `of` is the revision to which the new document refers."""

    part: str
    value: Hashable
    of: Revision | None = None

    def send(self, clients: Clients) -> Any:
        return self.read(clients).put_part(
            self.part, document(self.value, None if self.of is None else self.of.reference)
        )

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        if not self.absent(model, outcome):
            made = accepted(outcome)
            before = self.found(model).revisions
            # Equal content is another document if the server, in a checkout, has chosen an equal item to refer to.
            self._add(model, same_content=self.of is not None and made.revision > len(before))
            assert made.revision == len(self.found(model).revisions), f"{made.revision} after {len(before)}"

    def assume(self, model: Model) -> None:
        self._add(model, same_content=False)

    def _add(self, model: Model, *, same_content: bool) -> None:
        """Add a revision if the content changes; with `same_content`, also if it does not change."""
        item = self.found(model)
        assert item.status == "present"
        content = item.revisions[-1].replaced(self.part, self.value)
        if same_content or content != item.revisions[-1]:
            refers = item.refers if self.of is None else item.refers | {self.of.item}
            self.project(model).update(item.id, revisions=(*item.revisions, content), refers=refers)


@dataclass(frozen=True)
class Rename(OnItem):
    """Change of the folder, the name and the tags of an item."""

    folder: str
    name: str
    tags: tuple[str, ...]

    def send(self, clients: Clients) -> Any:
        return self.read(clients).change(ItemChange(name=self.name, collection=self.folder, tags=self.tags))

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        if self.absent(model, outcome):
            return
        if self.project(model).occupied(self._key, self.item):
            refuse(outcome, "name-taken")
        else:
            accepted(outcome)
            self.assume(model)

    def assume(self, model: Model) -> None:
        project = self.project(model)
        assert self.found(model).status == "present"
        assert not project.occupied(self._key, self.item)
        project.update(self.item, folder=self.folder, name=self.name, tags=frozenset(self.tags))

    @property
    def _key(self) -> tuple[str, Kind]:
        return f"{self.folder}/{self.name}".lstrip("/"), self.kind


@dataclass(frozen=True)
class DeleteItem(OnItem):
    """Deletion of an item, which can be restored."""

    role = Role.MAINTAINER

    def send(self, clients: Clients) -> None:
        self.read(clients).delete()

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        if not self.absent(model, outcome):
            accepted(outcome)
            self.assume(model)

    def assume(self, model: Model) -> None:
        assert self.found(model).status == "present"
        self.project(model).update(self.item, status="deleted")


@dataclass(frozen=True)
class RestoreItem(OnItem):
    """Restoration of a deleted item."""

    role = Role.MAINTAINER

    def send(self, clients: Clients) -> Any:
        return clients.project(self.lab).items(self.kind).restore(self.item).item

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        item = self.found(model)
        if item.status != "deleted":
            refuse(outcome, 404 if item.status == "present" else 410)
        elif self.project(model).occupied(item.key, item.id):
            refuse(outcome, "name-taken")
        else:
            assert accepted(outcome).revision == len(item.revisions)
            self.project(model).update(item.id, status="present")


@dataclass(frozen=True)
class Purge(Operation):
    """Purge of one deleted item, or of all deleted items of the project."""

    role = Role.OWNER
    item: str | None = None

    @property
    def label(self) -> str:
        return "PurgeAll" if self.item is None else "PurgeItem"

    def send(self, clients: Clients) -> PurgeAnswer:
        chosen: dict[str, Any] = {"collection": ""} if self.item is None else {"item": self.item}
        return clients.project(self.lab).purge(**chosen)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        project = self.project(model)
        deleted = {one.id for one in project.items.values() if one.status == "deleted"}
        if self.item is not None and self.item not in deleted:
            status = project.items[self.item].status
            refuse(outcome, "not-deleted" if status == "present" else 410)
            return
        if isinstance(outcome, Refused):
            refuse(outcome, "still-held")
            assert self.item is not None
            assert not model.certainly_free(self.lab, [self.item]), "an item that nothing needs is not purged"
            return
        answer = accepted(outcome)
        purged = {one.item for one in answer.purged}
        self._check(model, deleted if self.item is None else {self.item}, purged)
        for item_id in purged & project.items.keys():
            project.update(item_id, status="purged")

    def _check(self, model: Model, wanted: set[str], purged: set[str]) -> None:
        """Fail if an item was purged although something needs it, or was kept although certainly nothing needs it."""
        known = purged & self.project(model).items.keys()
        assert known <= wanted
        held = {one for one in wanted if model.is_held(self.lab, one)}
        assert not known & held, f"purged although something needs them: {known & held}"
        if model.certainly_free(self.lab, wanted):
            assert known == wanted, f"not purged although nothing needs them: {wanted - known}"


@dataclass(frozen=True)
class UploadFile(Operation):
    """Upload of a file, to which an item may refer later."""

    role = Role.READER
    data: bytes

    def send(self, clients: Clients) -> str:
        return clients.servers[self.lab].blobs.put(self.data)

    def absorb(self, model: Model, clients: Clients, outcome: Outcome) -> None:
        assert accepted(outcome) == digest_of(self.data)
        if accepted(outcome) not in model.needed_files():
            self.project(model).loose_files[accepted(outcome)] = clients.user


def revision_of(item: ModelItem, number: int | None = None) -> Revision:
    """Return a revision of an item, by default the newest."""
    chosen = number or len(item.revisions)
    return Revision(item.id, chosen, item.revisions[chosen - 1])


def clip_content(skeleton: Revision, seed: int, comment: str, file: str | None) -> Content:
    """Return the content of a clip of a skeleton."""
    return Content.of(Kind.CLIP, {"motion": Motion(seed, skeleton.content), "info": Info(comment, file)})


def labels_content(labels: Labels) -> Content:
    """Return the content of an annotation."""
    return Content.of(Kind.ANNOTATION, {"annotation": labels})
