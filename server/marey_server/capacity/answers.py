"""Computations for capacity planning whose results are plain values, such as dictionaries of numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from marey_schemas.validation.reasons import first_reason
from marey_server.capacity.costs import MEASURED, JobCosts, MeasuredCosts, UnusableCosts
from marey_server.capacity.needs import PlannedWork, compute_needs
from marey_server.capacity.simulation import SimulatedJob, simulate

IDLE_STEPS = 20
JOBS_PER_WORKER = 100
"""Number of jobs that a prediction simulates per worker: so many that start and end hardly change the result."""


class NotComputable(Exception):
    """Error of costs or amounts from which nothing can be computed; the text gives the reason."""


def capacity(*, costs: Path | None = None, **demand: Any) -> dict[str, Any]:
    """Return what the processing of planned clips needs: the load of each part of the installation, and bytes to store.

    The result also names the part that is busy first (`first`), and has the number of clips per day at which it is busy
    all the time (`clips_per_day`), the predicted jobs per second of 2, 8 and 32 workers, and the date and machine of
    the measured costs. `costs` is a file of costs, by default that of this package. `demand` contains the fields of
    `PlannedWork`. Raises `NotComputable` if the file or an amount is not valid.
    """
    try:
        measured = MeasuredCosts.read(costs or MEASURED)
        needs = compute_needs(measured, wanted := PlannedWork(**demand))
    except (UnusableCosts, ValueError) as error:
        raise NotComputable(str(error)) from error
    return {
        "demand": vars(wanted),
        "parts": [vars(part) | {"share": part.share} for part in needs.parts],
        "first": needs.first.name,
        "clips_per_day": needs.clips_per_day,
        "blob_bytes": needs.blob_bytes,
        "database_bytes": needs.database_bytes,
        "measured": {"date": measured.date, "machine": measured.machine, "load": measured.load},
        "predicted_jobs_per_s": predict(measured.job.model_dump(), (2, 8, 32), 0.0),
    }


def fit_idle(job: dict[str, float], workers: int, per_s: float, work_s: float, seed: int = 0) -> dict[str, float]:
    """Return `job` with the value of `idle` for which the simulation predicts the measured throughput best.

    `job` contains the fields of `JobCosts`. In the measurement, `workers` workers completed `per_s` jobs per second,
    each with a computation time of `work_s` seconds. Raises `NotComputable` if the costs are not valid.
    """
    candidates = [job | {"idle": step / IDLE_STEPS} for step in range(IDLE_STEPS)]
    return min(candidates, key=lambda costs: abs(predict(costs, (workers,), work_s, seed)[workers] - per_s))


def predict(job: dict[str, float], workers: tuple[int, ...], work_s: float, seed: int = 0) -> dict[int, float]:
    """Return the jobs per second that a simulation predicts for each number of workers in `workers`.

    In the simulation, jobs are always waiting. `job` contains the fields of `JobCosts`; `work_s` is the computation
    time of a job in seconds. Raises `NotComputable` if the fields are not valid.
    """
    try:
        costs = JobCosts.model_validate(job).in_queue()
    except ValidationError as error:
        raise NotComputable(first_reason(error, JobCosts)) from error
    return {
        count: simulate(
            [SimulatedJob(0.0, work_s)] * (JOBS_PER_WORKER * count), [frozenset()] * count, costs, seed=seed
        ).per_s
        for count in workers
    }
