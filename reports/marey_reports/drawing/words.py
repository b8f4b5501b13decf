"""Amounts in words."""

from __future__ import annotations


def span(low: float, high: float) -> str:
    """Format a range of numbers as text, or one number if both ends are equal."""
    return f"{low:.4g}" if f"{low:.4g}" == f"{high:.4g}" else f"{low:.4g} to {high:.4g}"


def duration(seconds: float) -> str:
    """Write a duration in seconds, or in minutes and seconds."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    return f"{whole} s" if whole < 120 else f"{whole // 60} min {whole % 60} s"
