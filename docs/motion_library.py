"""Generates the reference page of the motion library from the docstrings of the library."""

from __future__ import annotations

import ast
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

from lint.docstrings import KERNELS, public_functions

MOTION = Path(__file__).parents[1] / "motion"
PACKAGE = MOTION / "marey_motion"

Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
_HEAD = re.compile(r"^(\w+)\n-+\n", re.MULTILINE)


def library_page() -> str:
    """Return the page: each exported name with its whole docstring, then a table of the functions of each module."""
    text = (
        "# Motion library\n\n"
        "`marey_motion` works on arrays in memory and needs no server. Axes are right-handed with Y up;\n"
        "units are metres, seconds and radians; quaternions are (w, x, y, z). In shapes, F is the number of frames\n"
        "and J the number of joints. To install the library: `pip install 'marey[motion]'`.\n\n"
        "## Exported names\n\n"
    )
    for module, name in exported_names():
        text += _entry(module, name)
    text += "## Modules\n\n"
    for file in sorted(PACKAGE.rglob("*.py")):
        if not file.stem.endswith(KERNELS):
            text += _module(file)
    return text.rstrip() + "\n"


def exported_names() -> list[tuple[str, str]]:
    """Return module and name of everything that the package exports, sorted by name."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    return sorted(
        ((f"marey_motion.{node.module}", alias.name) for node in imports for alias in node.names),
        key=lambda pair: pair[1].lower(),
    )


def _entry(module: str, name: str) -> str:
    definition = _find(module, name)
    text = f"### {name}\n\n```python\n{_signature(definition)}\n```\n\n" + _described(definition)
    if isinstance(definition, ast.ClassDef):
        for method in definition.body:
            if isinstance(method, Definition) and not method.name.startswith("_"):
                first = (ast.get_docstring(method) or "").partition("\n")[0]
                text += f"* `.{method.name}`: {first}\n"
        text = text.rstrip("\n") + "\n\n"
    return text


def _find(module: str, name: str) -> Definition:
    """Return the definition of a name in a module, or in the module from which this module imports the name."""
    tree = ast.parse(_file(module).read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, Definition) and node.name == name:
            return node
        if isinstance(node, ast.ImportFrom) and node.module and name in [alias.name for alias in node.names]:
            return _find(node.module, name)
    raise LookupError(f"{module} does not define {name}")


def _file(module: str) -> Path:
    """Return the file of a module of `marey_motion` or `marey_schemas`."""
    roots = [MOTION, MOTION.parent / "schemas"]
    path = Path(*module.split("."))
    files = [root / each for root in roots for each in (path.with_suffix(".py"), path / "__init__.py")]
    return next(file for file in files if file.is_file())


def _signature(definition: Definition) -> str:
    if isinstance(definition, ast.ClassDef):
        return f"class {definition.name}"
    result = ast.unparse(definition.returns) if definition.returns else "None"
    whole = f"def {definition.name}({ast.unparse(definition.args)}) -> {result}"
    if len(whole) <= 100:
        return whole
    lines = _split(ast.unparse(definition.args))
    return f"def {definition.name}(\n" + "".join(f"    {line},\n" for line in lines) + f") -> {result}"


def _split(arguments: str) -> list[str]:
    """Split the text of an argument list at commas outside brackets."""
    parts, depth, start = [], 0, 0
    for at, letter in enumerate(arguments):
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and depth == 0:
            parts.append(arguments[start:at].strip())
            start = at + 1
    return [*parts, arguments[start:].strip()]


def _described(definition: Definition) -> str:
    """Convert the docstring of a definition to Markdown: paragraphs, a list for each section, examples as code."""
    before, *sections = _HEAD.split(ast.get_docstring(definition) or "")
    text = _paragraphs(before)
    for title, content in zip(sections[::2], sections[1::2], strict=True):
        if title == "Examples":
            text += f"```python\n{content.strip()}\n```\n\n"
        elif title == "Notes":
            text += _paragraphs(content)
        else:
            text += f"{title}:\n\n" + "".join(f"* {_item(line)}\n" for line in _items(content)) + "\n"
    return text


def _paragraphs(text: str) -> str:
    return "".join(f"{' '.join(one.split())}\n\n" for one in text.split("\n\n") if one.strip())


def _items(content: str) -> Iterator[str]:
    """Yield each entry of a docstring section in one line, joined with its continuation lines."""
    for line in textwrap.dedent(content).strip().splitlines():
        if line.startswith(" "):
            continue
        following = content[content.index(line) + len(line) :].splitlines()[1:]
        continued = []
        for each in following:
            if not each.startswith(" "):
                break
            continued.append(each.strip())
        yield " ".join([line, *continued])


def _item(line: str) -> str:
    """Format an entry of a docstring section as name (in code style), type, colon and meaning."""
    head, _, meaning = line.partition("    ")
    name, colon, kind = head.partition(" : ")
    shown = f"`{name}`, {kind}" if colon else f"`{name}`"
    return f"{shown}: {meaning.strip()}" if meaning else shown


def _module(file: Path) -> str:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    name = ".".join(file.relative_to(MOTION).with_suffix("").parts).removesuffix(".__init__")
    functions = list(public_functions(tree))
    if name == "marey_motion" or not functions:
        return ""
    first = " ".join((ast.get_docstring(tree) or "").partition("\n\n")[0].split())
    rows = [f"| `{each}` | {_cell(function)} |\n" for each, function in functions]
    return f"### {name}\n\n{first}\n\n| function | meaning |\n| --- | --- |\n" + "".join(rows) + "\n"


def _cell(function: ast.AST) -> str:
    assert isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef)
    return (ast.get_docstring(function) or "").partition("\n")[0].replace("|", "\\|")
