"""Limited memory for requests, which clients share."""

from __future__ import annotations

import pytest

from marey_server.errors import UnavailableProblem
from marey_server.process.memory import CLIENT_SHARE, UNKNOWN_SHARE, UNKNOWN_SHARE_EACH, Holding, RequestMemory
from marey_server.store.database.lanes import Client

TOTAL_BYTES = 1600
ANNA = Client("anna")


def strangers(memory: RequestMemory, number: int) -> list[Holding]:
    """Return one request each of strangers with different addresses."""
    return [Holding(memory, Client(f"192.0.2.{one}", known=False), reserved=False) for one in range(number)]


def test_a_stranger_leaves_memory_to_other_strangers_and_all_of_them_to_users() -> None:
    memory = RequestMemory(TOTAL_BYTES)
    user = Holding(memory, ANNA, reserved=False)
    user.grow(1)
    greedy, other, late = strangers(memory, 3)
    greedy.grow(int(UNKNOWN_SHARE_EACH * TOTAL_BYTES))
    with pytest.raises(UnavailableProblem, match="your requests"):
        greedy.grow(1)
    other.grow(int((UNKNOWN_SHARE - UNKNOWN_SHARE_EACH) * TOTAL_BYTES))
    with pytest.raises(UnavailableProblem):
        late.grow(1)
    user.grow(int(CLIENT_SHARE * TOTAL_BYTES) - 1)
    for holding in (greedy, other, late, user):
        holding.release()
    assert memory.held_bytes == 0
    late.grow(TOTAL_BYTES + 1)


def test_bytes_that_a_user_held_do_not_count_while_the_user_is_treated_as_a_stranger() -> None:
    memory = RequestMemory(TOTAL_BYTES)
    running = Holding(memory, ANNA, reserved=False)
    running.grow(int(CLIENT_SHARE * TOTAL_BYTES))
    refused_often = Holding(memory, Client(ANNA.key, known=False), reserved=False)
    refused_often.grow(10)
    refused_often.release()
    running.release()
    assert memory.held_bytes == 0
