"""Rule: public functions of the motion library document what they take and return, with shapes, units and frames.

Functions of kernel modules (compiled code) are left out: other functions of the library prepare their arguments. The
rule checks that every parameter has an entry and that there is a section on results; people judge the wording.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from lint.sources import House, Offence

PACKAGE = "marey_motion"
KERNELS = ("kernels", "lanes")
"""Endings of the names of modules with compiled functions."""

Function = ast.FunctionDef | ast.AsyncFunctionDef
_SECTION = re.compile(r"^(Parameters|Returns|Yields)\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", re.MULTILINE | re.DOTALL)
_NAMES = re.compile(r"^([\w*]+(?:, [\w*]+)*)(?= : |    |$)", re.MULTILINE)


def find(house: House) -> Iterator[Offence]:
    """Yield the public functions of the library whose docstrings lack something."""
    for module in house.modules.values():
        if module.name.partition(".")[0] != PACKAGE or module.name.endswith(KERNELS):
            continue
        for name, function in public_functions(module.tree):
            if reason := problem_of(function):
                yield Offence(module.path, function.lineno, f"{module.name}.{name}", f"{name} {reason}")


def public_functions(tree: ast.Module | ast.ClassDef, within: str = "") -> Iterator[tuple[str, Function]]:
    """Yield functions and methods without underscore, except properties and overloads, which only add types."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node, f"{within}{node.name}.")
        elif isinstance(node, Function) and not node.name.startswith("_") and not _is_exempt(node):
            yield f"{within}{node.name}", node


def _is_exempt(function: Function) -> bool:
    return any(ast.unparse(each).endswith(("property", ".setter", "overload")) for each in function.decorator_list)


def problem_of(function: Function) -> str:
    """Return a description of the first thing that a function's docstring lacks; empty if nothing is missing."""
    text = ast.get_docstring(function) or ""
    if not text:
        return "has no docstring; write one"
    sections = {match[1]: match[2] for match in _SECTION.finditer(text)}
    listed = re.findall(r"\w+", " ".join(_NAMES.findall(sections.get("Parameters", ""))))
    given = _parameters(function)
    if missing := [name for name in given if name not in listed]:
        return f"does not document {', '.join(missing)} under Parameters; add the entry"
    if unknown := [name for name in listed if name not in given]:
        return f"documents {', '.join(unknown)}, which it does not take; remove the entry"
    result = ast.unparse(function.returns) if function.returns else "None"
    if result not in ("None", "NoReturn") and not sections.keys() & {"Returns", "Yields"}:
        return "does not document what it returns under Returns; add the section"
    return ""


def _parameters(function: Function) -> list[str]:
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs, *filter(None, (given.vararg, given.kwarg))]
    return [each.arg for each in every if each.arg not in ("self", "cls")]
