"""Comparisons for tests, computed from invented runs as the server computes them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from marey_schemas.queue.comparisons import Curve, RunComparison
from marey_server.motions.run_comparison import Compared, compare_read
from marey_server.store.scripts.comparing import RunToCompare

START = datetime(2026, 5, 1, tzinfo=UTC)


def a_run(
    number: int,
    values: Mapping[str, Any],
    fields: Mapping[str, Any],
    *,
    seed: int = 0,
    inputs: Mapping[str, str] | None = None,
    commit: str = "a" * 40,
) -> RunToCompare:
    """Return an invented run; runs with equal values and inputs have one setting."""
    return RunToCompare(
        job=f"job_{number:04}",
        commit=commit,
        seed=seed,
        created_at=START + timedelta(minutes=number),
        setting=repr((commit, sorted(values.items()), sorted((inputs or {}).items()))),
        inputs=dict(inputs or {}),
        values=dict(values),
        fields=dict(fields),
        curves_blob=f"curves-{number}",
    )


def compared_of(
    runs: Iterable[RunToCompare], curves: Mapping[int, Mapping[str, Curve]] | None = None, **wanted: Any
) -> RunComparison:
    """Return the comparison of runs; `curves` has the curves of runs by their number."""
    order = Compared(**dict[str, Any](sort="created_at", limit=100, curves=True) | wanted)
    files = {f"curves-{number}": own for number, own in (curves or {}).items()}
    return compare_read("train", list(runs), files, order, complete=True)


def a_curve(values: Iterable[float | None], every: int = 1) -> Curve:
    """Return a curve with a value at every n-th step."""
    known = tuple(values)
    return Curve(steps=tuple(range(0, every * len(known), every)), values=known, logged=len(known))
