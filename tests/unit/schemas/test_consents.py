"""Consents in descriptions of clips: the strictest of several, and the form of days."""

from datetime import UTC, date, datetime

import pytest

from marey_schemas.documents.clips import ClipInfo


def info(until: str | None, purposes: list[str] | None) -> ClipInfo:
    return ClipInfo.model_validate({"consent_until": until, "consent_for": purposes})


def test_of_several_consents_the_strictest_remains() -> None:
    first = info("2026-05-01", ["games", "films"])
    others = [info(None, None), info("2026-03-01", ["films", "research"]), info("2026-04-01", None)]
    bounded = first.with_consent_of(others)
    assert (bounded.consent_until, bounded.consent_for) == (date(2026, 3, 1), ("films",))
    assert first.with_consent_of([]) == first
    assert info(None, None).with_consent_of(others[1:2]).consent_for == ("films", "research")
    assert info(None, ["games"]).with_consent_of(others[1:2]).consent_for == ()


def test_days_are_dates_or_texts_of_one_form() -> None:
    assert ClipInfo(shoot_day=date(2026, 1, 31)).shoot_day == info("2026-01-31", None).consent_until
    for wrong in (
        "2026-1-31",
        "20260131",
        "2026-01-31T00:00:00",
        "2026-02-30",
        1769817600,
        datetime(2026, 1, 31, tzinfo=UTC),
    ):
        with pytest.raises(ValueError, match="consent_until"):
            ClipInfo.model_validate({"consent_until": wrong})
