"""Schedules: jobs that the server submits at the times of a cron expression."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from pydantic import Field, StringConstraints

from marey_schemas.base import Answer, Request
from marey_schemas.names import SLUG, Message, form
from marey_schemas.queue.jobs import JobCreate

MAX_CRON_LENGTH = 100
MAX_TIMEZONE_LENGTH = 64

ScheduleName = Annotated[str, StringConstraints(pattern=SLUG)]
"""Name of a schedule: lower-case letters, digits, `-` and `_`; the name is part of URLs."""

Cron = Annotated[
    str,
    Field(
        min_length=9,
        max_length=MAX_CRON_LENGTH,
        pattern=form(r"^[0-9A-Za-z*,/# -]+$", "be five fields of a cron expression, such as 0 3 * * 1-5"),
        description="Times as five fields: minute, hour, day of the month, month, day of the week. `0 3 * * 1-5` means "
        "3:00 from Monday to Friday.",
    ),
]

TimeZoneName = Annotated[
    str,
    Field(
        min_length=1,
        max_length=MAX_TIMEZONE_LENGTH,
        description="Time zone of the times, such as `Europe/Berlin`. A time that is skipped when clocks are put "
        "forward is replaced by the time after the gap.",
    ),
]

Overlapping = Annotated[
    bool,
    Field(
        description="Whether a job is submitted even if the previous job of the schedule has not ended. False: "
        "the schedule then skips this time."
    ),
]


class ScheduleCreate(Request):
    """Request to create a schedule.

    The server submits the jobs as the user who created the schedule, with the scopes of the token of this request.
    """

    name: ScheduleName
    cron: Cron
    timezone: TimeZoneName = "UTC"
    job: JobCreate = Field(
        description="The job to submit. Its inputs are pinned to their newest revisions at each submission."
    )
    overlapping: Overlapping = False
    paused: bool = False
    description: Message = ""


class ScheduleChange(Request):
    """Request to change a schedule; absent fields stay as they are.

    After a change, the server submits jobs as the user who made the change, unless the change only pauses the schedule
    or changes its description. A user who resumes the schedule becomes the user on whose behalf jobs are submitted.
    """

    cron: Cron | None = None
    timezone: TimeZoneName | None = None
    job: JobCreate | None = None
    overlapping: Overlapping | None = None
    paused: bool | None = None
    description: Message | None = None


class Schedule(Answer):
    """Schedule of a project: a job, and the times at which the server submits it."""

    name: str
    project: str
    cron: str
    timezone: str
    job: dict[str, Any] = Field(description="The job that is submitted, as in the request.")
    overlapping: bool
    paused: bool
    description: str
    author: str | None = Field(description="Name of the user on whose behalf the server submits the jobs.")
    created_at: datetime
    updated_at: datetime
    next_at: datetime | None = Field(
        description="Time of the next submission; null: the schedule is paused, or the time is being computed."
    )
    last_at: datetime | None = Field(
        None,
        description="Time at which the schedule last submitted a job, skipped a time, or was refused; null: not yet.",
    )
    last_job: str | None = Field(
        None, description="Id of the job that was submitted last; it may be deleted already. Null: none was submitted."
    )
    problem: str | None = Field(
        None,
        description="Reason why the last job was not submitted, or why the schedule is paused; null: there is none.",
    )
    rev: int
