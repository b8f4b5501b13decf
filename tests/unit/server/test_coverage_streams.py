"""Rows of coverage streams: compare-and-swap, repeated requests, and deletion after a day without frames."""

from collections.abc import Callable
from typing import Any

import pytest
from tests.support.database_fixtures import AdjustableClock
from tests.support.interleaving import Step as Half
from tests.support.interleaving import interleave
from tests.support.store_fixtures import WRITE, Lab, requiring

from marey_schemas.coverage_streams import MOST_STREAMS
from marey_server.errors import ConflictProblem, ForbiddenProblem, NotFoundProblem
from marey_server.store import coverage_streams, garbage
from marey_server.store.coverage_streams import LIFETIME_US, CoverageOffset, NewStream, Stream, StreamStep

SETTINGS = {
    "frame_rate_hz": 60.0, "skeleton": None, "evaluation": None, "speeds_m_s": [1.0], "turn_rates_deg_s": [0.0],
    "least_s": 1.0, "target_count": 3, "path_s": 4.0,
}  # fmt: skip
NEW = NewStream(SETTINGS, None, b"beginning")
DAY_S = LIFETIME_US / 1e6


def step(offset: int, said: str = "a") -> StreamStep:
    return StreamStep(f"sha256:{said * 64}", {"offset": offset, "said": said}, offset, f"state {said}".encode())


@pytest.fixture
def stream(lab: Lab) -> Stream:
    return lab.write(coverage_streams.create_stream, "lab", NEW, who=lab.contributor)


def held(lab: Lab, stream: Stream) -> Stream:
    return lab.read(coverage_streams.read_to_advance, "lab", stream.id, who=lab.contributor)


def test_a_stream_moves_on_from_where_it_was(lab: Lab, stream: Stream) -> None:
    assert held(lab, stream) == stream
    answer = lab.write(coverage_streams.advance_stream, "lab", stream, step(10), who=lab.contributor)
    now = held(lab, stream)
    assert answer == now.answer == {"offset": 10, "said": "a"}
    assert (now.offset, now.state, now.rev) == (10, b"state a", 2)
    assert coverage_streams.answered_before(now, step(10).said) == answer
    assert coverage_streams.answered_before(now, step(10, "b").said) is None


def test_a_step_from_where_the_stream_no_longer_is_is_told_the_true_offset(lab: Lab, stream: Stream) -> None:
    lab.write(coverage_streams.advance_stream, "lab", stream, step(10), who=lab.contributor)
    with pytest.raises(CoverageOffset) as refused:
        lab.write(coverage_streams.advance_stream, "lab", stream, step(20, "b"), who=lab.contributor)
    assert refused.value.context == {"offset": 10}
    assert held(lab, stream).state == b"state a"


def test_the_same_step_again_gets_the_same_answer_and_counts_once(lab: Lab, stream: Stream) -> None:
    first = lab.write(coverage_streams.advance_stream, "lab", stream, step(10), who=lab.contributor)
    again = lab.write(coverage_streams.advance_stream, "lab", stream, step(10), who=lab.contributor)
    assert again == first
    assert held(lab, stream).rev == 2


@pytest.mark.parametrize("commit", [True, False])
def test_of_two_senders_at_once_one_is_taken_and_the_other_told_where_to_go_on(
    lab: Lab, stream: Stream, open_database: Callable[..., Any], commit: bool
) -> None:
    def send(said: str, offset: int) -> Callable[..., Any]:
        return lambda tx: coverage_streams.advance_stream(tx, "lab", stream, step(offset, said))

    one, other = (
        Half(database, lab.contributor, requiring(WRITE, send(said, offset)))
        for database, said, offset in ((lab.database, "a", 10), (open_database(), "b", 30))
    )
    _, second = interleave(one, other, commit=commit)
    now = held(lab, stream)
    if commit:
        assert isinstance(second, CoverageOffset)
        assert second.context == {"offset": 10}
        assert now.answer == {"offset": 10, "said": "a"}
    else:
        assert second == now.answer == {"offset": 30, "said": "b"}


def test_a_request_that_arrives_twice_at_once_counts_once(
    lab: Lab, stream: Stream, open_database: Callable[..., Any]
) -> None:
    half = [
        Half(
            database,
            lab.contributor,
            requiring(WRITE, lambda tx: coverage_streams.advance_stream(tx, "lab", stream, step(10))),
        )
        for database in (lab.database, open_database())
    ]
    first, second = interleave(*half)
    assert first == second == {"offset": 10, "said": "a"}
    assert held(lab, stream).rev == 2


