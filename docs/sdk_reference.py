"""Generates the reference page of the Python SDK from its source: classes, methods, and which methods are awaited."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from docs.sdk_source import ROOT_CLASS, Member, Sdk, Source, members

HEAD = """# Python SDK

Every object that a program gets from `marey.connect()`, with its methods. `marey.connect_async()` gives objects whose
classes have the same names with `Async` before them, and whose methods have the same names, parameters, defaults and
errors. The column "async" says how async programs use a method; empty means like synchronous programs, because no
request is sent. [Work with motion in Python](../how-to/use-python.md) shows how to begin.

"""
SPECIAL = {"__iter__": "iteration", "__getitem__": "[name]"}


def sdk_page() -> str:
    """Return the page: one table for each class."""
    sdk = Sdk()
    found = [sdk.node_of(one) for one in sorted(sdk.reachable)]
    classes = [(source, node) for source, node in found if isinstance(node, ast.ClassDef)]
    classes.sort(key=lambda one: (one[1].name != ROOT_CLASS, one[1].name.lstrip("_")))
    return HEAD + "\n".join("\n".join(_class(sdk, source, node)) for source, node in classes if _is_shown(node))


def _is_shown(node: ast.ClassDef) -> bool:
    return not node.name.startswith("_")


def _class(sdk: Sdk, source: Source, node: ast.ClassDef) -> Iterator[str]:
    yield f"## {node.name}\n"
    yield (ast.get_docstring(node) or "").partition("\n\n")[0] + "\n"
    bases = [base for base in node.bases if sdk.mentions(source, base)]
    inherited = [ast.unparse(base) for base in bases if not ast.unparse(base).startswith("Generic[")]
    every = (member for one in _with_private_bases(sdk, source, node) for member in members(*one))
    shown = [member for member in every if member.doc or member.name in SPECIAL]
    if inherited and not inherited[0].startswith("_"):
        yield f"It has the members of `{inherited[0].partition('[')[0]}`" + (", and:\n" if shown else ".\n")
    if shown:
        yield "| member | async | meaning |\n|---|---|---|"
        yield from map(_row, shown)
        yield ""


def _with_private_bases(sdk: Sdk, source: Source, node: ast.ClassDef) -> Iterator[tuple[Source, ast.ClassDef]]:
    """Yield a class and its bases that are not public, whose members are shown as those of the class."""
    yield source, node
    for base in node.bases:
        if isinstance(base, ast.Name) and base.id.startswith("_"):
            origin, definition = sdk.node_of(sdk.resolve(source, base.id))
            assert isinstance(definition, ast.ClassDef)
            yield from _with_private_bases(sdk, origin, definition)


def _row(member: Member) -> str:
    awaited = "`async for`" if member.yields else "`await`"
    doc = ast.literal_eval(member.doc) if member.doc else ""
    meaning = " ".join(doc.partition("\n\n")[0].split()).replace("|", "\\|")
    return f"| `{_spelled(member)}` | {'' if member.sends_nothing else awaited} | {meaning} |"


def _spelled(member: Member) -> str:
    """Return a member as it is used, without types."""
    if member.parameters is None or member.is_property or member.name in SPECIAL:
        return SPECIAL.get(member.name, member.name)
    given = ast.parse(f"def f({ast.unparse(member.parameters)}): ...").body[0]
    assert isinstance(given, ast.FunctionDef)
    parts = given.args
    for one in (*parts.posonlyargs, *parts.args, *parts.kwonlyargs, *filter(None, (parts.vararg, parts.kwarg))):
        one.annotation = None
    return f"{member.name}({ast.unparse(parts).removeprefix('self').removeprefix(', ')})"
