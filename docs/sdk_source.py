"""Classes of the Python SDK, read from its source: what a program can reach from `Marey`, and what sends requests."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

CLIENT = Path(__file__).parents[1] / "client" / "marey_client"
ELSEWHERE = {"archives", "asynchronous", "bridges", "chaos", "cli", "keywords", "load"}
"""Folders of the client without classes of the SDK."""
ROOT_CLASS = "Marey"
CONNECTION = "Transport"
"""Class of the connections; an object that has one can send requests."""

Function = ast.FunctionDef | ast.AsyncFunctionDef
Definition = ast.ClassDef | ast.Assign | ast.AnnAssign


@dataclass
class Source:
    """Module of the client: its definitions, and the statements that import its names."""

    module: str
    text: str
    tree: ast.Module = field(init=False)
    imports: dict[str, str] = field(default_factory=dict, init=False)
    """Module from which each imported name comes; for modules imported as a whole, the whole statement."""
    definitions: dict[str, Definition] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.tree = ast.parse(self.text)
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                self.imports |= {one.asname or one.name: node.module for one in node.names}
            elif isinstance(node, ast.Import):
                self.imports |= {one.asname or one.name: ast.unparse(node) for one in node.names}
        for node in self.tree.body:
            if isinstance(node, ast.ClassDef):
                self.definitions[node.name] = node
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                self.definitions[node.target.id] = node
            elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                self.definitions[node.targets[0].id] = node

    def text_of(self, node: ast.AST) -> str:
        """Return the source of a node."""
        return ast.get_source_segment(self.text, node) or ""


@dataclass(frozen=True)
class Member:
    """Public attribute, property or method of a class."""

    name: str
    node: Function | ast.AnnAssign
    docstring: ast.stmt | None
    source: Source

    @property
    def doc(self) -> str | None:
        """Source of the docstring, with its quotes."""
        return None if self.docstring is None else self.source.text_of(self.docstring)

    @property
    def is_property(self) -> bool:
        """Whether the member is used without parentheses."""
        return isinstance(self.node, ast.AnnAssign) or bool({"property", "cached_property"} & self._decorators)

    @property
    def sends_nothing(self) -> bool:
        """Whether using the member sends no request."""
        return self.is_property or "sends_nothing" in self._decorators

    @property
    def is_constructor(self) -> bool:
        """Whether the method belongs to the class, not to its objects."""
        return bool({"classmethod", "staticmethod"} & self._decorators)

    @property
    def answer(self) -> ast.expr:
        """The type of the attribute, or of the result."""
        found = self.node.annotation if isinstance(self.node, ast.AnnAssign) else self.node.returns
        assert found is not None, f"{self.name} needs a type"
        return found

    @property
    def parameters(self) -> ast.arguments | None:
        """The parameters of a method, also `self`; None for an attribute."""
        return None if isinstance(self.node, ast.AnnAssign) else self.node.args

    @property
    def yields(self) -> bool:
        """Whether the method returns an iterator."""
        return isinstance(self.answer, ast.Subscript) and ast.unparse(self.answer.value) == "Iterator"

    @property
    def _decorators(self) -> set[str]:
        return set() if isinstance(self.node, ast.AnnAssign) else set(map(ast.unparse, self.node.decorator_list))


class Sdk:
    """Definitions of the SDK. A definition is named by its module and its name, such as `marey_client.items.Items`."""

    def __init__(self) -> None:
        files = [path for path in sorted(CLIENT.rglob("*.py")) if path.relative_to(CLIENT).parts[0] not in ELSEWHERE]
        found = [Source(_module_of(path), path.read_text("utf-8")) for path in files]
        self.sources = {one.module: one for one in found}
        self.connected = self._connected()

    def resolve(self, source: Source, name: str) -> str:
        """Return the full name of a name that a module uses."""
        return f"{source.module if name in source.definitions else source.imports.get(name, 'builtins')}.{name}"

    def node_of(self, full_name: str) -> tuple[Source, Definition]:
        """Return the module and the definition with a full name."""
        module, _, name = full_name.rpartition(".")
        return self.sources[module], self.sources[module].definitions[name]

    def mentions(self, source: Source, node: ast.AST) -> set[str]:
        """Return the full names of the connected definitions that a node mentions."""
        return self._names(source, node) & self.connected

    @cached_property
    def reachable(self) -> set[str]:
        """The full names of the connected definitions that programs can reach from `Marey`."""
        waiting, found = [f"marey_client.marey.{ROOT_CLASS}"], set[str]()
        while waiting:
            one = waiting.pop()
            if one not in found:
                found.add(one)
                source, node = self.node_of(one)
                for part in _public_types(source, node):
                    waiting += self.mentions(source, part)
        return found

    def _names(self, source: Source, node: ast.AST) -> set[str]:
        return {self.resolve(source, one.id) for one in ast.walk(node) if isinstance(one, ast.Name)}

    def _connected(self) -> set[str]:
        """Return the full names of classes whose objects can send requests, and of types that need a counterpart.

        Types need a counterpart if they mention such a class, or a function, because functions may be async.
        """
        seed, found = f"marey_client.transport.{CONNECTION}", set[str]()
        while True:
            more = {
                f"{source.module}.{name}"
                for source in self.sources.values()
                for name, node in source.definitions.items()
                if any((found | {seed}) & self._names(source, part) for part in _state_types(node))
                or _is_function(node)
            } - {seed}
            if more == found:
                return found
            found = more


def members(source: Source, node: ast.ClassDef) -> Iterator[Member]:
    """Yield the public members of a class in their order, and its special methods for iteration and lookup."""
    for place, one in enumerate(node.body):
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name):
            following = node.body[place + 1] if place + 1 < len(node.body) else None
            text = following if isinstance(following, ast.Expr) else None
            member = Member(one.target.id, one, text, source)
            types = ast.unparse(one.annotation)
            if not member.name.startswith("_") and types != CONNECTION and not types.startswith("type["):
                yield member
        elif isinstance(one, Function):
            text = one.body[0] if ast.get_docstring(one) is not None else None
            member = Member(one.name, one, text, source)
            public = not one.name.startswith("_") or one.name in ("__iter__", "__getitem__")
            if (public and not member.is_constructor) or (member.sends_nothing and not member.is_property):
                yield member


def _module_of(path: Path) -> str:
    return ".".join(path.relative_to(CLIENT.parent).with_suffix("").parts).removesuffix(".__init__")


def _is_function(node: Definition) -> bool:
    """Return whether a definition is the name of a type of functions."""
    value = None if isinstance(node, ast.ClassDef) else node.value
    return isinstance(value, ast.Subscript) and ast.unparse(value.value) == "Callable"


def _state_types(node: Definition) -> Iterator[ast.AST]:
    """Yield the types that decide what the objects of a class can do: bases, attributes, parameters of `__init__`."""
    if not isinstance(node, ast.ClassDef):
        yield from () if node.value is None else (node.value,)
        return
    yield from node.bases
    for one in node.body:
        if isinstance(one, ast.AnnAssign):
            yield one.annotation
        elif isinstance(one, Function) and one.name == "__init__":
            yield one.args


def _public_types(source: Source, node: Definition) -> Iterator[ast.AST]:
    if not isinstance(node, ast.ClassDef):
        yield from () if node.value is None else (node.value,)
        return
    yield from node.bases
    for member in members(source, node):
        yield member.answer
        yield from () if member.parameters is None else (member.parameters,)
