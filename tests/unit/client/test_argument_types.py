"""Arguments of the SDK of a wrong type: every public method names the argument, what it takes, and what it got."""

import asyncio
import importlib
import inspect
from collections.abc import Callable, Iterator
from types import FunctionType
from typing import Any

import numpy as np
import pytest
from docs.sdk_source import Sdk
from tests.support.scripted_server import ScriptedServer

import marey
from marey_client import embedded
from marey_client.arguments import Parameters, checks_arguments
from marey_client.asynchronous.marey import AsyncMarey
from marey_client.errors import BadArgument, MissingPackage
from marey_client.poses.windows import MotionWindows
from marey_schemas.kinds import Kind


class Nonsense:
    """No function of the SDK takes it."""


def public_functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield the functions of the SDK that take arguments, by name."""
    for full_name in sorted(Sdk().reachable):
        module, _, name = full_name.rpartition(".")
        owner = getattr(importlib.import_module(module), name)
        if isinstance(owner, type):
            for method, function in vars(owner).items():
                public = not method.startswith("_") or method == "__getitem__"
                own = isinstance(function, FunctionType) and function.__module__ == module
                if public and own and len(inspect.signature(function).parameters) > 1:
                    yield f"{full_name}.{method}", function
    yield "marey.connect", marey.connect
    yield "marey.Marey", marey.Marey.__init__
    yield "marey.MotionWindows", MotionWindows.__init__
    yield "marey.MotionWindows.split", MotionWindows.split


FUNCTIONS = dict(public_functions())


def test_the_public_functions_are_those_of_the_reference() -> None:
    assert len(FUNCTIONS) > 200
    assert {"marey_client.items.Items.list", "marey_client.marey.Marey.project"} < set(FUNCTIONS)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_argument_of_a_wrong_type_is_named(name: str) -> None:
    function: Any = FUNCTIONS[name]
    types = Parameters(inspect.unwrap(function)).types
    for parameter in inspect.signature(function).parameters.values():
        wanted = types.get(parameter.name)
        if parameter.name == "self" or wanted in (Any, object) or str(wanted).startswith(("*", "typing.Unpack")):
            continue  # the keywords of options are checked by their models
        key = "unknown" if parameter.kind is inspect.Parameter.VAR_KEYWORD else parameter.name
        with pytest.raises(BadArgument, match=rf"^{key}: give .*, not <.*Nonsense.* \(Nonsense\)$"):
            function(*(None for one in types if one == "self"), **{key: Nonsense()})


class Numbers:
    """What a function may be given."""

    @checks_arguments
    def take(
        self,
        name: str = "",
        count: int | None = None,
        share: float = 1.0,
        names: "str | list[str]" = "",
        kind: Kind = Kind.CLIP,
        *,
        shares: "dict[str, float] | None" = None,
    ) -> str:
        """Return that the arguments fit."""
        return "taken"


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"name": 5}, "name: give a str, not 5 (int)"),
        ({"name": None}, "name: give a str, not None"),
        ({"count": "5"}, "count: give an int or None, not '5' (str)"),
        ({"count": True}, "count: give an int or None, not True (bool)"),
        ({"count": 2.0}, "count: give an int or None, not 2.0 (float)"),
        ({"share": "half"}, "share: give a float, not 'half' (str)"),
        ({"names": ["a", 5]}, "names[1]: give a str, not 5 (int)"),
        ({"names": 5}, "names: give a str or a list of str, not 5 (int)"),
        ({"shares": {"train": "0.8"}}, "shares['train']: give a float, not '0.8' (str)"),
        ({"shares": [0.8]}, "shares: give a dict or None, not [0.8] (list)"),
        ({"share": np.zeros((3, 4))}, "share: give a float, not an array of shape (3, 4) (ndarray)"),
        ({"name": b"x" * 100}, f"name: give a str, not b'{'x' * 55}... (bytes)"),
    ],
)
def test_the_reason_tells_what_is_taken_and_what_was_given(arguments: dict[str, Any], reason: str) -> None:
    with pytest.raises(BadArgument) as refused:
        Numbers().take(**arguments)
    assert str(refused.value) == reason


@pytest.mark.parametrize(
    "arguments",
    [
        {"count": np.int64(5), "share": np.float32(0.5)},
        {"share": 1, "names": ["a", "b"], "kind": "clip"},
        {"shares": {"train": 1}},
    ],
)
def test_numbers_of_numpy_and_texts_of_choices_fit(arguments: dict[str, Any]) -> None:
    assert Numbers().take(**arguments) == "taken"


def test_missing_and_unknown_arguments_are_left_to_python() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'nam'"):
        Numbers().take(nam="x")  # pyrefly: ignore[unexpected-keyword]


def test_all_types_are_known_but_those_of_the_options_of_exports() -> None:
    unread = {name for name, one in FUNCTIONS.items() if _lacks_a_type(inspect.unwrap(one))}
    exports = ("export_files", "export_huggingface", "export_lerobot")  # the keywords of each are checked by its model
    assert unread == {f"marey_client.handles.versions.DatasetHandle.{name}" for name in exports}


def _lacks_a_type(function: Any) -> bool:
    try:
        inspect.get_annotations(function, eval_str=True)
    except NameError:
        return True
    return False


def test_the_async_client_refuses_the_same(script: ScriptedServer) -> None:
    async def program() -> None:
        async with AsyncMarey("http://marey.test", http=script.transport()) as client:
            with pytest.raises(BadArgument, match=r"^name: give a str, not 5 \(int\)$"):
                client.project(5)  # pyrefly: ignore[bad-argument-type]
            with pytest.raises(BadArgument, match=r"^item_id: give a str, not 5 \(int\)$"):
                await client.project("lab").clips.get(5)  # pyrefly: ignore[bad-argument-type]

    asyncio.run(program())
    assert script.requests == []


def test_times_of_an_audit_log_are_datetimes(script: ScriptedServer) -> None:
    options: Any = {"since": "yesterday"}
    with pytest.raises(BadArgument, match=r"^since: give a datetime or None, not 'yesterday'$"):
        list(script.marey().audit(**options))


def test_a_package_that_a_command_misses_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also a package that the server imports only when it starts."""

    def lacks_tornado(**_settings: Any) -> None:
        raise ModuleNotFoundError("No module named 'tornado'", name="tornado")

    monkeypatch.setattr("marey_server.commands.serve", lacks_tornado)
    with pytest.raises(MissingPackage, match=r"the package tornado, .* run: pip install 'marey\[server\]'"):
        embedded.serve()
