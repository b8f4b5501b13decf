"""Negotiation of the media type of an answer."""

import pytest

from marey_server.errors import NotAcceptableProblem, UnauthenticatedProblem, UnsupportedMediaTypeProblem
from marey_server.http import negotiation
from marey_server.http.negotiation import BSON, DOCUMENT_FORMS, JSON, MODEL_FORMS, MSGPACK, MSGPACK_BLOCKS, choose


@pytest.mark.parametrize("accept", [None, "", "*/*", "application/*", "text/html, */*;q=0.1"])
def test_a_caller_without_a_preference_gets_json(accept: str | None) -> None:
    assert choose(accept, DOCUMENT_FORMS) is JSON


def test_the_highest_quality_wins_over_the_order_of_the_header() -> None:
    assert choose("application/json;q=0.2, application/bson;q=0.9, application/msgpack;q=0.5", MODEL_FORMS) is BSON


def test_a_specific_range_overrides_a_general_one() -> None:
    assert choose("*/*, application/json;q=0", MODEL_FORMS) is MSGPACK


def test_blocks_are_sent_only_to_those_who_ask_for_them() -> None:
    assert choose("application/msgpack", DOCUMENT_FORMS) is MSGPACK
    assert choose("application/msgpack; arrays=blocks", DOCUMENT_FORMS) is MSGPACK_BLOCKS
    assert (
        choose("application/msgpack;arrays=blocks;q=0.9, application/msgpack;q=0.8", DOCUMENT_FORMS) is MSGPACK_BLOCKS
    )


def test_a_caller_who_accepts_nothing_on_offer_is_told_what_is() -> None:
    with pytest.raises(NotAcceptableProblem) as refusal:
        choose("image/png, application/json;q=0, application/msgpack;q=0, application/bson;q=0", MODEL_FORMS)
    assert refusal.value.context["offered"] == ["application/json", "application/msgpack", "application/bson"]


@pytest.mark.parametrize("accept", ["application/json;q=high", "json", ";;;", "application/json;q=-1"])
def test_malformed_ranges_match_nothing(accept: str) -> None:
    with pytest.raises(NotAcceptableProblem):
        choose(accept, MODEL_FORMS)


def test_a_body_without_a_type_is_json() -> None:
    assert negotiation.body_type(None) == "application/json"


@pytest.mark.parametrize("content_type", ["text/plain", "application/xml", "application/json; charset=latin-1"])
def test_other_bodies_are_refused(content_type: str) -> None:
    with pytest.raises(UnsupportedMediaTypeProblem):
        negotiation.body_type(content_type)


def test_only_bodies_of_operations_that_accept_zstd_may_be_compressed() -> None:
    assert negotiation.is_compressed(" ZSTD ", may_be=True)
    for plain in (None, "", "identity"):
        assert not negotiation.is_compressed(plain, may_be=True)
    for coding, may_be in (("gzip", True), ("zstd, gzip", True), ("zstd", False)):
        with pytest.raises(UnsupportedMediaTypeProblem, match=f"without Content-Encoding: {coding}"):
            negotiation.is_compressed(coding, may_be=may_be)


@pytest.mark.parametrize(
    ("header", "accepted"),
    [
        (None, False), ("*", False), ("gzip", False), ("Zstd", True), ("gzip, deflate, zstd", True),
        ("zstd;q=0.5", True), ("zstd;q=0", False), ("zstd; q=0.000", False),
    ],
)  # fmt: skip
def test_answers_are_compressed_for_callers_who_name_zstd(header: str | None, accepted: bool) -> None:
    assert negotiation.accepts_zstd(header) is accepted


def test_only_bearer_tokens_are_credentials() -> None:
    assert negotiation.bearer_token("bearer abc") == "abc"
    assert negotiation.bearer_token(None) is None
    for header in ("Basic dXNlcjpwdw==", "Bearer", "Bearer  ", "token"):
        with pytest.raises(UnauthenticatedProblem):
            negotiation.bearer_token(header)
