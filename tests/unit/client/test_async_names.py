"""The async client has the names, parameters, defaults, types and docstrings of the synchronous one."""

import asyncio
import inspect
import re
import typing
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, assert_type

import numpy as np
import pytest
from docs.async_client import async_modules
from docs.sdk_source import CLIENT
from numpy.typing import NDArray
from tests.support.scripted_server import ScriptedServer

from marey_client.asynchronous.counterparts import COUNTERPARTS
from marey_client.asynchronous.handles.clips import AsyncClipHandle
from marey_client.asynchronous.handles.jobs import AsyncJobHandle
from marey_client.asynchronous.items import AsyncItems
from marey_client.asynchronous.marey import AsyncMarey
from marey_client.asynchronous.project import AsyncProjectHandle
from marey_client.bridges.files import ExportedVersion, FileExportOptions
from marey_client.bridges.version import ExportOptions
from marey_client.errors import BadArgument
from marey_client.handles.jobs import JobHandle
from marey_client.marey import Marey

TYPES_ONLY = {one.__name__: one for one in (ExportedVersion, FileExportOptions, ExportOptions)}
"""Names that modules import only for type checkers."""


def members(kind: type[Any]) -> Iterator[tuple[str, Any]]:
    """Yield the public methods and properties that a class of the client has, with how it is iterated and indexed."""
    for name in dir(kind):
        owner = next(one for one in kind.__mro__ if name in vars(one))
        found = vars(owner)[name]
        public = not name.startswith(("_", "model_")) or name in ("__iter__", "__getitem__")
        if (
            owner.__module__.startswith("marey_client.")
            and public
            and (inspect.isfunction(found) or is_property(found))
        ):
            yield name, found


def is_property(member: Any) -> bool:
    return isinstance(member, property) or type(member) is cached_property


def counterpart_of(counterpart: type[Any], name: str) -> Any:
    return inspect.getattr_static(counterpart, {"__iter__": "__aiter__"}.get(name, name))


def hints_of(member: Any) -> dict[str, Any]:
    function = member.fget if isinstance(member, property) else getattr(member, "func", member)
    return typing.get_type_hints(function, localns=TYPES_ONLY)


def classes_in(kind: Any) -> Iterator[type[Any]]:
    """Yield every class of the client in a type."""
    for one in (kind, typing.get_origin(kind)):
        if isinstance(one, type) and one.__module__.startswith("marey_client."):
            yield one
    for one in typing.get_args(kind):
        yield from classes_in(one)


def reached() -> set[type[Any]]:
    """Return every class of the client whose objects a program gets from `Marey`."""
    waiting, found = [Marey], set[type[Any]]()
    while waiting:
        one = waiting.pop()
        if one not in found:
            found.add(one)
            waiting += [kind for _, member in members(one) for kind in classes_in(hints_of(member)["return"])]
    return found


def can_send(kind: type[Any]) -> bool:
    """Return whether objects of a class are made with a connection, or with an object that has one."""
    texts = [str(one.annotation) for one in inspect.signature(kind).parameters.values()]
    return kind in (Marey, JobHandle) or any(text in ("Transport", "ProjectItems") for text in texts)


def test_every_class_that_a_client_leads_to_has_an_async_counterpart() -> None:
    connected = {kind for kind in reached() if can_send(kind)}
    assert len(connected) > 40
    assert connected - COUNTERPARTS.keys() == set()


@pytest.mark.parametrize("sync", COUNTERPARTS, ids=lambda sync: sync.__name__)
def test_names_parameters_defaults_types_and_docstrings_are_those_of_the_original(sync: type[Any]) -> None:
    for name, member in members(sync):
        if sync is Marey and name == "close":
            continue  # written by hand
        other = counterpart_of(COUNTERPARTS[sync], name)
        assert is_property(other) == is_property(member), name
        assert other.__doc__ == member.__doc__, name
        if not is_property(member):
            assert shape(other) == shape(member), name
        hints, others = hints_of(member), hints_of(other)
        assert hints.keys() == others.keys(), name
        for parameter, kind in hints.items():
            if "Callable[" in str(kind):
                assert "Awaitable[" in str(others[parameter]), (name, parameter)  # functions may be async
            else:
                awaited = name == "__getitem__" and parameter == "return"
                expected = f"collections.abc.Awaitable[{written(kind)}]" if awaited else written(kind)
                assert written(others[parameter]) == expected, (name, parameter)


def shape(function: Any) -> list[tuple[str, Any, Any]]:
    given = inspect.signature(function).parameters.values()
    return [(one.name, one.kind, one.default) for one in given]


def written(kind: Any) -> str:
    """Return a type as text, with the names of the SDK in place of those of its counterparts."""
    plain = isinstance(kind, type) and not typing.get_args(kind)
    text = f"{kind.__module__}.{kind.__qualname__}" if plain else str(kind)
    text = re.sub(r"marey_client\.asynchronous\.([\w.]+)\.(_?)Async(\w+)", r"marey_client.\1.\2\3", text)
    return text.replace("~Async", "~").replace("AsyncIterator", "Iterator")


def test_no_generated_module_is_left_over() -> None:
    written = {path for path in async_modules() if path.name != "__init__.py"}
    found = {path for path in (CLIENT / "asynchronous").rglob("*.py") if "Written by `make docs`" in path.read_text()}
    assert found == written


def test_only_what_sends_a_request_is_awaited(script: ScriptedServer) -> None:
    """Methods that are not awaited work without any answer of the server."""

    async def main() -> None:
        server = AsyncMarey("http://server.test", "marey_secret", http=script.transport())
        lab = server.project("lab")
        assert lab.items(lab.clips.kind).kind is lab.clips.kind
        assert lab.datasets.at("gaits").name == "gaits"
        assert lab.datasets.at("gaits").proposals.at(3).url.endswith("/3")
        assert lab.scripts.at("train").url == "/projects/lab/scripts/train"
        assert lab.schedules.at("nightly").url == "/projects/lab/schedules/nightly"
        assert lab.webhooks.at("hook_1").url == "/projects/lab/webhooks/hook_1"
        await server.close()

    asyncio.run(main())
    assert script.requests == []


def test_type_checkers_know_what_is_returned(script: ScriptedServer) -> None:
    async def typed(lab: AsyncProjectHandle) -> None:
        assert_type(lab.clips, AsyncItems[AsyncClipHandle])
        clip = await lab.clips["walk"]
        assert_type(clip, AsyncClipHandle)
        assert_type(await clip.positions(joints=["Hips"], frames=slice(0, 2)), NDArray[np.float32])
        assert_type(await lab.quality([clip, "raw"], rate_hz=30), AsyncJobHandle)
        assert_type([one async for one in await lab.clips.where("raw")], list[AsyncClipHandle])
        assert_type(await clip.export("files"), Path)

    async def main() -> None:
        async with AsyncMarey("http://server.test", "marey_secret", http=script.transport()) as server:
            lab = server.project("lab")
            with pytest.raises(BadArgument, match="rate"):
                await lab.quality("raw", rate=30)  # pyrefly: ignore[unexpected-keyword]
            script.answers = [ValueError("read first")]
            with pytest.raises(ValueError, match="read first"):
                await typed(lab)

    asyncio.run(main())
