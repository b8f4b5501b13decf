"""Measured costs per job, clip and byte, with the date and the machine of the measurement.

`measured_costs.toml` in this folder is the only place of these numbers. `marey bench costs` measures those of jobs.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from marey_schemas.wording import without_prefix
from marey_server.capacity.simulation import QueueCosts, RequestCosts

MEASURED = Path(__file__).with_name("measured_costs.toml")


class UnusableCosts(Exception):
    """A file of costs cannot be read; the text gives the place and the reason."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class JobCosts(_Table):
    """Costs of one job without its computation.

    `busy_s` is the time for which a job occupies a server process that many workers use; `claim_s` and `complete_s` are
    the durations of the two requests of a worker that is alone.
    """

    claim_s: float = Field(gt=0)
    complete_s: float = Field(gt=0)
    busy_s: float = Field(gt=0)
    database_s: float = Field(ge=0, description="Processor time of a Postgres database for one job, in seconds.")
    database_bytes: float = Field(ge=0)

    def in_queue(self) -> QueueCosts:
        """Return the costs for a simulation: the occupied time is divided in proportion to the durations."""
        whole_s = self.claim_s + self.complete_s
        busy_s = min(self.busy_s, whole_s)

        def request(duration_s: float) -> RequestCosts:
            part_s = busy_s * duration_s / whole_s
            return RequestCosts(part_s, duration_s - part_s)

        return QueueCosts(request(self.claim_s), request(self.complete_s))


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
    load: str = Field(description="How busy the machine was with other programs.")
    job: JobCosts
    clip: ClipCosts
    byte: ByteCosts

    @classmethod
    def read(cls, path: Path = MEASURED) -> Self:
        """Read a file of costs. Raises `UnusableCosts`, with the place of the fault."""
        try:
            return cls.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            raise UnusableCosts(f"{path}: {where}: {without_prefix(first['msg'])}") from error
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise UnusableCosts(f"{path}: {error}") from error
