"""Workers in answers for administrators."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from marey_schemas.base import Answer


class Worker(Answer):
    """Worker that a server knows, from its claims or from the jobs that it runs."""

    name: str
    alive: bool = Field(
        description="Whether the worker may still be active, because it claimed jobs or renewed a lease recently."
    )
    seen_at: datetime = Field(description="Time of the last claim or the last renewal of a lease.")
    running: int = Field(description="Number of attempts that the worker runs.")
    version: str | None = Field(
        None,
        description="Version of Marey that the worker reported to this server; null if it reported no version, "
        "or only to another server.",
    )
    kinds: tuple[str, ...] | None = Field(
        None, description="Kinds of jobs that the worker claims; null if it claims jobs from another server only."
    )
    labels: dict[str, str] | None = Field(
        None, description="Labels of the worker; null if it claims jobs from another server only."
    )
