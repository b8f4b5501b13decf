"""Rule: plain English in docstrings, messages, help texts, names and pages (see CONTRIBUTING, "Language")."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from lint.sources import House, Module, Offence

PHRASES = {
    r"\b(?:tells?|told|telling)\b": "say, show, report or state",
    r"\b(?:stands?|stood) (?:in|at|under|below|above|behind|beside|there|here|before|with|without)\b": "is, or exists",
    r"\bas (?:it|they) stands?\b": "as it is",
    r"\banew\b": "again",
    r"\bgone by\b": "used, or past",
    r"\b(?:becomes?|became|become) of\b": "happens to, or the result of",
    r"(?<!by\s)\bhand(?:s|ed|ing)? in\b": "submit, or send",
    r"\blast word\b": "final answer",
    r"\btwins?\b": "mirrored copy",
    r"\bmade[- ]up\b(?! of)": "synthetic",
    r"\bwhoever\b": "the user, the client or the caller that is meant",
    r"\bmend(?:s|ed|ing)?\b": "correct, or repair",
    r"\b(?:go|goes|going|gone) away\b": "has closed the connection, or has ended",
    r"\b(?:no|make|makes|making) room\b": "no space, or free space",
    r"\bmade to do harm\b": "malicious",
}  # fmt: skip
"""Phrases that are hard to understand, as regular expressions, each with plain words that replace it."""

OLD_NAMES = {
    "settling": "propagation",
    "verdicts": "failure",
    "earlier_answer": "stored_answer",
    "keeper": "heartbeats",
    "kept": "lru",
    "standing": "lookup",
    "arranging": "organise",
    "covering": "coverage",
    "rigged": "skeleton_cache",
    "carrying": "root_carrier",
    "given_files": "json_files",
    "Allowance": "ComputeBudget",
    "Wish": "TrajectoryArrays",
    "Rules": "ControllerConstants",
    "Playback": "DatabaseArrays",
    "Guide": "Trajectory",
    "twin": "mirrored_copy",
    "made_up": "synthetic",
}
"""Names of modules, classes and functions that are no longer used, and the names that replace them."""

_CLAUSE = re.compile(r"(?:What|How|Where|Which)\b(?!.*\?)")
# A phrase may be divided between two lines.
_PHRASES = [(re.compile(phrase.replace(" ", r"\s+"), re.I), instead) for phrase, instead in PHRASES.items()]
_CODE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def find(house: House) -> Iterator[Offence]:
    """Yield the texts and names that are not plain English."""
    for module in house.modules.values():
        yield from _in_module(module)
    for path, text in house.pages.items():
        yield from _in_page(path, text)


def _in_module(module: Module) -> Iterator[Offence]:
    if (leaf := module.name.rpartition(".")[2]) in OLD_NAMES:
        yield Offence(module.path, 1, leaf, f"module {leaf} is called {OLD_NAMES[leaf]} now")
    for name, node in module.definitions:
        if node.name in OLD_NAMES:
            yield Offence(module.path, node.lineno, name, f"{name} is called {OLD_NAMES[node.name]} now")
    for part in module.nodes:
        match part:
            case ast.Expr(value=ast.Constant(value=str(text))) if _CLAUSE.match(text.lstrip()):
                first = text.lstrip().splitlines()[0]
                message = f"a docstring opens with a verb or a noun, not with a clause: {first!r}"
                yield Offence(module.path, part.lineno, first, message)
        if isinstance(part, ast.Constant) and isinstance(part.value, str) and " " in part.value:
            yield from _phrases(module.path, part.lineno, part.value)


def _in_page(path: Path, text: str) -> Iterator[Offence]:
    prose = _CODE.sub(lambda block: "\n" * block[0].count("\n"), text)
    yield from _phrases(path, 1, prose)


def _phrases(path: Path, first_line: int, text: str) -> Iterator[Offence]:
    for phrase, instead in _PHRASES:
        for match in phrase.finditer(text):
            line = first_line + text.count("\n", 0, match.start())
            yield Offence(path, line, match[0], f"{match[0]!r}: write {instead}")
