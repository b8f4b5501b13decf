"""Figures of a load test: percentiles of replicates with their confidence intervals, and the use of the server."""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from marey_client.errors import MareyError
from marey_client.transport import Transport
from marey_schemas.documents.replicates import student_quantile

PERCENTILES = (50, 95, 99)
MOST_REPLICATES = 10
"""Greatest number of replicates at one rate."""


@dataclass(frozen=True)
class Estimate:
    """Mean of the values of several replicates, and half the width of its 95 % confidence interval.

    `margin` is None for a single replicate.
    """

    value: float
    margin: float | None

    @classmethod
    def of(cls, values: Sequence[float]) -> Estimate:
        """Return the estimate from one value of each replicate, of which there must be 1 to `MOST_REPLICATES`."""
        if len(values) == 1:
            return cls(values[0], None)
        margin = student_quantile(len(values) - 1) * statistics.stdev(values) / math.sqrt(len(values))
        return cls(statistics.fmean(values), margin)

    def shown(self, digits: int = 1) -> str:
        """Return the mean as text, followed by "±" and the margin if there is one."""
        margin = "" if self.margin is None else f" ± {self.margin:,.{digits}f}"
        return f"{self.value:,.{digits}f}{margin}"


def percentile(values: Iterable[float], percent: float) -> float:
    """Return a percentile by the nearest-rank method; NaN without values.

    The result is the smallest of the values for which at least `percent` % of the values are not greater.
    """
    ordered = sorted(values)
    return ordered[max(0, math.ceil(len(ordered) * percent / 100) - 1)] if ordered else math.nan


@dataclass(frozen=True)
class Replicate:
    """Measurements of one run at one rate.

    `starts_s` contains, for each started job, the seconds from its planned submission to its start. `errors` contains
    the number of failed requests by kind of request and error code.
    """

    seconds: float
    submitted: int
    completed: int
    starts_s: Sequence[float]
    errors: Mapping[str, int]

    @property
    def cycles_per_s(self) -> float:
        """The number of completed jobs per second."""
        return self.completed / self.seconds


@dataclass(frozen=True)
class RateFigures:
    """Figures of all replicates at one rate of submissions, in jobs per second; times are in milliseconds."""

    rate: float
    submitted: int
    unfinished: int
    cycles_per_s: Estimate
    start_ms: dict[str, Estimate]
    errors: dict[str, int]
    server: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, rate: float, replicates: Sequence[Replicate], server: Mapping[str, float]) -> RateFigures:
        """Return the figures of the replicates at one rate. Percentiles are left out if a replicate started no job."""
        errors: dict[str, int] = {}
        for one in replicates:
            for what, count in one.errors.items():
                errors[what] = errors.get(what, 0) + count
        measured = all(one.starts_s for one in replicates)
        return cls(
            rate,
            sum(one.submitted for one in replicates),
            sum(one.submitted - one.completed for one in replicates),
            Estimate.of([one.cycles_per_s for one in replicates]),
            {
                f"p{percent}": Estimate.of([1e3 * percentile(one.starts_s, percent) for one in replicates])
                for percent in PERCENTILES
                if measured
            },
            errors,
            dict(server),
        )


_SAMPLE = re.compile(r"^(\w+)(?:\{([^}]*)\})? (\S+)", re.MULTILINE)


class ServerUse:
    """Use of processor time and of the database by a server during a test, from its metrics.

    The metrics are those of one server process. Behind a proxy that distributes requests to several processes, the
    results mean little.
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport
        self._first = self._last = self._read()
        self._connections = self._waiting = 0.0

    def sample(self) -> None:
        """Read the metrics, and remember the greatest numbers of connections and waiting calls."""
        self._last = self._read()
        self._connections = max(self._connections, self._last.get("marey_database_connections", 0.0))
        lanes = (value for name, value in self._last.items() if name.startswith('marey_waiting{lane="database'))
        self._waiting = max(self._waiting, sum(lanes))

    def figures(self, jobs: int) -> dict[str, float]:
        """Return processor time and database bytes per job, and the greatest numbers of connections and waiting calls.

        The metric of the database's size may be a minute old, so its growth is exact only for longer tests.
        """
        self.sample()
        grown = {name: self._last.get(name, 0.0) - self._first.get(name, 0.0) for name in self._last}
        return {
            "processor_ms_per_job": 1e3 * grown.get("process_cpu_seconds_total", 0.0) / max(1, jobs),
            "database_bytes_per_job": grown.get("marey_database_bytes", 0.0) / max(1, jobs),
            "most_database_connections": self._connections,
            "most_waiting_calls": self._waiting,
        }

    def _read(self) -> dict[str, float]:
        return read_samples(self._transport.send("GET", f"{self._transport.url}/metrics").text)


def read_samples(text: str) -> dict[str, float]:
    """Return the samples of metrics in the text format of Prometheus, by name and labels.

    Raises `MareyError` if there is none.
    """
    samples = {
        (f"{name}{{{labels}}}" if labels else name): float(value) for name, labels, value in _SAMPLE.findall(text)
    }
    if not samples:
        raise MareyError(
            "the server's answer to GET /metrics contains no metrics; check whether a proxy answers instead of the "
            "server"
        )
    return samples
