"""Rule: no module imports itself through other modules. Imports in functions and imports only for types count, too."""

from __future__ import annotations

from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter

from lint.sources import House, Offence


def find(house: House) -> Iterator[Offence]:
    """Yield one circular chain of imports, within a package or through several, if there is any."""
    try:
        TopologicalSorter({name: sorted(house.imports[name]) for name in sorted(house.modules)}).prepare()
    except CycleError as error:
        circle = list(reversed(error.args[1][1:]))
        first = circle.index(min(circle))
        circle = [*circle[first:], *circle[:first], circle[first]]
        message = f"modules import each other: {' -> '.join(circle)}"
        yield Offence(house.modules[circle[0]].path, 1, circle[0], message)
