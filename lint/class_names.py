"""Rule: the name of a class is unique in all packages together."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Iterator

from lint.sources import House, Module, Offence


def find(house: House) -> Iterator[Offence]:
    """Yield the classes that have the same name as another class."""
    found: dict[str, list[tuple[Module, int]]] = defaultdict(list)
    for module in house.modules.values():
        for _, node in module.definitions:
            if isinstance(node, ast.ClassDef):
                found[node.name].append((module, node.lineno))
    for name, places in sorted(found.items()):
        for module, line in places[1:]:
            first, first_line = places[0]
            yield Offence(
                module.path, line, name, f"class {name} is also in {first.name}, line {first_line}; rename one"
            )
