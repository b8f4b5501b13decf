"""`python -m lint.sample --seed N`: draw texts of the project at random, for a reader who did not write them."""

from __future__ import annotations

import argparse
import ast
import random
import sys
from collections.abc import Iterator

from lint.__main__ import ROOT
from lint.exceptions import shown
from lint.sources import Definition, House, Module, read_house

SIZES = {"docstrings": 60, "error texts": 40, "help texts": 20, "pages": 5}
"""Number of texts of each sort in a sample."""


def draw(house: House, seed: int) -> dict[str, list[tuple[str, str]]]:
    """Return random texts with their places, by kind of text. Equal code and an equal seed give equal texts."""
    modules = [house.modules[name] for name in sorted(house.modules)]
    texts = {
        "docstrings": [one for module in modules for one in _docstrings(module)],
        "error texts": [one for module in modules for one in _errors(module)],
        "help texts": [one for module in modules for one in _helps(module)],
        "pages": [(shown(path, ROOT), house.pages[path]) for path in sorted(house.pages)],
    }
    chance = random.Random(seed)  # noqa: S311 - a sample of texts is no secret
    return {sort: chance.sample(found, min(SIZES[sort], len(found))) for sort, found in texts.items()}


def _docstrings(module: Module) -> Iterator[tuple[str, str]]:
    """Yield every docstring, preceded by its context in the code: module, enclosing classes, signature."""
    if text := ast.get_docstring(module.tree):
        yield module.name, text
    introduction = f"In {module.name}: {_first_paragraph(module.tree)}"
    definitions = dict(module.definitions)
    for name, node in module.definitions:
        if text := ast.get_docstring(node):
            parts = name.split(".")
            outside = [definitions[".".join(parts[:depth])] for depth in range(1, len(parts))]
            around = [f"{_head(outer)} {_first_paragraph(outer)}" for outer in outside]
            yield f"{module.name}:{node.lineno}", "\n".join([introduction, *around, _head(node), text])


def _first_paragraph(node: ast.Module | Definition) -> str:
    return " ".join((ast.get_docstring(node) or "").partition("\n\n")[0].split())


def _head(definition: Definition) -> str:
    """Return the first line of a definition: its name, parameters and return type."""
    if isinstance(definition, ast.ClassDef):
        bases = ", ".join(ast.unparse(base) for base in definition.bases)
        return f"class {definition.name}({bases}):" if bases else f"class {definition.name}:"
    answer = f" -> {ast.unparse(definition.returns)}" if definition.returns else ""
    return f"def {definition.name}({ast.unparse(definition.args)}){answer}:"


def _errors(module: Module) -> Iterator[tuple[str, str]]:
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            yield from _sentences(module, node.exc)


def _helps(module: Module) -> Iterator[tuple[str, str]]:
    for node in ast.walk(module.tree):
        if isinstance(node, ast.keyword) and node.arg == "help":
            yield from _sentences(module, node.value)


def _sentences(module: Module, tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield the string literals of several words in an expression; expressions in f-strings appear in braces."""
    if isinstance(tree, ast.JoinedStr | ast.Constant):
        text = "".join(_shown(part) for part in (tree.values if isinstance(tree, ast.JoinedStr) else [tree]))
        if " " in text.strip():
            yield f"{module.name}:{tree.lineno}", text
    else:
        for child in ast.iter_child_nodes(tree):
            yield from _sentences(module, child)


def _shown(part: ast.expr) -> str:
    if isinstance(part, ast.FormattedValue):
        return "{" + ast.unparse(part.value) + "}"
    return part.value if isinstance(part, ast.Constant) and isinstance(part.value, str) else ""


def main() -> None:
    """Print a sample and its seed; without `--seed`, the seed is random."""
    parser = argparse.ArgumentParser(prog="python -m lint.sample", description=__doc__)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(10**6), help="seed of the sample")
    seed = parser.parse_args().seed
    sys.stdout.write(f"seed {seed}\n")
    for sort, found in draw(read_house(ROOT), seed).items():
        sys.stdout.write(f"\n# {len(found)} {sort}\n")
        for place, text in found:
            sys.stdout.write(f"\n[{place}]\n{text}\n")


if __name__ == "__main__":
    main()
