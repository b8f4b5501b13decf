"""Rule: a list of words is written once: formats, roles, kinds and states are declared in `marey_schemas`.

No list repeats words of an enumeration of the schemas, or all words of a list or `Literal` that another module names.
Single letters are no words: x, y and z are the same everywhere.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator

from lint.sources import House, Offence

FEWEST_WORDS = 3


def find(house: House) -> Iterator[Offence]:
    """Yield literal collections that repeat the words of another module."""
    vocabularies, lists = dict(_vocabularies(house)), dict(_named_lists(house))
    for module in house.modules.values():
        for node in () if module.is_generated else module.nodes:
            words = _words(node)
            if not isinstance(node, ast.expr) or len(words) < FEWEST_WORDS:
                continue
            for (home, name), known in (*vocabularies.items(), *lists.items()):
                if home != module.name and (words == known or (words < known and (home, name) in vocabularies)):
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


def _named_lists(house: House) -> Iterator[tuple[tuple[str, str], set[str]]]:
    """Yield every literal collection and `Literal` to which a module gives a name: module and name, then the words."""
    for module in house.modules.values():
        for node in () if module.is_generated else module.tree.body:
            match node:
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    pass
                case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value):
                    pass
                case _:
                    continue
            match value:
                case ast.Subscript(value=ast.Name(id="Literal"), slice=listed):
                    yield (module.name, name), _words(listed)
                case ast.Call(args=[listed]) | listed:
                    yield (module.name, name), _words(listed)


def _is_enum(base: ast.expr) -> bool:
    return isinstance(base, ast.Name) and base.id in ("StrEnum", "Enum")


def _words(node: ast.AST) -> set[str]:
    """Return the elements of a literal list, tuple or set if all of them are texts; otherwise an empty set."""
    if not isinstance(node, ast.List | ast.Tuple | ast.Set) or not node.elts:
        return set()
    words = {one.value for one in node.elts if isinstance(one, ast.Constant) and isinstance(one.value, str)}
    return words if len(words) == len(node.elts) and any(len(word) > 1 for word in words) else set()
