"""Numbers of things, and lists of them, in sentences for people."""

from __future__ import annotations

from collections.abc import Sequence


def counted(number: int, noun: str) -> str:
    """`number` with its noun, which takes an s unless there is exactly one: "1 frame", "103,568 frames"."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"


def one_of(names: Sequence[str]) -> str:
    """List the names of a choice: "bvh, npz or json"."""
    return " or ".join(filter(None, (", ".join(names[:-1]), names[-1])))
