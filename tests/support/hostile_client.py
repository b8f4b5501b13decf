"""A malicious client: it sends requests that cost much or confuse the server to every route, as every kind of caller.

The routes come from the server's table of routes. A *shot* is a malicious request, with the manner of sending it.
"""

from __future__ import annotations

import asyncio
import bz2
import contextlib
import gzip
import io
import json
import random
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from urllib.parse import urlsplit

import bson
import msgpack
import numpy as np
from tests.support.furnished_house import ROUTES, House, Planned
from tests.support.rest_server import SCRIPTS_AT
from tests.support.who_may import PEOPLE, verdict

from marey_schemas.encoding import blocks
from marey_schemas.queue.scripts import REPOSITORIES_VARIABLE
from marey_server.http.routes import Route

SMALL_BYTES = 10_000
"""Largest size in bytes of a request whose cost is limited by the tests."""
ATTACKED = {
    "MAREY_LEASE_TTL_S": "3600", "MAREY_BODY_TIMEOUT_S": "5", "MAREY_HEADER_TIMEOUT_S": "5",
    REPOSITORIES_VARIABLE: json.dumps([SCRIPTS_AT]),
}  # fmt: skip
"""Environment of a server under attack: short timeouts, so that refused connections soon end, and long leases."""
HANGS_S = 120.0
"""Time without an answer after which a test says that the server hangs; much longer than any busy machine takes."""
ENDS_CREDENTIALS = ("/logout", "/complete", "/fail", "/leases/completions")
"""Endings of routes that end the credential of the caller; requests to these routes are sent last."""


class Manner(StrEnum):
    """Manner in which a request is sent, and in which its answer is read."""

    AT_ONCE = "at once"
    TWICE = "twice"
    SLOWLY = "slowly"
    HALF_CLOSED = "half closed"
    UNREAD = "unread"


@dataclass(frozen=True)
class Shape:
    """Body and headers of a request that attacks the server."""

    content: bytes
    headers: dict[str, str] = field(default_factory=dict)
    manner: Manner = Manner.AT_ONCE
    announced: int | None = None
    chunked: bytes | None = None
    query: str = ""


@dataclass(frozen=True)
class Shot:
    """Malicious request; `refusal` contains the statuses with which the server may refuse the caller.

    The bytes are made when they are needed: those of all attacks by all callers would take gigabytes.
    """

    route: str
    person: str
    attack: str
    plan: Planned
    shape: Shape
    token: str | None
    refusal: frozenset[int]

    @property
    def manner(self) -> Manner:
        """The manner in which the request is sent."""
        return self.shape.manner

    @property
    def data(self) -> bytes:
        """The bytes of the request."""
        return _bytes_of(self.plan, self.shape, self.token)

    @property
    def label(self) -> str:
        """The route, the caller and the attack, as text."""
        return f"{self.route} as {self.person}: {self.attack}"


@dataclass(frozen=True)
class Outcome:
    """Answer to a malicious request: status (None if the connection closed without an answer) and time in seconds."""

    shot: Shot
    status: int | None
    seconds: float
    head: str = ""
    hangs: bool = False

    @property
    def fault(self) -> str | None:
        """Description of what is wrong with the answer, or None."""
        if self.hangs:
            return f"{self.shot.label}: no answer after {HANGS_S:g} s"
        if self.status is None or self.status < 500:
            accepted = self.shot.refusal and self.status is not None and self.status < 400
            return f"{self.shot.label}: answered {self.status}" if accepted else None
        tells_when = self.status == 503 and "retry-after:" in self.head.lower()
        return None if tells_when else f"{self.shot.label}: answered {self.status}"


def _nested(levels: int) -> bytes:
    document: dict[str, object] = {}
    for _ in range(levels):
        document = {"a": document}
    return bson.encode(document)


def _packed_zeros() -> bytes:
    """Return a clip with one array of 5 MiB of zeros, which is packed into a few hundred bytes."""
    poses = np.zeros((2_000, 700), np.float32)
    leaf = {"dtype": "<f4", "shape": list(poses.shape), "encoding": "blocks", "data": blocks.encode(poses)}
    return msgpack.packb({"name": "walk", "parts": {"motion": {"poses": leaf}}})


def _files(name: str, content: bytes) -> bytes:
    head = f"--b\r\nContent-Disposition: form-data; name=files; filename={name}\r\n\r\n"
    return head.encode() + content + b"\r\n--b--\r\n"