def test_the_end_of_a_take_and_frames_at_the_same_offset_do_not_overwrite_each_other(lab: Lab, stream: Stream) -> None:
    lab.write(coverage_streams.advance_stream, "lab", stream, step(0, "e"), who=lab.contributor)
    with pytest.raises(CoverageOffset):
        lab.write(coverage_streams.advance_stream, "lab", stream, step(10, "f"), who=lab.contributor)


def test_contributors_send_readers_look_on_and_nobody_else_knows_of_it(lab: Lab, stream: Stream) -> None:
    shown = lab.read(coverage_streams.read_stream, "lab", stream.id, who=lab.reader)
    assert shown == stream
    for attempt in (coverage_streams.read_to_advance, coverage_streams.delete_stream):
        with pytest.raises(ForbiddenProblem):
            lab.write(attempt, "lab", stream.id, who=lab.reader)
    with pytest.raises(ForbiddenProblem):
        lab.write(coverage_streams.advance_stream, "lab", stream, step(10), who=lab.reader)
    with pytest.raises(ForbiddenProblem):
        lab.write(coverage_streams.create_stream, "lab", NEW, who=lab.reader)
    for who in (lab.stranger, lab.anonymous):
        with pytest.raises(NotFoundProblem):
            lab.read(coverage_streams.read_stream, "lab", stream.id, who=who)


def test_a_stream_is_known_in_its_own_project_only(lab: Lab, stream: Stream) -> None:
    from tests.support.store_fixtures import Lab

    Lab(lab.database, "other")
    admin = lab.sign_up("root", administrator=True)
    with pytest.raises(NotFoundProblem):
        lab.read(coverage_streams.read_stream, "other", stream.id, who=admin)


def test_lists_show_the_newest_first_without_what_is_only_needed_to_go_on(lab: Lab) -> None:
    made = [lab.write(coverage_streams.create_stream, "lab", NEW).id for _ in range(5)]
    page = lab.read(coverage_streams.list_streams, "lab", limit=3, who=lab.reader)
    rest = lab.read(coverage_streams.list_streams, "lab", limit=3, cursor=page.next_cursor, who=lab.reader)
    assert sorted(one.id for one in (*page.items, *rest.items)) == sorted(made)
    assert [one.id for one in (*page.items, *rest.items)] == sorted(made, reverse=True)
    assert page.items[0].frame_rate_hz == 60.0
    assert (page.items[0].expires_at - page.items[0].updated_at).total_seconds() == DAY_S


def test_a_project_has_so_many_streams_and_no_more(lab: Lab) -> None:
    made = [lab.write(coverage_streams.create_stream, "lab", NEW) for _ in range(MOST_STREAMS)]
    with pytest.raises(ConflictProblem) as refused:
        lab.write(coverage_streams.create_stream, "lab", NEW)
    assert refused.value.error_code == "too-many-streams"
    lab.write(coverage_streams.delete_stream, "lab", made[-1].id)
    lab.write(coverage_streams.create_stream, "lab", NEW)


def test_the_last_place_is_given_once(lab: Lab, open_database: Callable[..., Any]) -> None:
    for _ in range(MOST_STREAMS - 1):
        lab.write(coverage_streams.create_stream, "lab", NEW)
    halves = [
        Half(database, lab.contributor, requiring(WRITE, lambda tx: coverage_streams.create_stream(tx, "lab", NEW)))
        for database in (lab.database, open_database())
    ]
    first, second = interleave(*halves)
    assert first.offset == 0
    assert isinstance(second, ConflictProblem)


def test_what_nobody_uses_for_a_day_is_dropped_and_what_is_used_stays(
    lab: Lab, stream: Stream, clock: AdjustableClock
) -> None:
    used = lab.write(coverage_streams.create_stream, "lab", NEW)
    clock.advance(0.75 * DAY_S)
    lab.write(coverage_streams.advance_stream, "lab", used, step(10), who=lab.contributor)
    assert garbage.collect_garbage(lab.database).coverage_streams == 0
    clock.advance(0.5 * DAY_S)
    for gone in (coverage_streams.read_stream, coverage_streams.read_to_advance):
        with pytest.raises(NotFoundProblem, match="no frames for a day"):  # even before it is swept
            lab.read(gone, "lab", stream.id)
    assert [one.id for one in lab.read(coverage_streams.list_streams, "lab").items] == [used.id]
    assert garbage.collect_garbage(lab.database).coverage_streams == 1
    assert garbage.collect_garbage(lab.database).coverage_streams == 0
    assert held(lab, used).offset == 10


def test_a_stream_that_is_dropped_while_frames_are_worked_on_is_gone(lab: Lab, stream: Stream) -> None:
    lab.write(coverage_streams.delete_stream, "lab", stream.id)
    with pytest.raises(NotFoundProblem):
        lab.write(coverage_streams.advance_stream, "lab", stream, step(10), who=lab.contributor)
