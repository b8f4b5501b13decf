"""Objects of the stub cluster, with versions and watches. All functions run on the event loop of the stub."""

from __future__ import annotations

import asyncio
import copy
import datetime
import itertools
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

Document = dict[str, Any]
Key = tuple[str, str]
"""Kind in the plural, such as `jobs`, and name of an object."""


class Refused(Exception):
    """Refusal of a request, with the fields of the `Status` document that the API answers."""

    def __init__(self, code: int, reason: str, message: str) -> None:
        super().__init__(message)
        self.code, self.reason = code, reason

    @property
    def status(self) -> Document:
        return {"kind": "Status", "apiVersion": "v1", "metadata": {}, "status": "Failure", "message": str(self),
                "reason": self.reason, "code": self.code}  # fmt: skip


@dataclass(frozen=True)
class Event:
    """Change of an object, as a watch shows it."""

    version: int
    kind: str
    type: str
    document: Document


@dataclass
class Objects:
    """All objects of the namespace. Every change gets the next version of the cluster."""

    version: int = 1000
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    _documents: dict[Key, Document] = field(default_factory=dict)
    _events: list[Event] = field(default_factory=list)
    _oldest: int = 1000
    _letters: Iterator[int] = field(default_factory=lambda: itertools.count(1))

    def create(self, kind: str, document: Document) -> Document:
        """Store a new object, and return it as stored."""
        document = copy.deepcopy(document)
        metadata = document["metadata"]
        if "generateName" in metadata:
            metadata["name"] = f"{metadata.pop('generateName')}{next(self._letters):05x}"
        if (kind, metadata["name"]) in self._documents:
            raise Refused(409, "AlreadyExists", f'{kind} "{metadata["name"]}" already exists')
        metadata |= {"uid": str(uuid.uuid4()), "creationTimestamp": now()}
        self._store(kind, "ADDED", document)
        return copy.deepcopy(document)

    def read(self, kind: str, name: str) -> Document:
        """Return a copy of an object."""
        if (kind, name) not in self._documents:
            raise Refused(404, "NotFound", f'{kind} "{name}" not found')
        return copy.deepcopy(self._documents[kind, name])

    def change(self, kind: str, name: str, change: Callable[[Document], object]) -> None:
        """Change an object that exists; without a difference, nothing happens."""
        document = self.read(kind, name)
        change(document)
        if document != self._documents[kind, name]:
            self._store(kind, "MODIFIED", document)

    def delete(self, kind: str, name: str) -> None:
        """Remove an object, and the objects that it owns."""
        document = self.read(kind, name)
        del self._documents[kind, name]
        self._announce(kind, "DELETED", document)
        for of_kind, owned in self.owned_by(document):
            self.mark_deleted(of_kind, owned["metadata"]["name"])

    def mark_deleted(self, kind: str, name: str) -> None:
        """Remove an object; a pod is removed by the kubelet when its process has ended."""
        if kind != "pods":
            self.delete(kind, name)
            return
        self.change(kind, name, lambda pod: pod["metadata"].setdefault("deletionTimestamp", now()))

    def delete_orphans(self) -> None:
        """Delete the objects whose owners do not exist."""
        present = {document["metadata"]["uid"] for document in self._documents.values()}
        for (kind, name), document in list(self._documents.items()):
            owners = document["metadata"].get("ownerReferences", ())
            if owners and not any(owner["uid"] in present for owner in owners):
                self.mark_deleted(kind, name)

    def owned_by(self, owner: Document) -> list[tuple[str, Document]]:
        """Return the objects with a reference to their owner."""
        uid = owner["metadata"]["uid"]
        return [
            (kind, document)
            for (kind, _), document in list(self._documents.items())
            if any(one["uid"] == uid for one in document["metadata"].get("ownerReferences", ()))
        ]

    def select(self, kind: str, selector: str = "") -> list[Document]:
        """Return copies of the objects that have the labels of a selector."""
        found = [document for (of_kind, _), document in self._documents.items() if of_kind == kind]
        return [copy.deepcopy(document) for document in found if selects(selector, document)]

    def events_since(self, version: int, kind: str, selector: str) -> list[Event]:
        """Return the later changes. Raises `Refused` (410) if some of them are forgotten."""
        if version < self._oldest:
            raise Refused(410, "Expired", f"too old resource version: {version} ({self._oldest})")
        later = [event for event in self._events if event.version > version and event.kind == kind]
        return [event for event in later if selects(selector, event.document)]

    def forget_events(self) -> None:
        """Forget all changes, as a cluster does after some minutes; watches of earlier versions are then refused."""
        self._events.clear()
        self._oldest = self.version

    def _store(self, kind: str, change: str, document: Document) -> None:
        self._documents[kind, document["metadata"]["name"]] = document
        self._announce(kind, change, document)

    def _announce(self, kind: str, change: str, document: Document) -> None:
        self.version += 1
        document["metadata"]["resourceVersion"] = str(self.version)
        self._events.append(Event(self.version, kind, change, copy.deepcopy(document)))
        self.changed.set()
        self.changed = asyncio.Event()


def now() -> str:
    """Return the time in the form of Kubernetes."""
    return datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def selects(selector: str, document: Document) -> bool:
    """Return whether an object has all labels of a selector such as `a=b,c=d`."""
    labels = document["metadata"].get("labels") or {}
    pairs = [part.split("=", 1) for part in selector.split(",") if part]
    if any(len(pair) != 2 or pair[0].endswith("!") for pair in pairs):
        raise Refused(400, "BadRequest", f"the stub does not know the selector {selector!r}")
    return all(labels.get(name) == text for name, text in pairs)


def condition(document: Document, kind: str) -> Document | None:
    """Return a condition that is true."""
    every = document.get("status", {}).get("conditions", ())
    return next((one for one in every if one["type"] == kind and one["status"] == "True"), None)


def set_condition(document: Document, kind: str, value: bool, reason: str, message: str = "") -> None:
    """Set a condition of an object."""
    every = document.setdefault("status", {}).setdefault("conditions", [])
    every[:] = [one for one in every if one["type"] != kind]
    every.append({"type": kind, "status": str(value), "reason": reason, "message": message})
