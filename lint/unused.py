"""Rule: tests are not the only users of any code: other code of the product names all that a module defines.

The rule covers functions, classes, methods and the variables of modules. It compares only names: a method counts as
used if any code names an attribute like this method. Names in benchmarks and in code of the docs count, too; words in
the text of the docs do not. A local function counts as used only if its name occurs in the function that contains it.
Generated modules do not count: they name every method of the SDK.
"""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator

from lint.sources import Definition, House, Module, Offence, statements_in

Function = ast.FunctionDef | ast.AsyncFunctionDef

_WORD = re.compile(r"[A-Za-z_]\w*")
_CODE = re.compile(r"^\s*```.*?^\s*```|`[^`]+`", re.MULTILINE | re.DOTALL)
# Called by a framework: Tornado, pydantic, logging, SQLAlchemy, httpx.
_CALLED_BY_NAME = {
    "get", "head", "post", "put", "patch", "delete", "options", "initialize", "prepare", "data_received", "on_finish",
    "on_connection_close", "decode_argument",
    "write_error", "log_exception", "set_default_headers", "compute_etag", "find_handler",
    "emit", "format", "formatTime", "formatException", "filter", "convert", "run", "gather", "process_bind_param",
    "process_result_value", "auth_flow", "settings_customise_sources",
}  # fmt: skip
_ENTRY_DECORATORS = {"command", "callback", "validator", "field_validator", "model_validator", "listens_for", "reads"}
_ENTRY_DECORATORS |= {"writes", "overload", "field_serializer", "model_serializer", "compiles", "register"}


def find(house: House) -> Iterator[Offence]:
    """Yield the definitions that no code except tests names."""
    named = _named(house)
    for module in _written_by_hand(house):
        for name, node in module.definitions:
            if not (named[node.name] or _is_entry(node) or is_of_format(module, node)):
                yield Offence(
                    module.path,
                    node.lineno,
                    f"{module.name}.{name}",
                    f"{name} is used by tests only, or by nothing; remove it",
                )
            if not isinstance(node, ast.ClassDef):
                yield from _unused_locals(module, name, node)
        for variables in _variables(module.tree):
            if not any(named[variable.id] for variable in variables):
                variable = variables[0]
                subject = f"{module.name}.{variable.id}"
                yield Offence(
                    module.path,
                    variable.lineno,
                    subject,
                    f"{variable.id} is used by tests only, or by nothing; remove it",
                )


def _variables(tree: ast.Module) -> Iterator[list[ast.Name]]:
    """Yield the names of each assignment of a module; `A, B = 0, 1` numbers things, and uses both or none.

    Names such as `__all__` are left out.
    """
    for statement in tree.body:
        if isinstance(statement, ast.Assign | ast.AnnAssign):
            names = [node for node in ast.walk(statement) if isinstance(node, ast.Name)]
            if assigned := [one for one in names if isinstance(one.ctx, ast.Store) and not one.id.startswith("__")]:
                yield assigned


def _unused_locals(module: Module, name: str, outer: Function) -> Iterator[Offence]:
    """Yield the local functions of `outer` that `outer` does not name."""
    inner = list(_locals(outer))
    named = {node.id for node in ast.walk(outer) if isinstance(node, ast.Name)} if inner else set()
    for node in inner:
        if node.name not in named and not node.decorator_list:
            yield Offence(
                module.path, node.lineno, f"{module.name}.{name}.{node.name}", f"{node.name} is not used; remove it"
            )


def _locals(node: ast.AST) -> Iterator[Function]:
    """Yield the functions that are defined directly in a function, not those inside a local function or local class."""
    for child in statements_in(node):
        if isinstance(child, Function):
            yield child
        elif not isinstance(child, ast.ClassDef):
            yield from _locals(child)


def _is_entry(node: Definition) -> bool:
    """Return whether a framework calls a definition, so that no code names it."""
    if (node.name.startswith("__") and node.name.endswith("__")) or node.name in _CALLED_BY_NAME:
        return True
    return any(
        isinstance(part, ast.Name | ast.Attribute) and _last_name(part) in _ENTRY_DECORATORS
        for decorator in node.decorator_list
        for part in ast.walk(decorator)
    )


def is_of_format(module: Module, node: Definition) -> bool:
    """Return whether a definition is the reader or writer of a file format, looked up by the name of its module."""
    folder, _, name = module.name.rpartition(".")
    return folder == "marey_motion.formats" and node.name in (f"read_{name}", f"write_{name}")


def _written_by_hand(house: House) -> Iterator[Module]:
    return (module for module in house.modules.values() if not module.is_generated)


def _named(house: House) -> Counter[str]:
    """Return how often each name is used, other than in its definition and in imports of it."""
    named: Counter[str] = Counter()
    for module in _written_by_hand(house):
        named.update(_mentions(module))
    code = [block for text in house.pages.values() for block in _CODE.findall(text)]
    for text in (*code, *house.users.values()):
        named.update(_WORD.findall(text))
    return named


def _mentions(module: Module) -> Iterator[str]:
    for node in module.nodes:
        if isinstance(node, ast.Name | ast.Attribute):
            if not isinstance(node.ctx, ast.Store):
                yield _last_name(node)
        elif isinstance(node, ast.keyword) and node.arg:
            yield node.arg
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
            yield node.value
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and re.fullmatch(r"[\w.:]+", node.value):
            yield from _WORD.findall(node.value)
        elif isinstance(node, ast.ImportFrom) and module.is_package:
            yield from (alias.name for alias in node.names)


def _last_name(node: ast.Name | ast.Attribute) -> str:
    return node.id if isinstance(node, ast.Name) else node.attr
