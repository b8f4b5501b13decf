"""Rule: a constant is declared once, so no two modules give the same name the same value.

Leading underscores of names do not count. `1 << 20`, `1048576` and `1024 * KIB` are the same value, if the module also
declares `KIB = 1024`.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from operator import add, floordiv, lshift, mul, sub, truediv
from typing import Any

from lint.sources import House, Module, Offence

_CALCULATIONS: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: add, ast.Sub: sub, ast.Mult: mul, ast.Div: truediv, ast.FloorDiv: floordiv, ast.Pow: pow,
    ast.LShift: lshift,
}  # fmt: skip


def find(house: House) -> Iterator[Offence]:
    """Yield the constants that another module declares with the same name and the same value."""
    found: dict[tuple[str, str], list[tuple[Module, int]]] = defaultdict(list)
    for module in house.modules.values():
        for name, value, line in _constants(module.tree):
            found[name.strip("_"), value].append((module, line))
    for (name, value), places in sorted(found.items()):
        for module, line in places[1:]:
            first, first_line = places[0]
            message = f"{name} = {value} is also in {first.name}, line {first_line}; import it, or name what differs"
            yield Offence(module.path, line, f"{module.name}.{name}", message)


def _constants(tree: ast.Module) -> Iterator[tuple[str, str, int]]:
    """Yield name, value and line of each constant: a name in capitals with a literal or calculated value."""
    numbers: dict[str, Any] = {}
    for node in tree.body:
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            for name, value in _pairs(target, node.value):
                if isinstance(name, ast.Name) and name.id.isupper() and (known := _value(value, numbers)):
                    numbers[name.id] = _number(value, numbers)
                    yield name.id, known, node.lineno


def _pairs(target: ast.expr, value: ast.expr) -> Iterator[tuple[ast.expr, ast.expr]]:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        yield from zip(target.elts, value.elts, strict=True)
    else:
        yield target, value


def _value(node: ast.expr, numbers: Mapping[str, Any]) -> str:
    """Return the value of a literal, or of a calculation with numbers; empty if it is something else."""
    if (number := _number(node, numbers)) is not None:
        return repr(number)
    match node:
        case ast.Name(id=name) if name.isupper():
            return name
        case ast.Call(func=ast.Name(id="frozenset"), args=[elements]):
            return f"frozenset({known})" if (known := _value(elements, numbers)) else ""
    try:
        return repr(ast.literal_eval(node))
    except (ValueError, TypeError):  # TypeError: a list as a key
        return ""


def _number(node: ast.expr, numbers: Mapping[str, Any]) -> Any:
    """Return the number that a literal or a calculation gives; None if it is something else.

    `numbers` are the numbers that the module has declared before, by name.
    """
    match node:
        case ast.Name(id=name):
            return numbers.get(name)
        case ast.Constant(value=int() | float() as number):
            return number
        case ast.UnaryOp(op=ast.USub(), operand=operand) if (number := _number(operand, numbers)) is not None:
            return -number
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _CALCULATIONS:
            pair = _number(left, numbers), _number(right, numbers)
            return None if None in pair else _CALCULATIONS[type(operator)](*pair)
    return None
