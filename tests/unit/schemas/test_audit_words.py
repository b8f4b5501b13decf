"""Entries of the audit log in words."""

from datetime import UTC, datetime

import pytest

from marey_schemas.audit import AuditEntry


@pytest.mark.parametrize(
    ("kind", "words"), [("member.added", "added the member"), ("kind.of_a_newer_server", "kind.of_a_newer_server")]
)
def test_an_entry_has_words_also_if_its_kind_is_unknown(kind: str, words: str) -> None:
    at = datetime(2026, 11, 26, tzinfo=UTC)
    entry = AuditEntry(seq=1, at=at, kind=kind, project=None, actor="ada", about="ben", subject="user_1")
    assert entry.words == words
