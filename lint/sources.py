"""The files that rules look at: modules with their syntax trees and imports, and pages of text."""

from __future__ import annotations

import ast
from collections.abc import Container, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

PACKAGES = {
    "schemas": ("marey_schemas",),
    "versions": ("marey_versions",),
    "motion": ("marey_motion",),
    "reports": ("marey_reports",),
    "client": ("marey", "marey_client"),
    "server": ("marey_server",),
    "worker": ("marey_worker",),
}
"""Packages of the product, by the folder that contains them."""

WRITTEN_BY = "Written by `make docs`"
"""Words in pages and modules that are generated from the code."""
GENERATED = f"<!-- {WRITTEN_BY}"
"""Beginning of pages that are generated from texts in the code."""

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
_WITH_STATEMENTS = (ast.stmt, ast.excepthandler, ast.match_case)


class Offence(NamedTuple):
    """Place in the code that breaks a rule. Exceptions refer to it by its `subject`."""

    path: Path
    line: int
    subject: str
    message: str


@dataclass(frozen=True)
class Module:
    """One Python file."""

    name: str
    path: Path
    text: str
    is_package: bool = False

    @cached_property
    def tree(self) -> ast.Module:
        """The syntax tree of the module."""
        return ast.parse(self.text)

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """All nodes of the syntax tree; several rules read them, and searching the tree takes long."""
        return list(ast.walk(self.tree))

    @cached_property
    def lines(self) -> int:
        """The number of lines of the module."""
        return len(self.text.splitlines())

    @cached_property
    def is_generated(self) -> bool:
        """Whether the module is generated from other modules."""
        return WRITTEN_BY in (ast.get_docstring(self.tree) or "")

    @cached_property
    def definitions(self) -> list[tuple[str, Definition]]:
        """Every class and function with its qualified name, nested ones too."""
        return list(_definitions(self.tree, ""))


def _definitions(node: ast.AST, prefix: str) -> Iterator[tuple[str, Definition]]:
    for child in statements_in(node):
        if isinstance(child, Definition):
            yield prefix + child.name, child
            yield from _definitions(child, f"{prefix}{child.name}.")
        else:
            yield from _definitions(child, prefix)


def statements_in(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the statements directly in a node, and the handlers and cases that contain further statements."""
    return (child for child in ast.iter_child_nodes(node) if isinstance(child, _WITH_STATEMENTS))


@dataclass(frozen=True)
class House:
    """Modules of the product by name, pages that people read, and other files that use names of the product."""

    modules: dict[str, Module]
    pages: dict[Path, str] = field(default_factory=dict)
    users: dict[Path, str] = field(default_factory=dict)
    stubs: dict[str, Module] = field(default_factory=dict)
    """Stubs, by the names of the packages that load the names in their stubs lazily."""

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """Imports of each module within the product, including those inside functions and for types only."""
        return {name: set(imports_of(module, self.modules)) - {name} for name, module in self.modules.items()}

    @cached_property
    def importers(self) -> dict[str, set[str]]:
        """Modules of the product that import each module."""
        found: dict[str, set[str]] = {name: set() for name in self.modules}
        for importer, targets in self.imports.items():
            for target in targets:
                found[target].add(importer)
        return found


def imports_of(module: Module, known: Container[str]) -> Iterator[str]:
    """Yield the names of the modules that a module imports and that are in `known`."""
    return (name for node in module.nodes for name in imported_by(node, known))


def imported_by(node: ast.AST, known: Container[str]) -> Iterator[str]:
    """Yield the names of the modules that a statement imports and that are in `known`."""
    if isinstance(node, ast.ImportFrom) and node.module:
        for alias in node.names:
            inner = f"{node.module}.{alias.name}"
            if (target := inner if inner in known else node.module) in known:
                yield target
    elif isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name in known)


def read_house(root: Path) -> House:
    """Return all modules and pages of the product in a checkout, and other files that may use names of the product."""
    modules = [
        read_module(path, root / folder)
        for folder, packages in PACKAGES.items()
        for package in packages
        for path in sorted((root / folder / package).rglob("*.py"))
    ]
    pages = [*sorted((root / "docs").rglob("*.md")), *sorted(root.glob("*.md"))]
    users = [*(root / "docs").rglob("*.py"), *(root / "benchmarks").rglob("*.py"), *(root / "migrations").rglob("*.py")]
    users += [root / "pyproject.toml", root / "Makefile", *root.glob("*/marey_*/__init__.pyi")]
    stubs = [read_stub(path) for path in sorted(root.glob("*/marey*/__init__.pyi"))]
    return House(
        {module.name: module for module in modules},
        {path: text for path in pages if not (text := path.read_text("utf-8")).startswith(GENERATED)},
        {path: path.read_text("utf-8") for path in users if path.is_file()},
        {stub.name: stub for stub in stubs},
    )


def read_module(path: Path, root: Path) -> Module:
    """Return the module in a file; its name follows from its path below `root`."""
    parts = path.relative_to(root).with_suffix("").parts
    is_package = parts[-1] == "__init__"
    return Module(".".join(parts[:-1] if is_package else parts), path, path.read_text("utf-8"), is_package)


def read_stub(path: Path) -> Module:
    """Return the stub of a package, as a module with absolute imports; the stub itself must have relative imports."""
    package = path.parent.name
    text = path.read_text("utf-8").replace("from . ", f"from {package} ").replace("from .", f"from {package}.")
    return Module(package, path, text, is_package=True)
