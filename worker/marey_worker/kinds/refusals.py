"""What a job of many inputs could not use, and why; the others are made all the same."""

from __future__ import annotations

from pydantic import ValidationError

from marey_motion.errors import MotionError
from marey_schemas.jobs import PinnedInput
from marey_worker.context import Context, NoSuchThing

CODES = {ValidationError: "bad-document", NoSuchThing: "no-clip"}


class Refusals:
    """The inputs that one job refused, in the order met; each is said in the job's log, too."""

    def __init__(self, context: Context) -> None:
        self.entries: list[dict[str, str]] = []
        self._context = context

    def add(
        self, pin: PinnedInput, error: MotionError | ValidationError | NoSuchThing, *, name: str | None = None
    ) -> None:
        """One more; `name` is what its result would have been called, where that is not the input's path."""
        shown = name or pin.path
        code = error.code if isinstance(error, MotionError) else CODES[type(error)]
        self._context.log(f"{shown}: {error}")
        self.entries.append({"name": shown, "item": pin.item, "code": code, "detail": str(error)})

    @property
    def first(self) -> str:
        """The first one, to end a sentence with; nothing where there is none."""
        return f"; {self.entries[0]['name']}: {self.entries[0]['detail']}" if self.entries else ""
