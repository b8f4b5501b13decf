"""Times of cron expressions in a time zone."""

from __future__ import annotations

from datetime import datetime
from functools import cache
from zoneinfo import ZoneInfo, available_timezones

from cronsim import CronSim, CronSimError

from marey_schemas.problems import FieldError
from marey_server.errors import InvalidProblem
from marey_server.store.database.clock import datetime_of

_FIELDS = 5


def next_time_us(cron: str, timezone: str, after_us: int) -> int:
    """Return the first time of a cron expression after a time; both are in microseconds since 1970.

    When clocks are put forward, a time in the gap is replaced by the time after the gap, as Debian's cron does. Raises
    `InvalidProblem` if the expression or the name of the time zone is not valid, or if the expression has no time in
    the next 50 years.
    """
    if len(cron.split()) != _FIELDS:  # a sixth field would mean seconds
        raise _invalid("/cron", "A cron expression has five fields: minute, hour, day, month, day of the week.")
    try:
        found: datetime = next(CronSim(cron, datetime_of(after_us).astimezone(_zone(timezone))))
    except CronSimError as error:
        raise _invalid("/cron", f"The cron expression {cron!r} is not valid: {_reason(error)}.") from error
    except StopIteration:
        raise _invalid("/cron", f"The cron expression {cron!r} has no time in the next 50 years.") from None
    return int(found.timestamp()) * 1_000_000


def _zone(name: str) -> ZoneInfo:
    if name not in _names():
        raise _invalid("/timezone", f"There is no time zone {name!r}. Use a name such as `Europe/Berlin` or `UTC`.")
    return ZoneInfo(name)


@cache
def _names() -> set[str]:
    """Return the names of all time zones, without those whose times depend on the machine."""
    return available_timezones() - {"localtime", "Factory"}


def _reason(error: CronSimError) -> str:
    text = str(error)
    return f"{text[:1].lower()}{text[1:]}"


def _invalid(pointer: str, detail: str) -> InvalidProblem:
    return InvalidProblem(detail, errors=[FieldError(pointer=pointer, code="invalid", detail=detail)])
