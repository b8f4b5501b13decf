"""Checks that public functions of motion document parameters and results: `python -m docs.docstrings`.

Functions of kernel modules take what their callers prepare, and are left out.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "motion" / "marey_motion"
Function = ast.FunctionDef | ast.AsyncFunctionDef
_SECTION = re.compile(r"^(Parameters|Returns|Yields)\n-+\n(.*?)(?=^\w+\n-+\n|\Z)", re.MULTILINE | re.DOTALL)
_NAMES = re.compile(r"^([\w*]+(?:, [\w*]+)*)(?= : |    |$)", re.MULTILINE)


def problems(package: Path = PACKAGE) -> dict[str, str]:
    """Find the public functions that document too little, by name, with the reason."""
    found = {}
    for file in sorted(package.rglob("*.py")):
        if file.stem.endswith(("kernels", "lanes")):
            continue
        module = ".".join(file.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__")
        for name, function in public_functions(ast.parse(file.read_text(encoding="utf-8"))):
            if reason := problem_of(function):
                found[f"{module}.{name}"] = reason
    return found


def public_functions(tree: ast.Module | ast.ClassDef, within: str = "") -> Iterator[tuple[str, Function]]:
    """List the functions and methods without underscore, except properties."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node, f"{within}{node.name}.")
        elif isinstance(node, Function) and not node.name.startswith("_") and not _is_property(node):
            yield f"{within}{node.name}", node


def _is_property(function: Function) -> bool:
    return any(ast.unparse(each).endswith(("property", ".setter")) for each in function.decorator_list)


def problem_of(function: Function) -> str:
    """Describe the first thing that a function's docstring lacks, or nothing."""
    text = ast.get_docstring(function) or ""
    if not text:
        return "has no docstring"
    sections = {match[1]: match[2] for match in _SECTION.finditer(text)}
    listed = re.findall(r"\w+", " ".join(_NAMES.findall(sections.get("Parameters", ""))))
    given = _parameters(function)
    if missing := [name for name in given if name not in listed]:
        return f"does not document {', '.join(missing)}"
    if unknown := [name for name in listed if name not in given]:
        return f"documents {', '.join(unknown)}, which it does not take"
    result = ast.unparse(function.returns) if function.returns else "None"
    if result not in ("None", "NoReturn") and not sections.keys() & {"Returns", "Yields"}:
        return "does not document what it returns"
    return ""


def _parameters(function: Function) -> list[str]:
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs, *filter(None, (given.vararg, given.kwarg))]
    return [each.arg for each in every if each.arg not in ("self", "cls")]


def main() -> int:
    """Report functions that document too little."""
    found = problems()
    sys.stderr.writelines(f"{name} {reason}\n" for name, reason in found.items())
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
