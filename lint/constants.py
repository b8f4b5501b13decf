"""Rule: a constant is declared once, so no two modules give the same name the same value."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator

from lint.sources import House, Module, Offence


def find(house: House) -> Iterator[Offence]:
    """Yield the constants that another module declares with the same name and the same literal value."""
    found: dict[tuple[str, str], list[tuple[Module, int]]] = defaultdict(list)
    for module in house.modules.values():
        for name, value, line in _constants(module.tree):
            found[name, value].append((module, line))
    for (name, value), places in sorted(found.items()):
        for module, line in places[1:]:
            first, first_line = places[0]
            message = f"{name} = {value} is also in {first.name}, line {first_line}; import it, or name what differs"
            yield Offence(module.path, line, f"{module.name}.{name}", message)


def _constants(tree: ast.Module) -> Iterator[tuple[str, str, int]]:
    """Yield name, value and line of each constant: a name in capitals to which the module assigns a literal value."""
    for node in tree.body:
        if not isinstance(node, ast.Assign):
            continue
        for target in node.targets:
            for name, value in _pairs(target, node.value):
                if isinstance(name, ast.Name) and name.id.isupper() and _is_literal(value):
                    yield name.id, ast.unparse(value), node.lineno


def _pairs(target: ast.expr, value: ast.expr) -> Iterator[tuple[ast.expr, ast.expr]]:
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        yield from zip(target.elts, value.elts, strict=True)
    else:
        yield target, value


def _is_literal(node: ast.expr) -> bool:
    try:
        ast.literal_eval(node)
    except (ValueError, TypeError):  # TypeError: a list as a key
        return False
    return True
