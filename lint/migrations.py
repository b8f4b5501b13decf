"""Rule: a migration of the phase `before` only adds, because servers of the earlier version go on using the database.

Such a migration may create tables and indexes, and add columns that are null or have a default in the database. A new
index of an existing table must not be unique, because earlier servers may store equal values. Other SQL may only set
or reset storage parameters of tables. Downgrades are not checked.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Container, Iterator, Mapping
from pathlib import PurePath

from lint.sources import House, Offence

PHASES = ("before", "stopped", "after")
"""Phases that `marey_server.store.database.schema` knows."""
ADDING = ("create_table", "create_index", "add_column", "execute", "get_context")
"""Operations of Alembic that an additive migration may use; the arguments of some are checked."""
HARMLESS_SQL = re.compile(r"\s*ALTER\s+TABLE\s+\S+\s+(RE)?SET\s*\([^;]*\)\s*;?\s*", re.IGNORECASE)

Fault = tuple[ast.AST, str]


def find(house: House) -> Iterator[Offence]:
    """Yield the places of additive migrations that do more than add."""
    for path, text in house.users.items():
        if PurePath(path).parts[-3:-1] != ("migrations", "versions"):
            continue
        tree = ast.parse(text)
        phase = _phase_of(tree)
        if not phase:
            message = 'the phase cannot be read; assign the text itself to it, as in `phase = "before"`'
            yield Offence(path, 1, path.stem, message)
        elif phase not in PHASES:
            yield Offence(path, 1, path.stem, f"the phase {phase!r} is unknown; the phases are {', '.join(PHASES)}")
        elif phase == "before":
            for place, reason in _faults(tree):
                message = f"{reason}; declare the phase `stopped` or `after`, or only add"
                yield Offence(path, getattr(place, "lineno", 1), path.stem, message)


def _phase_of(tree: ast.Module) -> str:
    """Return the phase that a migration declares, by default `stopped`; empty if this declaration is not a text."""
    names = (node for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
    is_declared = any(node.id == "phase" for node in names)
    return _texts(tree).get("phase", "" if is_declared else "stopped")


def _texts(tree: ast.Module) -> dict[str, str]:
    """Return the texts that a module assigns to names."""
    found: dict[str, str] = {}
    for node in tree.body:
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            found |= {target.id: node.value.value for target in targets if isinstance(target, ast.Name)}
    return found


def _faults(tree: ast.Module) -> Iterator[Fault]:
    applied = [node for node in tree.body if not (isinstance(node, ast.FunctionDef) and node.name == "downgrade")]
    nodes = [node for part in applied for node in ast.walk(part)]
    operations = [node for node in nodes if _operation(node)]
    calls = [node for node in nodes if isinstance(node, ast.Call) and _operation(node.func)]
    created = {_argument(call, 0, "table_name") for call in calls if _operation(call.func) == "create_table"}
    created.discard("")
    for node in operations:
        if _operation(node) not in ADDING:
            yield node, f"`op.{_operation(node)}` does more than add"
    yield from _hidden_operations(nodes)
    texts = _texts(tree)
    for call in calls:
        if reason := _fault_of(call, created, texts):
            yield call, reason


def _hidden_operations(nodes: list[ast.AST]) -> Iterator[Fault]:
    """Yield the places where operations may have other names than `op.NAME`, or where SQL is executed without them."""
    seen = {id(node.value) for node in nodes if isinstance(node, ast.Attribute)}
    dialects = {id(node.value) for node in nodes if isinstance(node, ast.Attribute) and node.attr == "dialect"}
    for node in nodes:
        match node:
            case ast.Import(names=names) if any(name.name.startswith("alembic") for name in names):
                yield node, "Alembic is not imported as `from alembic import op`"
            case ast.ImportFrom(module=str(module), names=names) if module.startswith("alembic"):
                if [(name.name, name.asname) for name in names] != [("op", None)]:
                    yield node, "Alembic is not imported as `from alembic import op`"
            case ast.Name(id="op") if id(node) not in seen:
                yield node, "`op` is used without naming the operation"
            case ast.Call(func=func) if _operation(func) == "get_context" and id(node) not in dialects:
                yield node, "`op.get_context()` is used for more than its dialect"


def _fault_of(call: ast.Call, created: Container[str], texts: Mapping[str, str]) -> str:
    """Return what is wrong with an allowed operation; `created` are the tables that the migration creates."""
    name = _operation(call.func)
    if name == "create_index" and _argument(call, 1, "table_name") not in created and _is_set(call, "unique"):
        return "a unique index narrows a table that exists already"
    if name == "add_column":
        return _fault_of_column(call)
    return _fault_of_sql(call, texts) if name == "execute" else ""


def _operation(node: ast.AST) -> str:
    """Return the name of an operation of Alembic, such as `add_column`; empty for other nodes."""
    is_operation = isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "op"
    return node.attr if is_operation and isinstance(node, ast.Attribute) else ""


def _argument(call: ast.Call, position: int, name: str) -> str:
    """Return the text of the source of an argument; empty if it is missing."""
    given = [one.value for one in call.keywords if one.arg == name] or call.args[position : position + 1]
    return ast.unparse(given[0]) if given else ""


def _is_set(call: ast.Call, name: str, but_for: str = "False") -> bool:
    """Return whether a call has the keyword argument `name`, with a value other than `but_for`."""
    return any(one.arg == name and ast.unparse(one.value) != but_for for one in call.keywords)


def _fault_of_column(call: ast.Call) -> str:
    """Return what is wrong with an added column; empty if earlier servers can still insert rows without this column."""
    columns = [one for one in ast.walk(call) if isinstance(one, ast.Call) and ast.unparse(one.func).endswith("Column")]
    if len(columns) != 1:
        return "the added column cannot be checked, because it is not written as `sa.Column(...)` in the call"
    (column,) = columns
    may_be_null = not any(one.arg == "nullable" and ast.unparse(one.value) != "True" for one in column.keywords)
    if not may_be_null and not _is_set(column, "server_default", "None"):
        return "the added column may not be null and has no default in the database"
    if any(_is_set(column, name) for name in ("unique", "primary_key")):
        return "an added column that must be unique narrows the table"
    return ""


def _fault_of_sql(call: ast.Call, texts: Mapping[str, str]) -> str:
    """Return what is wrong with executed SQL; empty if it only sets or resets storage parameters."""
    given = call.args[0] if call.args else None
    if isinstance(given, ast.JoinedStr):
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in given.values)
    elif isinstance(given, ast.Constant):
        text = str(given.value)
    else:
        text = texts.get(ast.unparse(given), "") if given is not None else ""
    if HARMLESS_SQL.fullmatch(text):
        return ""
    return "the SQL does more than set storage parameters, or cannot be read where it is executed"
