"""Counterparts of `marey_client.handles.schedules` for async programs.

Written by `make docs` from that module; change it there.
"""

from __future__ import annotations

from collections.abc import AsyncIterator

from marey_client.asynchronous.counterparts import Counterpart, counterpart_of
from marey_client.handles.schedules import ScheduleHandle, Schedules
from marey_schemas.queue.jobs import Job, JobCreate
from marey_schemas.queue.schedules import Schedule, ScheduleChange


@counterpart_of(Schedules)
class AsyncSchedules(Counterpart):
    """Schedules of a project, each of which submits a job at the times of a cron expression."""

    _sync: Schedules

    @property
    def project(self) -> str:
        return self._sync.project

    @property
    def url(self) -> str:
        """The path of the schedules, relative to the API's root."""
        return self._sync.url

    async def create(
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
        return await self._run(
            self._sync.create,
            name,
            cron,
            job,
            timezone=timezone,
            overlapping=overlapping,
            paused=paused,
            description=description,
        )

    def list(self) -> AsyncIterator[Schedule]:
        """List the schedules by name."""
        return self._each(self._sync.list)

    def at(self, name: str) -> AsyncScheduleHandle:
        """Return a handle of the schedule with this name; no request is sent."""
        exchanged: AsyncScheduleHandle = self._now(self._sync.at, name)
        return exchanged


@counterpart_of(ScheduleHandle)
class AsyncScheduleHandle(Counterpart):
    """Handle of a schedule; requests are sent only by its methods."""

    _sync: ScheduleHandle

    @property
    def project(self) -> str:
        return self._sync.project

    @property
    def url(self) -> str:
        return self._sync.url

    async def read(self) -> Schedule:
        """Return the schedule with its next time, its last job, and the reason if the last job was not submitted."""
        return await self._run(self._sync.read)

    async def change(self, change: ScheduleChange) -> Schedule:
        """Change, pause or resume the schedule; fields that are None stay as they are."""
        return await self._run(self._sync.change, change)

    async def run(self) -> Job:
        """Submit the job of the schedule now, as the caller; the times of the schedule stay as they are."""
        return await self._run(self._sync.run)

    async def delete(self) -> None:
        """Delete the schedule; its jobs remain."""
        await self._run(self._sync.delete)
