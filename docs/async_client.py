"""Modules of the async client, written from the source of the SDK.

Each class that can send requests gets a counterpart of the same name with `Async` before it. Its methods have the
parameters, defaults and docstrings of the original. Type checkers compare the types, because each method passes its
arguments on.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory

from docs.sdk_source import CLIENT, ROOT_CLASS, Definition, Member, Sdk, Source, members

PACKAGE = "marey_client.asynchronous"
PREFIX = "Async"
HEAD = '''"""Counterparts of `{module}` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

'''
CLIENT_DOC = '''"""Client of a Marey server for async programs: its methods are those of `Marey`, and are awaited.

    Tasks, and event loops, may share a client; close it, or use it in an `async with` block.

    Parameters
    ----------
    url, token, retries, timeout_s, http : those of `Marey`
    concurrency : number of calls that run at a time, each in a thread; others wait for their turn. Calls that wait for
        the end of a job are not counted. At most 64
    """'''
CONNECT = '''

def connect_async(url: str | None = None, token: str | TokenFile | None = None) -> AsyncMarey:
    """Return a client of a server for async programs, by default of the server that the command line uses.

    Server and token are found as by `connect`. `AsyncMarey` takes further options. Raises the errors of `connect`.
    """
    return AsyncMarey(url, token)
