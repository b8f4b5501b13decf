"""Rule: a folder has at most 25 modules, so that a reader finds a module by looking."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from lint.sources import House, Offence

MOST_MODULES = 25


def find(house: House) -> Iterator[Offence]:
    """Yield the folders with too many modules."""
    counts = Counter(module.path.parent for module in house.modules.values() if not module.is_package)
    for folder, count in sorted(counts.items()):
        if count > MOST_MODULES:
            yield Offence(
                folder, 1, folder.name, f"{count} modules, more than {MOST_MODULES}; divide them into folders"
            )
