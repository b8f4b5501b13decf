"""Entity tags and preconditions of writes."""

import pytest

from marey_server.errors import BadRequestProblem, PreconditionFailedProblem, PreconditionRequiredProblem
from marey_server.http.etags import (
    ABSENT,
    ANY_STATE,
    entity_tag,
    matches,
    parse_tags,
    without_digest,
    write_precondition,
)


def test_a_tag_names_state_and_form() -> None:
    assert entity_tag(7, "msgpack") == '"7.msgpack"'


def test_the_digest_of_an_answer_can_be_left_out() -> None:
    assert without_digest('"7.0a1b2c.json"') == without_digest('"7.json"') == '"7.json"'


@pytest.mark.parametrize("header", ['"7.json"', 'W/"7.json"', '"6.json", "7.json"', "*"])
def test_a_caller_who_holds_the_state_in_this_form_needs_no_bytes(header: str) -> None:
    assert matches(header, '"7.json"')


@pytest.mark.parametrize("header", [None, '"7.msgpack"', '"17.json"'])
def test_another_state_or_form_is_sent(header: str | None) -> None:
    assert not matches(header, '"7.json"')


def test_what_was_read_in_one_form_can_be_changed_in_another() -> None:
    assert write_precondition('"7.msgpack"', None).expected_rev == 7


def test_a_change_does_not_depend_on_members_without_a_rev() -> None:
    assert write_precondition('"7.0a1b2c.json"', None).expected_rev == 7


def test_a_change_may_name_several_states() -> None:
    assert write_precondition('"7.json", "9.msgpack", "foreign"', None).expected_rev == frozenset({7, 9})
    assert write_precondition('"7.json", "7.msgpack"', None).expected_rev == 7


def test_more_states_than_a_statement_should_take_are_refused() -> None:
    tags = [f'"{number}.json"' for number in range(1, 102)]
    assert write_precondition(",".join(tags[:100]), None).expected_rev == frozenset(range(1, 101))
    with pytest.raises(BadRequestProblem, match="101 versions; at most 100"):
        write_precondition(",".join(tags), None)


def test_a_change_without_a_precondition_is_refused() -> None:
    with pytest.raises(PreconditionRequiredProblem):
        write_precondition(None, None)


def test_the_star_accepts_any_state() -> None:
    assert write_precondition("*", None) is ANY_STATE


def test_creating_only_is_a_precondition_where_things_can_be_created() -> None:
    assert write_precondition(None, "*", may_create=True) is ABSENT
    with pytest.raises(PreconditionRequiredProblem):
        write_precondition(None, "*")
    with pytest.raises(BadRequestProblem):
        write_precondition(None, '"7.json"', may_create=True)


@pytest.mark.parametrize("header", ['"33a64df5"', '"\xb2"', '"\xb2.json"', '"9999999999.json"'])
def test_a_foreign_tag_can_never_match(header: str) -> None:
    with pytest.raises(PreconditionFailedProblem):
        write_precondition(header, None)


@pytest.mark.parametrize("header", ["7.json", '"7.json', '"7.json" "8.json"', '"\n"'])
def test_malformed_tags_are_refused(header: str) -> None:
    with pytest.raises(BadRequestProblem):
        parse_tags(header)