'''
OF_CONNECTION = {"close", "__enter__", "__exit__"}
"""Methods of `Marey` whose counterparts are written by hand."""


def async_modules() -> dict[Path, str]:
    """Return the text of every generated module of the async client, by its path."""
    sdk = Sdk()
    used = [sdk.sources[module] for module in sorted({name.rpartition(".")[0] for name in sdk.reachable})]
    texts = {_path_of(source): _AsyncModule(sdk, source).text() for source in used}
    for folder in {path.parent for path in texts} - {CLIENT / "asynchronous"}:
        texts[folder / "__init__.py"] = f'"""Counterparts of `marey_client.{folder.name}` for async programs."""\n'
    return _formatted(texts)


def _path_of(source: Source) -> Path:
    return CLIENT.parent / Path(*_async_module(source.module).split(".")).with_suffix(".py")


def _async_module(module: str) -> str:
    return PACKAGE + module.removeprefix("marey_client")


def _async_name(name: str) -> str:
    return f"_{PREFIX}{name[1:]}" if name.startswith("_") else PREFIX + name


class _AsyncModule:
    """Text of one module: the counterparts of the classes and types of a module of the SDK."""

    def __init__(self, sdk: Sdk, source: Source) -> None:
        self._sdk = sdk
        self._source = source
        self._imports: set[str] = set()

    def text(self) -> str:
        """Return the source of the module, with its imports in any order."""
        body = "".join(
            self._class(node) if isinstance(node, ast.ClassDef) else self._alias(name, node)
            for name, node in self._source.definitions.items()
            if f"{self._source.module}.{name}" in self._sdk.reachable
        )
        if self._source.module == "marey_client.marey":
            body += CONNECT
            self._use("TokenFile")
        return HEAD.format(module=self._source.module) + "\n".join(sorted(self._imports)) + "\n" + body

    # -- names ---------------------------------------------------------------------------------------------------------

    def _use(self, name: str) -> str:
        """Import a name that the module of the SDK uses; return the name of its counterpart, if it has one."""
        full_name = self._sdk.resolve(self._source, name)
        module = full_name.rpartition(".")[0]
        if full_name in self._sdk.reachable:
            if module != self._source.module:
                self._imports.add(f"from {_async_module(module)} import {_async_name(name)}")
            return _async_name(name)
        if module.startswith("import "):
            self._imports.add(module)
        elif module != "builtins":
            self._imports.add(f"from {module} import {name}")
        return name

    def _type(self, node: ast.expr) -> str:
        """Return the source of a type, with counterparts in place of classes of the SDK."""
        return ast.unparse(_Renamed(self).visit(deepcopy(node)))

    def _has_counterpart(self, *nodes: ast.AST | None) -> bool:
        """Return whether one of the types needs a counterpart, or may be anything."""
        return any(
            self._sdk.mentions(self._source, node) & self._sdk.reachable
            or ast.unparse(node) in ("Any", "Iterator[Any]")
            for node in nodes
            if node is not None
        )

    # -- definitions ---------------------------------------------------------------------------------------------------

    def _alias(self, name: str, node: Definition) -> str:
        assert not isinstance(node, ast.ClassDef)
        assert node.value is not None
        annotation = f": {self._type(node.annotation)}" if isinstance(node, ast.AnnAssign) else ""
        return f"\n{_async_name(name)}{annotation} = {self._type(node.value)}\n"

    def _class(self, node: ast.ClassDef) -> str:
        is_client = node.name == ROOT_CLASS
        self._imports.add(f"from {PACKAGE}.counterparts import counterpart_of")
        self._imports.add(f"from {self._source.module} import {node.name}")
        doc = CLIENT_DOC if is_client else self._source.text_of(node.body[0])
        generic = any(ast.unparse(base).startswith("Generic[") for base in node.bases)
        lines = [
            "",
            "",
            f"@counterpart_of({node.name})",
            f"class {_async_name(node.name)}({', '.join(self._bases(node))}):",
            f"    {doc}",
            "",
        ]
        if not is_client:
            lines += [f"    _sync: {node.name}{'[Any]' if generic else ''}", ""]
        for member in members(self._source, node):
            if not (is_client and member.name in OF_CONNECTION):
                lines += [*self._member(member), ""]
        return "\n".join(lines)

    def _bases(self, node: ast.ClassDef) -> Iterator[str]:
        ours = [base for base in node.bases if self._has_counterpart(base)]
        others = [base for base in node.bases if base not in ours]
        models = [base for base in others if not ast.unparse(base).startswith("Generic[")]
        if node.name == ROOT_CLASS:
            basis = "Connection"
        elif models:
            basis = "ModelCounterpart"
        else:
            basis = "Counterpart"
        if not ours or models or len(ours) != len(node.bases) or ast.unparse(node.bases[0]).startswith("Generic["):
            self._imports.add(f"from {PACKAGE}.counterparts import {basis}")
            yield basis
        yield from map(self._type, node.bases)

    def _member(self, member: Member) -> Iterator[str]:
        """Yield the lines of the counterpart of a member."""
        if member.is_property:
            yield "    @property"
        asynchronous = not (member.sends_nothing or member.yields or member.name == "__getitem__")
        name = "__aiter__" if member.name == "__iter__" else member.name
        parameters = (
            "self" if member.parameters is None else ast.unparse(_Renamed(self).visit(deepcopy(member.parameters)))
        )
        yield f"    {'async ' if asynchronous else ''}def {name}({parameters}) -> {self._result(member)}:"
        if member.doc is not None:
            yield f"        {member.doc}"
        yield from (f"        {line}" for line in self._body(member))

    def _result(self, member: Member) -> str:
        text = self._type(member.answer)
        if member.name == "__getitem__":
            self._imports.add("from collections.abc import Awaitable")
            return f"Awaitable[{text}]"
        return text

    def _body(self, member: Member) -> Iterator[str]:
        used = f"self._sync.{member.name}"
        passed = _passed_on(member.parameters)
        given = ", ".join([used, *passed])
        exchanged = self._has_counterpart(member.answer, member.parameters)
        typed = f"exchanged: {self._type(member.answer)} ="
        if member.is_property:
            yield from (f"{typed} self._as_async({used})", "return exchanged") if exchanged else (f"return {used}",)
        elif member.sends_nothing:
            yield from (
                (f"{typed} self._now({given})", "return exchanged")
                if exchanged
                else (f"return {used}({', '.join(passed)})",)
            )
        elif member.yields or member.name == "__getitem__":
            yield f"return self.{'_each' if member.yields else '_exchange'}({given})"
        elif ast.unparse(member.answer) == "None":
            yield f"await self.{'_exchange' if exchanged else '_run'}({given})"
        elif exchanged:
            yield from (f"{typed} await self._exchange({given})", "return exchanged")
        else:
            yield f"return await self._run({given})"


class _Renamed(ast.NodeTransformer):
    """Types with counterparts in place of classes of the SDK; functions among them may be async."""

    def __init__(self, module: _AsyncModule) -> None:
        self._module = module

    def visit_Name(self, node: ast.Name) -> ast.expr:
        if node.id != "Iterator":
            return ast.Name(self._module._use(node.id))
        self._module._imports.add("from collections.abc import AsyncIterator")
        return ast.Name("AsyncIterator")

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        self.generic_visit(node)
        if ast.unparse(node.value) == "Callable":
            assert isinstance(node.slice, ast.Tuple)
            result = node.slice.elts[1]
            self._module._imports.add("from collections.abc import Awaitable")
            awaited = ast.Subscript(ast.Name("Awaitable"), result)
            node.slice.elts[1] = ast.BinOp(awaited, ast.BitOr(), result)
        return node

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """Rename the name that a type variable gets as a text."""
        if isinstance(node.value, str) and node.value in self._module._source.definitions:
            return ast.Constant(self._module._use(node.value))
        return node


def _passed_on(given: ast.arguments | None) -> list[str]:
    """Return the arguments of a call that passes the parameters of a method on."""
    if given is None:
        return []
    parts = [one.arg for one in (*given.posonlyargs, *given.args) if one.arg != "self"]
    parts += [] if given.vararg is None else [f"*{given.vararg.arg}"]
    parts += [f"{one.arg}={one.arg}" for one in given.kwonlyargs]
    parts += [] if given.kwarg is None else [f"**{given.kwarg.arg}"]
    return parts


def _formatted(texts: dict[Path, str]) -> dict[Path, str]:
    """Return the modules as ruff formats them, with sorted imports."""
    with TemporaryDirectory() as folder:
        places = {path: Path(folder) / path.relative_to(CLIENT) for path in texts}
        for path, place in places.items():
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(texts[path], encoding="utf-8")
        ruff = [sys.executable, "-m", "ruff"]
        root = CLIENT.parents[1]
        ours = 'lint.isort.known-first-party=["marey_client", "marey_schemas", "marey_versions"]'
        options = ["--quiet", "--no-cache", "--config", str(root / "pyproject.toml"), "--config", ours, folder]
        for step in (["check", "--select", "I,F401", "--fix"], ["format"]):
            subprocess.run([*ruff, *step, *options], cwd=root, check=True)  # noqa: S603 - ruff of this environment
        return {path: place.read_text("utf-8") for path, place in places.items()}