def _bombs() -> Iterator[tuple[str, bytes]]:
    archive = io.BytesIO()
    np.savez_compressed(archive, poses=np.zeros((1_000, 1_000), np.float32))
    yield "npz", _files("walk.npz", archive.getvalue())
    yield "bz2", _files("walk.json.bz2", bz2.compress(b"[" * 20_000_000))


_JSON, _MSGPACK, _BSON = (f"application/{name}" for name in ("json", "msgpack", "bson"))
_BODIES = {
    "nested lists in JSON": (_JSON, b"[" * 4_900 + b"]" * 4_900),
    "nested objects in JSON": (_JSON, b'{"a":' * 1_600 + b"1" + b"}" * 1_600),
    "many lists in JSON": (_JSON, b"[" + b"[]," * 3_000 + b"[]]"),
    "many keys in JSON": (_JSON, b"{" + b",".join(b'"k%d":0' % n for n in range(900)) + b"}"),
    "a long number in JSON": (_JSON, b'{"name":' + b"9" * 9_000 + b"}"),
    "broken text in JSON": (_JSON, b'{"name":"\xff\xfe\\ud800' + b"\\u0000" * 900 + b'"}'),
    "nested lists in MessagePack": (_MSGPACK, b"\x91" * 9_000 + b"\xc0"),
    "many lists in MessagePack": (_MSGPACK, b"\xdd" + (9_000).to_bytes(4) + b"\x90" * 9_000),
    "a length that lies in MessagePack": (_MSGPACK, b"\xdf\xff\xff\xff\xff" + b"\xa1k" * 4_000),
    "packed zeros in MessagePack": (_MSGPACK, _packed_zeros()),
    "nested objects in BSON": (_BSON, _nested(900)),
    "a length that lies in BSON": (_BSON, (2**31 - 1).to_bytes(4, "little") + b"\x03a\x00" * 3_000),
    "a compressed body": (_JSON, gzip.compress(b"[" * 8_000_000)),
    **{f"a {name} that unpacks": ("multipart/form-data; boundary=b", content) for name, content in _bombs()},
}
"""Media types and bodies of up to 10 kB; a server that decodes them without a limit uses much time or memory."""
_BIG = b'{"name":"' + b"x" * 3_000_000 + b'"}'


def _shapes(route: Route, plan: Planned) -> Iterator[tuple[str, Shape]]:
    """Yield (name, shape) for each attack on a route."""
    right = Shape(plan.content)
    yield "the right request, twice", replace(right, manner=Manner.TWICE)
    yield "the right request, half closed", replace(right, manner=Manner.HALF_CLOSED)
    yield "the right request, answer unread", replace(right, manner=Manner.UNREAD)
    yield "a long query", replace(right, query="&".join(f"tag.in=a{n},b" for n in range(700)))
    yield "sort by many keys", replace(right, query="limit=1000&count=exact&q=%25_%25&sort=" + ",".join(["-id"] * 90))
    yield "many headers", replace(right, headers={f"X-{n}": "y" * 20 for n in range(300)})
    yield (
        "odd headers",
        replace(
            right, headers={"Accept": "*/*;q=0," * 900, "If-None-Match": '"a",' * 900, "Range": "bytes=" + "0-1," * 400}
        ),
    )
    if route.operation.body is None:
        yield "a body where none belongs", Shape(b"[" * 4_000, {"Content-Type": _JSON})
        return
    yield "the right request, slowly", replace(right, manner=Manner.SLOWLY)
    yield (
        "the right request in chunks",
        replace(right, chunked=b"".join(b"1\r\n%c\r\n" % byte for byte in plan.content)),
    )
    yield "a broken chunk", replace(right, chunked=b"ffffffffffffffff\r\n" + plan.content)
    yield "a length of a terabyte", replace(right, announced=1 << 40)
    yield "a body of 3 MB", Shape(_BIG, {"Content-Type": _JSON})
    for name, (media_type, content) in _BODIES.items():
        encoding = {"Content-Encoding": "gzip"} if "compressed" in name else {}
        yield name, Shape(content, {"Content-Type": media_type, **encoding})


