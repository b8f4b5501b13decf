"""Rule: no module imports itself through other modules. Imports in functions and imports only for types count, too.

A package that loads names lazily imports the modules in its stub.
"""

from __future__ import annotations

from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter

from lint.sources import House, Offence, imported_by, imports_of


def find(house: House) -> Iterator[Offence]:
    """Yield one circular chain of imports, within a package or through several, if there is any."""
    loaded = {name: set(imports_of(stub, house.modules)) - {name} for name, stub in house.stubs.items()}
    imports = {name: sorted(house.imports[name] | loaded.get(name, set())) for name in sorted(house.modules)}
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        circle = list(reversed(error.args[1][1:]))
        first = circle.index(min(circle))
        circle = [*circle[first:], *circle[:first], circle[first]]
        message = f"modules import each other: {' -> '.join(circle)}; move what both ends need into another module"
        sources = [house.modules[circle[0]], *(stub for stub in house.stubs.values() if stub.name == circle[0])]
        yield next(
            Offence(source.path, getattr(node, "lineno", 1), circle[0], message)
            for source in sources
            for node in source.nodes
            if circle[1] in imported_by(node, house.modules)
        )
