"""Leader election among server processes, by a row with a lease and a fence.

The fence is a number that each new leader increases.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import case, or_, select, update

from marey_server.store.tables import leader
from marey_server.store.transaction import Transaction


@dataclass(frozen=True)
class Lead:
    """Leadership of the process `holder` for the task `name`; `fence` is the number of this leadership."""

    name: str
    holder: str
    fence: int


def take_lead(tx: Transaction, name: str, holder: str, ttl_us: int) -> int | None:
    """Become or stay the leader for the task `name`, for `ttl_us` microseconds.

    Returns the fence (a number that each new leader increases), or None if another process is the leader.
    """
    free = or_(leader.c.holder == holder, leader.c.expires_us <= tx.now_us)
    renewed = tx.execute(
        update(leader)
        .where(leader.c.name == name, free)
        .values(
            holder=holder,
            expires_us=tx.now_us + ttl_us,
            fence=leader.c.fence + case((leader.c.holder == holder, 0), else_=1),
        )
        .returning(leader.c.fence)
    ).scalar_one_or_none()
    if renewed is not None:
        return int(renewed)
    first = {"name": name, "holder": holder, "fence": 1, "expires_us": tx.now_us + ttl_us}
    made = tx.execute(tx.insert_or_ignore(leader, first).returning(leader.c.fence)).scalar_one_or_none()
    return None if made is None else int(made)


def holds_lead(tx: Transaction, lead: Lead) -> bool:
    """Return whether this process still leads; if so, nobody else can take the lead until the transaction ends."""
    which = (leader.c.name == lead.name, leader.c.holder == lead.holder, leader.c.fence == lead.fence)
    return tx.execute(select(leader.c.fence).where(*which).with_for_update(read=True)).first() is not None


def give_up_lead(tx: Transaction, name: str, holder: str) -> None:
    """End the leadership, so that another process can take it at once."""
    tx.execute(update(leader).where(leader.c.name == name, leader.c.holder == holder).values(expires_us=tx.now_us))
