"""Rule: a function has at most 40 lines, without its signature, and a module at most 400; docstrings do not count.

A line of text in a page has at most 120 characters; tables, code and addresses of links may be longer.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

from lint.sources import Definition, House, Offence

MOST_LINES_OF_FUNCTION = 40
MOST_LINES_OF_MODULE = 400
MOST_CHARACTERS = 120
_MAY_BE_LONG = re.compile(r"\||\[[^\]]+\]: ")
"""Beginning of a row of a table, or of the address of a link."""


def find(house: House) -> Iterator[Offence]:
    """Yield the functions and modules that have too many lines, and the lines of pages that are too long."""
    for module in house.modules.values():
        documented = [node for _, node in module.definitions]
        lines = module.lines - sum(docstring_lines(node) for node in (module.tree, *documented))
        if lines > MOST_LINES_OF_MODULE:
            message = f"{lines} lines, more than {MOST_LINES_OF_MODULE}; split it"
            yield Offence(module.path, 1, module.name, message)
        for name, node in module.definitions:
            if isinstance(node, ast.ClassDef):
                continue
            lines = body_lines(node)
            if lines > MOST_LINES_OF_FUNCTION:
                message = f"{name} has {lines} lines, more than {MOST_LINES_OF_FUNCTION}; split it"
                yield Offence(module.path, node.lineno, f"{module.name}.{name}", message)

    for path, text in house.pages.items():
        in_code = False
        for number, line in enumerate(text.splitlines(), 1):
            in_code ^= line.lstrip().startswith("```")
            if len(line) > MOST_CHARACTERS and not in_code and not _MAY_BE_LONG.match(line):
                message = f"the line has {len(line)} characters, more than {MOST_CHARACTERS}; wrap it"
                yield Offence(path, number, path.name, message)


def docstring_lines(node: Definition | ast.Module) -> int:
    """Return the number of lines of a docstring, 0 if there is none."""
    if ast.get_docstring(node, clean=False) is None:
        return 0
    return (node.body[0].end_lineno or 0) - node.body[0].lineno + 1


def body_lines(node: Definition) -> int:
    """Return the number of lines of a definition after its docstring."""
    body = node.body[1:] if ast.get_docstring(node, clean=False) is not None else node.body
    return (node.end_lineno or 0) - body[0].lineno + 1 if body else 0
