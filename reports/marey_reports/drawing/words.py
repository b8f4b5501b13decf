"""Amounts as people say them."""

from __future__ import annotations


def span(low: float, high: float) -> str:
    """A range of numbers, or the one number."""
    return f"{low:.4g}" if f"{low:.4g}" == f"{high:.4g}" else f"{low:.4g} to {high:.4g}"


def amount(count: int, thing: str) -> str:
    """A number of things: one clip, 2 clips, 3 trajectories."""
    if count == 1:
        return f"1 {thing}"
    plural = f"{thing[:-1]}ies" if thing.endswith("y") and thing[-2] not in "aeou" else f"{thing}s"
    return f"{count:,} {plural}"


def duration(seconds: float) -> str:
    """Seconds, or minutes and seconds."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole} s" if whole < 120 else f"{whole // 60} min {whole % 60} s"
