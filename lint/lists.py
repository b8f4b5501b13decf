"""Rule: a list of known words is written once: formats, roles, kinds and states are declared in `marey_schemas`."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from lint.sources import House, Offence

FEWEST_WORDS = 3


def find(house: House) -> Iterator[Offence]:
    """Yield literal collections that repeat words of a vocabulary, except in the module that declares the words."""
    vocabularies = dict(_vocabularies(house))
    for module in house.modules.values():
        for node in ast.walk(module.tree):
            words = _words(node)
            if not isinstance(node, ast.expr) or len(words) < FEWEST_WORDS:
                continue
            for (home, name), known in vocabularies.items():
                if home != module.name and words <= known:
                    subject = f"{module.name}: {', '.join(sorted(words))}"
                    message = f"{', '.join(sorted(words))} are words of {home}.{name}; derive the list from it"
                    yield Offence(module.path, node.lineno, subject, message)


def _vocabularies(house: House) -> Iterator[tuple[tuple[str, str], set[str]]]:
    """Yield every enumeration of texts in the schemas: module and name, then the words."""
    for module in house.modules.values():
        if not module.name.startswith("marey_schemas"):
            continue
        for name, node in module.definitions:
            if isinstance(node, ast.ClassDef) and any(_is_enum(base) for base in node.bases):
                words = {
                    one.value.value
                    for one in node.body
                    if isinstance(one, ast.Assign) and isinstance(one.value, ast.Constant)
                }
                yield (module.name, name), {word for word in words if isinstance(word, str)}


def _is_enum(base: ast.expr) -> bool:
    return isinstance(base, ast.Name) and base.id in ("StrEnum", "Enum")


def _words(node: ast.AST) -> set[str]:
    """Return the elements of a literal list, tuple or set if all of them are texts; otherwise an empty set."""
    if not isinstance(node, ast.List | ast.Tuple | ast.Set) or not node.elts:
        return set()
    words = {one.value for one in node.elts if isinstance(one, ast.Constant) and isinstance(one.value, str)}
    return words if len(words) == len(node.elts) else set()
