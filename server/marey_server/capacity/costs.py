"""Measured costs per job, clip and byte, with the date and the machine of the measurement.

The numbers are stored only in `measured_costs.toml` in this folder. `marey bench costs` measures the costs of jobs.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from marey_schemas.validation.reasons import first_reason
from marey_server.capacity.simulation import QueueCosts, RequestCosts

MEASURED = Path(__file__).with_name("measured_costs.toml")


class UnusableCosts(Exception):
    """Error of a file of costs that cannot be read; the text gives the place and the reason."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class JobCosts(_Table):
    """Costs of one job without its computation.

    `claim_s` and `complete_s` are the durations of the two requests of a single worker. `busy_s` is the time per job
    if `crowded` workers keep the server busy all the time. `busy_s` is shorter than the two requests of a single
    worker, because the server commits writes that arrive at the same time together.
    """

    claim_s: float = Field(gt=0)
    complete_s: float = Field(gt=0)
    busy_s: float = Field(gt=0)
    crowded: int = Field(16, ge=3)
    idle: float = Field(0.0, ge=0, lt=1, description="Share of a request's duration that does not occupy the server.")
    variation: float = Field(0.0, ge=0, le=10, description="Standard deviation of request times, divided by the mean.")
    database_s: float = Field(ge=0, description="Processor time of a Postgres database for one job, in seconds.")
    database_bytes: float = Field(ge=0)

    def in_queue(self) -> QueueCosts:
        """Return the costs for a simulation: the time of each request, and the time of each commit.

        Both times are the solution of two equations. With a single worker, a job takes two requests and two commits.
        With `crowded` workers, half of the workers share one commit, while the other half waits for the next commit.
        """
        alone_s = self.claim_s + self.complete_s
        used_s, shared = alone_s * (1 - self.idle), 2 / self.crowded
        commits_s = min(max(0.0, (used_s - self.busy_s) / (1 - shared)), used_s)
        requests_s = max(self.busy_s - commits_s * shared, 0.0)
        return QueueCosts(
            RequestCosts(requests_s * self.claim_s / alone_s, self.claim_s * self.idle),
            RequestCosts(requests_s * self.complete_s / alone_s, self.complete_s * self.idle),
            batch_s=commits_s / 2,
            variation=self.variation,
        )


class ClipCosts(_Table):
    """Costs of one clip: its length, its stored bytes, and seconds of processor time of server and worker."""

    frames: int = Field(gt=0)
    stored_bytes: float = Field(gt=0)
    import_s: float = Field(gt=0)
    worker_s: float = Field(gt=0)


class ByteCosts(_Table):
    """Costs of one byte that a client uploads: processor time of the server."""

    upload_s: float = Field(ge=0)


class MeasuredCosts(_Table):
    """All measured costs, and where they were measured."""

    date: str
    machine: str
    load: str = Field(description="Load of the machine by other programs.")
    job: JobCosts
    clip: ClipCosts
    byte: ByteCosts

    @classmethod
    def read(cls, path: Path = MEASURED) -> Self:
        """Read a file of costs. Raises `UnusableCosts`, with the place of the fault."""
        try:
            return cls.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
        except ValidationError as error:
            raise UnusableCosts(f"{path}: {first_reason(error, cls)}") from error
        except OSError as error:
            raise UnusableCosts(f"{path}: {error.strerror}") from error
        except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise UnusableCosts(f"{path}: {error}") from error
