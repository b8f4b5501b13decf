"""Rule: a module of fewer than 60 lines is imported by at least two modules; otherwise it belongs in its importer."""

from __future__ import annotations

from collections.abc import Iterator

from lint.sources import House, Offence

FEWEST_LINES = 60
FEWEST_IMPORTERS = 2


def find(house: House) -> Iterator[Offence]:
    """Yield the small modules with fewer than two importers."""
    for name, module in house.modules.items():
        importers = house.importers[name]
        if module.is_package or module.lines >= FEWEST_LINES or len(importers) >= FEWEST_IMPORTERS:
            continue
        place = f"only by {min(importers)}" if importers else "by no module"
        yield Offence(module.path, 1, name, f"{module.lines} lines, imported {place}; merge it")
