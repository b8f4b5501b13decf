"""Schedules of a project, which submit jobs at certain times."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from marey_client.arguments import checked, checks_arguments
from marey_client.jobs import Jobs
from marey_client.paging import pages
from marey_client.transport import Transport, as_json, named_path, read_model, sends_nothing
from marey_schemas.queue.jobs import Job, JobCreate
from marey_schemas.queue.schedules import Schedule, ScheduleChange, ScheduleCreate


@checks_arguments
@dataclass(frozen=True)
class Schedules:
    """Schedules of a project, each of which submits a job at the times of a cron expression."""

    transport: Transport
    project: str

    @property
    def url(self) -> str:
        """The path of the schedules, relative to the API's root."""
        return f"/projects/{self.project}/schedules"

    def create(
        self,
        name: str,
        cron: str,
        job: JobCreate,
        *,
        timezone: str = "UTC",
        overlapping: bool = False,
        paused: bool = False,
        description: str = "",
    ) -> Schedule:
        """Create a schedule that submits `job` at the times of a cron expression, such as "0 3 * * 1-5".

        A schedule that is created paused submits nothing until it is resumed.

        Raises `Conflict` if the name is taken or the project has too many schedules, and `Invalid` if the expression,
        the time zone or the job is not valid.
        """
        request = checked(ScheduleCreate,
            name=name, cron=cron, job=job, timezone=timezone, overlapping=overlapping, paused=paused,
            description=description,
        )  # fmt: skip
        return self.transport.post(Schedule, self.url, request)

    def list(self) -> Iterator[Schedule]:
        """List the schedules by name."""
        return pages(self.transport, Schedule, self.url)

    @sends_nothing
    def at(self, name: str) -> ScheduleHandle:
        """Return a handle of the schedule with this name; no request is sent."""
        return ScheduleHandle(self.transport, self.project, named_path(self.url, name))


@checks_arguments
@dataclass(frozen=True)
class ScheduleHandle:
    """Handle of a schedule; requests are sent only by its methods."""

    transport: Transport
    project: str
    url: str

    def read(self) -> Schedule:
        """Return the schedule with its next time, its last job, and the reason if the last job was not submitted."""
        return self.transport.get(Schedule, self.url)

    def change(self, change: ScheduleChange) -> Schedule:
        """Change, pause or resume the schedule; fields that are None stay as they are."""
        return read_model(Schedule, self.transport.send("PATCH", self.url, content=as_json(change)))

    def run(self) -> Job:
        """Submit the job of the schedule now, as the caller; the times of the schedule stay as they are."""
        return Jobs(self.transport).submit(self.project, JobCreate.model_validate(self.read().job))

    def delete(self) -> None:
        """Delete the schedule; its jobs remain."""
        self.transport.send("DELETE", self.url)
