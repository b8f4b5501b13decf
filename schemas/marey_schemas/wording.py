"""Numbers of things in sentences for people."""

from __future__ import annotations


def counted(number: int, noun: str) -> str:
    """`number` with its noun, which takes an s unless there is exactly one: "1 frame", "103,568 frames"."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"
