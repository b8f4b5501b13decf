"""Exceptions to rules: places with their reasons, and counts of texts that are still to be rewritten."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path

from lint.sources import Offence

EXCEPTIONS = Path(__file__).with_name("exceptions.toml")
BASELINE = Path(__file__).with_name("wording.toml")


def read_exceptions(path: Path = EXCEPTIONS) -> dict[str, dict[str, str]]:
    """Return the reasons of exceptions, by rule and subject."""
    return tomllib.loads(path.read_text("utf-8"))


def apply_exceptions(rule: str, offences: Iterable[Offence], reasons: Mapping[str, str]) -> Iterator[Offence]:
    """Yield the offences without an exception, and an offence for each exception that no offence needs.

    The keys of `reasons` are subjects, or patterns of them such as "marey_server.handlers.*".
    """
    unused = set(reasons)
    for offence in offences:
        fitting = {pattern for pattern in reasons if fnmatchcase(offence.subject, pattern)}
        unused -= fitting
        if not fitting:
            yield offence
    for subject in sorted(unused):
        yield Offence(
            EXCEPTIONS,
            line_of(f'"{subject}"', EXCEPTIONS),
            subject,
            f"the exception {rule}.{subject!r} is not needed any more; remove it",
        )


def line_of(beginning: str, path: Path) -> int:
    """Return the number of the first line of a file that begins with a text; 1 if there is none."""
    lines = path.read_text("utf-8").splitlines()
    return next((number for number, line in enumerate(lines, 1) if line.startswith(beginning)), 1)


def read_baseline(path: Path = BASELINE) -> dict[str, int]:
    """Return the number of offences against the wording that each file may have, by path."""
    return tomllib.loads(path.read_text("utf-8")) if path.exists() else {}


def apply_baseline(offences: Iterable[Offence], allowed: Mapping[str, int], root: Path) -> Iterator[Offence]:
    """Yield the offences of files that exceed their counts in `allowed`.

    If a file has fewer offences than its count, an offence about this count is yielded instead.
    """
    by_file: dict[str, list[Offence]] = {}
    for offence in offences:
        by_file.setdefault(shown(offence.path, root), []).append(offence)
    for name in sorted(by_file.keys() | allowed.keys()):
        found, most = by_file.get(name, []), allowed.get(name, 0)
        if len(found) > most:
            yield from found
        elif len(found) < most:
            message = f"{name} has {len(found)} offences, not {most}: run `python -m lint --shrink`"
            yield Offence(BASELINE, line_of(f'"{name}"', BASELINE), name, message)


def shrink_baseline(offences: Iterable[Offence], root: Path, path: Path = BASELINE) -> None:
    """Lower the counts of the baseline to the present numbers of offences.

    The count of a single file may rise, for example after texts have moved to this file, but only if the total of all
    files does not rise.
    """
    allowed = read_baseline(path)
    counts = Counter(shown(offence.path, root) for offence in offences)
    if counts.total() > sum(allowed.values()):
        counts = Counter({name: min(most, counts[name]) for name, most in allowed.items()})
    path.write_text("".join(f'"{name}" = {count}\n' for name, count in sorted(counts.items()) if count), "utf-8")


def shown(path: Path, root: Path) -> str:
    """Return a path for messages: relative to the checkout if the path is in it, with slashes."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.as_posix()
