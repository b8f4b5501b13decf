"""The command `marey` of a server whose pools react within seconds, for tests in which only the order of events counts.

Usually, a pool waits 5 to 60 s: for the end of the lead of a killed server, between two rounds, and after failures.
"""

from __future__ import annotations

import runpy
from functools import partial
from types import ModuleType

from tests.support.server_process import ServerProcess

from marey_schemas.backoff import Backoff
from marey_server.launchers import pool_keeper, rounds
from marey_server.launchers.pool_size import PoolLimits

PAUSES = Backoff(first_s=0.5, longest_s=2.0)


class QuickPoolsServer(ServerProcess):
    """`marey serve` with such pools."""

    def spawn(self, arguments: list[str], environment: dict[str, str], stdin: bytes | None = None) -> None:
        """Start the server from this module."""
        super().spawn([__name__, *arguments[1:]], environment, stdin)


QUICK: tuple[tuple[ModuleType, str, object], ...] = (
    (rounds, "LEAD_TTL_US", 3_000_000),
    (rounds, "FAULT_PAUSES", PAUSES),
    (pool_keeper, "START_PAUSES", PAUSES),
    (pool_keeper, "ROUND_S", 0.5),
    (pool_keeper, "PoolLimits", partial(PoolLimits, grow_after_s=0.5)),
)
"""Modules, and names in them that get other values."""


def quicken() -> None:
    """Shorten the pauses of the pools of this process."""
    for module, name, value in QUICK:
        setattr(module, name, value)


if __name__ == "__main__":
    quicken()
    runpy.run_module("marey_client.cli", run_name="__main__", alter_sys=True)
