"""Inputs that a job cannot use (refusals), with the reasons; the job still processes its other inputs."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from marey_motion.errors import MotionError
from marey_schemas.queue.jobs import NOTHING_DONE
from marey_schemas.queue.worker_protocol import PinnedInput
from marey_schemas.validation.reasons import first_reason
from marey_schemas.wording import counted
from marey_worker.context import Context, JobRefused, NoSuchThing, Unreadable

UNUSABLE = (MotionError, ValidationError, Unreadable)
"""Errors that concern a single input; the job processes its other inputs."""


def present(pin: PinnedInput, document: Any) -> Any:
    """Return `document`, which was read for the input `pin`, if it is not None.

    Raises `NoSuchThing` if it is None, because the input was deleted while the job waited.
    """
    if document is None:
        raise NoSuchThing(f"revision {pin.revision} of the item {pin.item} no longer exists", f"no-{pin.kind}")
    return document


class Refusals:
    """Refused inputs of a job, in order; each is also written to the job's log."""

    def __init__(self, context: Context) -> None:
        self.entries: list[dict[str, str]] = []
        self._context = context

    def add(
        self, pin: PinnedInput, error: MotionError | ValidationError | Unreadable, *, name: str | None = None
    ) -> None:
        """Add a refused input with its error. Users see `name`, by default the path of the input."""
        shown = name or pin.path
        invalid = isinstance(error, ValidationError)
        code, detail = ("bad-document", first_reason(error)) if invalid else (error.code, str(error))
        self._context.log(f"{shown}: {detail}")
        self.entries.append({"name": shown, "item": pin.item, "code": code, "detail": detail})

    def require_some(self, made: int, count: int, done: str, *, what: str = "clip") -> None:
        """Raise `JobRefused` if the job has refused inputs and made no result.

        `made` is the number of results, `count` the number of inputs. In the message, `done` names the action of the
        job, such as "edited", and `what` names an input, such as "clip". A task of a divided job does not fail, because
        another task may succeed; the server decides about the whole job.
        """
        if self.entries and not made and self._context.task.size == 1:
            raise JobRefused(NOTHING_DONE, f"none of {counted(count, what)} can be {done}{self.first}")

    @property
    def first(self) -> str:
        """The first refusal as the end of a sentence, beginning with a semicolon; empty if there is no refusal."""
        return f"; {self.entries[0]['name']}: {self.entries[0]['detail']}" if self.entries else ""