def _bytes_of(plan: Planned, shape: Shape, token: str | None) -> bytes:
    path = plan.path + (("&" if "?" in plan.path else "?") + shape.query if shape.query else "")
    headers = {"Host": "marey", "Connection": "close", **plan.headers, **shape.headers}
    if token is not None:
        headers["Authorization"] = f"Bearer {token}"
    content = shape.content
    if shape.chunked is not None:
        headers["Transfer-Encoding"] = "chunked"
        content = shape.chunked + b"0\r\n\r\n"
    elif content or shape.announced is not None:
        headers["Content-Length"] = str(len(content) if shape.announced is None else shape.announced)
    lines = [f"{plan.method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items())]
    return "\r\n".join([*lines, "", ""]).encode() + content


def shots(
    house: House, people: Iterable[str] = tuple(PEOPLE), *, routes: Callable[[Route], bool] = lambda _route: True
) -> list[Shot]:
    """Return every attack on every route by each of the callers.

    Attacks that may make a credential invalid are last.
    """
    found = []
    for route in sorted(filter(routes, ROUTES), key=lambda route: route.template.endswith(ENDS_CREDENTIALS)):
        plan = house.plan(route)
        for attack, shape in _shapes(route, plan):
            for name in people:
                refusal = verdict(PEOPLE[name], route.operation)
                label = f"{route.operation.method} {route.template}"
                found.append(Shot(label, name, attack, plan, shape, house.tokens[name], refusal))
    return found


def some(every: list[Shot], count: int, seed: int) -> list[Shot]:
    """Return about `count` of the attacks, in their order.

    For each route and attack, at most one caller is drawn at random.
    """
    chance = random.Random(seed)
    by_attack: dict[tuple[str, str], list[int]] = {}
    for number, shot in enumerate(every):
        by_attack.setdefault((shot.route, shot.attack), []).append(number)
    chosen = [chance.choice(numbers) for numbers in by_attack.values()]
    must = {number for number in chosen if chance.random() < count / len(chosen)}
    return [every[number] for number in sorted(must)]


async def fire(address: str, shot: Shot) -> Outcome:
    """Send an attacking request, and return its outcome."""
    start = time.monotonic()
    head = ""
    try:
        async with asyncio.timeout(HANGS_S):
            for _ in range(2 if shot.manner is Manner.TWICE else 1):
                head = await _exchange(address, shot)
    except TimeoutError:
        return Outcome(shot, None, time.monotonic() - start, hangs=True)
    except OSError:  # refused, reset or closed while bytes were sent
        return Outcome(shot, None, time.monotonic() - start)
    words = head.split(None, 2)
    status = int(words[1]) if len(words) > 1 and words[1].isdigit() else None
    return Outcome(shot, status, time.monotonic() - start, head)


async def _exchange(address: str, shot: Shot) -> str:
    """Send the bytes and return the head of the answer."""
    place = urlsplit(address)
    reader, writer = await asyncio.open_connection(place.hostname, place.port)
    try:
        await _send(writer, shot)
        if shot.manner is Manner.UNREAD:
            return ""
        return await _read(reader)
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def _send(writer: asyncio.StreamWriter, shot: Shot) -> None:
    data = shot.data
    with contextlib.suppress(ConnectionError):  # refused early: the answer may be there
        if shot.manner is Manner.SLOWLY:
            for piece in (data[:-9], data[-9:-1], data[-1:]):
                writer.write(piece)
                await writer.drain()
                await asyncio.sleep(0.05)
            return
        writer.write(data * 6 if shot.manner is Manner.UNREAD else data)
        await writer.drain()
        if shot.manner is Manner.HALF_CLOSED:
            writer.write_eof()


async def _read(reader: asyncio.StreamReader) -> str:
    """Read the whole answer, and return its head."""
    head = b""
    with contextlib.suppress(ConnectionError):
        with contextlib.suppress(asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            head = await reader.readuntil(b"\r\n\r\n")
        while await reader.read(1 << 20):
            pass
    return head.decode("latin-1")


async def fire_all(address: str, every: Iterable[Shot], at_once: int) -> list[Outcome]:
    """Send attacking requests over `at_once` connections at the same time; return their outcomes."""
    waiting = iter(every)
    outcomes: list[Outcome] = []

    async def fire_next() -> None:
        outcomes.extend([await fire(address, shot) for shot in waiting])

    await asyncio.gather(*(fire_next() for _ in range(at_once)))
    return outcomes
