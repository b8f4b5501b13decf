"""Rule: a module of fewer than 60 lines is imported by at least two modules; otherwise it belongs in its importer.

Modules that are loaded by name are left out: those that a text of another module names, such as the function of a job
kind, and those of file formats.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

from lint.sources import House, Module, Offence
from lint.unused import is_of_format

FEWEST_LINES = 60
FEWEST_IMPORTERS = 2


def find(house: House) -> Iterator[Offence]:
    """Yield the small modules with fewer than two importers."""
    loaded = set(_loaded_by_name(house))
    for name, module in house.modules.items():
        importers = house.importers[name]
        if name in loaded or module.is_package or module.lines >= FEWEST_LINES or len(importers) >= FEWEST_IMPORTERS:
            continue
        place = f"only by {min(importers)}" if importers else "by no module"
        yield Offence(module.path, 1, name, f"{module.lines} lines, imported {place}; merge it")


def _loaded_by_name(house: House) -> Iterator[str]:
    """Yield the names of modules that code loads by name: as `module`, as `module:function`, or as a file format."""
    for module in house.modules.values():
        if _is_format(module):
            yield module.name
        for node in module.nodes:
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                name = node.value.partition(":")[0]
                if name != module.name:
                    yield name


def _is_format(module: Module) -> bool:
    return any(is_of_format(module, node) for _, node in module.definitions)
