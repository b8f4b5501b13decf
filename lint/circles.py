"""Rule: no module imports itself through other modules. Imports in functions and imports only for types count, too."""

from __future__ import annotations

from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter

from lint.sources import House, Offence, imported_by


def find(house: House) -> Iterator[Offence]:
    """Yield one circular chain of imports, within a package or through several, if there is any."""
    try:
        TopologicalSorter({name: sorted(house.imports[name]) for name in sorted(house.modules)}).prepare()
    except CycleError as error:
        circle = list(reversed(error.args[1][1:]))
        first = circle.index(min(circle))
        circle = [*circle[first:], *circle[:first], circle[first]]
        message = f"modules import each other: {' -> '.join(circle)}; move what both ends need into another module"
        module = house.modules[circle[0]]
        imports = (node for node in module.nodes if circle[1] in imported_by(node, house.modules))
        line = next(getattr(node, "lineno", 1) for node in imports)
        yield Offence(module.path, line, circle[0], message)
