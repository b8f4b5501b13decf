"""Options and output of the commands that show and change quotas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from marey_client.cli.output import print_table

if TYPE_CHECKING:
    from marey_schemas.access import QuotaChange, QuotasInUse

ItemLimit = Annotated[int | None, typer.Option("--items", min=0, help="Set the largest number of items.")]
ByteLimit = Annotated[
    int | None, typer.Option("--stored-bytes", min=0, help="Set the largest number of bytes of all revisions together.")
]
DefaultLimits = Annotated[
    bool, typer.Option("--defaults", help="Use the limits in the server's settings, except for those given here.")
]


def quota_change(items: int | None, stored_bytes: int | None, defaults: bool) -> QuotaChange | None:
    """Return the change that the options request, or None if they request none."""
    from marey_schemas.access import QuotaChange

    given = {"items": items, "stored_bytes": stored_bytes}
    wanted = {name: limit for name, limit in given.items() if defaults or limit is not None}
    return QuotaChange.model_validate(wanted) if wanted else None


def print_quotas(quotas: QuotasInUse) -> None:
    """Print a table of the quotas with their use and limits."""
    rows = [(name.replace("_", " "), quota["used"], quota["allowed"]) for name, quota in quotas.model_dump().items()]
    columns = ("quota", "used", "allowed")
    print_table(columns, [(name, f"{used:,}", f"{allowed:,}") for name, used, allowed in rows], right=columns[1:])
