"""API of the stub cluster over HTTP: one namespace, as far as the launcher and `kubectl apply` need it."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, cast

from tests.support.cluster.admission import Rights, admit
from tests.support.cluster.objects import Document, Event, Objects, Refused
from tornado.http1connection import HTTP1Connection
from tornado.iostream import StreamClosedError
from tornado.web import Application, RequestHandler

NAMESPACE = "marey"
GROUPS = {"batch": ["jobs"], "apps": ["deployments"], "": ["pods", "secrets"]}
KINDS = {"jobs": "Job", "deployments": "Deployment", "pods": "Pod", "secrets": "Secret"}


@dataclass
class Faults:
    """Faults that the API shows until a test removes them."""

    status: int | None = None
    """Status of all answers, such as 503."""
    delay_s: float = 0.0
    """Seconds before each answer."""
    lose: set[str] = field(default_factory=set)
    """Methods of requests that are carried out, but not answered: the connection is closed."""
    watches: Literal["work", "drop", "gone", "silent"] = "work"
    """Behaviour of watches: they work, end at once, answer 410, or never send anything."""


@dataclass
class Api:
    """State that all requests share."""

    objects: Objects
    callers: dict[str, Rights]
    """Rights by token."""
    read_log: Callable[[str], str]
    faults: Faults = field(default_factory=Faults)
    requests: list[tuple[str, str]] = field(default_factory=list)
    """Method and path of all requests, with `watch` in place of the method of a watch."""

    def application(self) -> Application:
        """Return the application that answers requests."""
        return Application([(r"/(?:api|apis)/.*", _Handler, {"api": self})], log_function=lambda _: None)


class _Handler(RequestHandler):
    def initialize(self, api: Api) -> None:
        self.api = api

    async def prepare(self) -> None:
        faults = self.api.faults
        watching = self.get_argument("watch", "") == "true"
        self.api.requests.append(("WATCH" if watching else self.request.method, self.request.path))
        await asyncio.sleep(faults.delay_s)
        if faults.status is not None:
            raise Refused(faults.status, "InternalError", "a fault of the stub")
        self.kind, self.name, self.subresource = self._place()
        self._authorise("watch" if watching else None)

    def _place(self) -> tuple[str, str, str]:
        """Return kind, name and subresource in the path."""
        parts = self.request.path.strip("/").split("/")
        group, rest = ("", parts[2:]) if parts[0] == "api" else (parts[1], parts[3:])
        self.group = group
        if rest[:1] != ["namespaces"] or rest[2:3] == [] or rest[2] not in GROUPS.get(group, ()):
            raise Refused(404, "NotFound", f"the stub has no {self.request.path}")
        self.namespace = rest[1]
        _, _, kind, name, subresource = [*rest, "", ""][:5]
        return kind, name, subresource

    def _authorise(self, verb: str | None) -> None:
        scheme, _, token = self.request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() != "bearer" or token not in self.api.callers:
            raise Refused(401, "Unauthorized", "Unauthorized")
        usual = {"GET": "get" if self.name else "list", "POST": "create", "DELETE": "delete", "PUT": "update",
                 "PATCH": "patch"}[self.request.method or ""]  # fmt: skip
        verb = verb or usual
        resource = f"{self.kind}/{self.subresource}" if self.subresource else self.kind
        allowed = self.api.callers[token].allows(verb, self.group, resource)
        if not allowed or self.namespace != NAMESPACE:
            raise Refused(403, "Forbidden", f"cannot {verb} resource {resource!r} in the namespace {self.namespace!r}")

    async def get(self) -> None:
        objects, selector = self.api.objects, self.get_argument("labelSelector", "")
        if self.subresource == "log":
            objects.read("pods", self.name)
            lines = self.api.read_log(self.name).splitlines()[-int(self.get_argument("tailLines", "1000")) :]
            self.finish("\n".join(lines))
        elif self.name:
            self.finish(objects.read(self.kind, self.name))
        elif self.get_argument("watch", "") == "true":
            await self._watch(selector)
        else:
            self._list(objects.select(self.kind, selector))

    def _list(self, found: list[Document]) -> None:
        """Answer one page; the token of the next page is the number of objects before it."""
        first = int(self.get_argument("continue", "0"))
        last = first + int(self.get_argument("limit", "500"))
        metadata: dict[str, Any] = {"resourceVersion": str(self.api.objects.version)}
        if last < len(found):
            metadata["continue"] = str(last)
        self.finish({"kind": f"{KINDS[self.kind]}List", "metadata": metadata, "items": found[first:last]})

    async def _watch(self, selector: str) -> None:
        objects, faults = self.api.objects, self.api.faults
        version = int(self.get_argument("resourceVersion"))
        loop = asyncio.get_running_loop()
        deadline = loop.time() + float(self.get_argument("timeoutSeconds", "60"))
        if faults.watches == "gone":
            raise Refused(410, "Expired", "too old resource version")
        while faults.watches != "drop" and (left_s := deadline - loop.time()) > 0:
            changed = objects.changed
            if faults.watches == "work":
                version = await self._send_events(version, selector)
            # `asyncio.wait_for` ignores, in Python 3.11, a cancellation that comes together with the change.
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(min(left_s, 0.2)):
                    await changed.wait()

    async def _send_events(self, version: int, selector: str) -> int:
        """Send the events since a version, and return the newest version."""
        try:
            events = self.api.objects.events_since(version, self.kind, selector)
        except Refused as error:
            events = [Event(version, self.kind, "ERROR", error.status)]
        for event in events:
            version = event.version
            self.write(json.dumps({"type": event.type, "object": event.document}) + "\n")
        try:
            await self.flush()
        except StreamClosedError:
            return version
        return version

    async def post(self) -> None:
        document = json.loads(self.request.body)
        document["metadata"].setdefault("namespace", NAMESPACE)
        if document["kind"] != KINDS[self.kind]:
            raise Refused(400, "BadRequest", f"a {document['kind']} is not one of {self.kind}")
        admit(document)
        made = self.api.objects.create(self.kind, document)
        self._answer(201, made)

    async def delete(self) -> None:
        document = self.api.objects.read(self.kind, self.name)
        if self.get_argument("propagationPolicy", "Background") != "Background":
            raise Refused(400, "BadRequest", "the stub knows only the propagation policy Background")
        self.api.objects.mark_deleted(self.kind, self.name)
        self._answer(200, document)

    def _answer(self, status: int, document: Document) -> None:
        if self.request.method in self.api.faults.lose:
            cast(HTTP1Connection, self.request.connection).stream.close()
            return
        self.set_status(status)
        self.finish(document)

    def send_error(self, status_code: int = 500, **kwargs: Any) -> None:
        if not self._headers_written:  # otherwise, a watch has ended
            super().send_error(status_code, **kwargs)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        error = kwargs["exc_info"][1]
        if not isinstance(error, Refused):
            error = Refused(500, "InternalError", repr(error))
        self.set_status(error.code)
        self.finish(error.status)

    def log_exception(self, typ: Any, value: Any, tb: Any) -> None:
        if not isinstance(value, Refused | StreamClosedError):
            super().log_exception(typ, value, tb)
