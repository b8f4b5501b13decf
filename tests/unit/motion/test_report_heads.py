"""Heads of reports: one form for all kinds, and places that are filled when a report is handed out."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest
from tests.support.report_pages import HOSTILE, Page

from marey_reports.drawing.head import MOST_INPUTS_SHOWN, ReportHead, ReportInput
from marey_reports.drawing.markup import element
from marey_reports.drawing.page import Section, page, scripts_of
from marey_schemas.documents.report_pages import ORIGIN_PLACE, PLAYER_PLACE, ReportOrigin, with_origin, with_player

ORIGIN = ReportOrigin("lab", "https://marey.example", "rita", datetime(2026, 11, 29, 14, 5, tzinfo=UTC))


def page_of(title: str = "Walks", inputs: tuple[ReportInput, ...] = (), *, plays_motion: bool = False) -> str:
    head = ReportHead("Evaluation of clips", title, "1.2.3", inputs)
    return page(head, "Good.", [Section("a", "A", element("p", "text"))], plays_motion=plays_motion)


def test_a_head_names_what_it_is_its_version_and_its_inputs_with_their_revisions() -> None:
    text = Page(page_of(inputs=(ReportInput("clip", "walks/a", 3), ReportInput("skeleton", "rig", 1)))).text
    for part in (
        "Evaluation of clips",
        "Walks",
        "Marey 1.2.3",
        "clip walks/a , revision 3",
        "skeleton rig , revision 1",
    ):
        assert part in text


def test_many_inputs_are_counted_by_kind_and_listed_on_demand() -> None:
    inputs = tuple(ReportInput("clip", f"walk {n}", n) for n in range(1, MOST_INPUTS_SHOWN + 1))
    found = Page(page_of(inputs=(*inputs, ReportInput("skeleton", "rig", 1))))
    assert f"{MOST_INPUTS_SHOWN} clips, 1 skeleton" in found.text
    assert found.tags["details"] == 1
    assert Page(page_of(inputs=inputs)).tags["details"] == 0


def test_an_origin_is_inserted_once_and_changes_nothing_else() -> None:
    stored = page_of()
    filled = with_origin(stored.encode(), ORIGIN).decode()
    text = Page(filled).text
    for part in ("project lab on https://marey.example", "requested by rita", "date 2026-11-29 14:05 UTC"):
        assert part in text
    before, _, after = stored.partition(ORIGIN_PLACE)
    assert filled.startswith(before)
    assert filled.endswith(after)
    assert with_origin(filled.encode(), ORIGIN) == filled.encode()
    assert scripts_of(filled) == scripts_of(stored)


def test_a_date_is_in_utc_and_an_unknown_author_is_left_out() -> None:
    there = timezone(timedelta(hours=2))
    late = ORIGIN._replace(made_at=datetime(2026, 11, 30, 1, 0, tzinfo=there), author=None)
    assert dict(late.facts()) == {"project": "lab on https://marey.example", "date": "2026-11-29 23:00 UTC"}


@pytest.mark.parametrize("name", [*HOSTILE, ORIGIN_PLACE, PLAYER_PLACE, "<script>"])
def test_no_name_can_move_a_place_or_add_an_element(name: str) -> None:
    stored = page_of(name, (ReportInput("clip", name, 1),), plays_motion=True)
    assert (stored.count(ORIGIN_PLACE), stored.count(PLAYER_PLACE)) == (1, 1)
    filled = with_origin(stored.encode(), ORIGIN._replace(project=name, author=name)).decode()
    usual = Page(with_origin(page_of("x", (ReportInput("clip", "x", 1),), plays_motion=True).encode(), ORIGIN).decode())
    assert Page(filled).tags == usual.tags
    assert scripts_of(filled) == scripts_of(page_of())


def test_the_player_is_inserted_as_data_that_no_browser_runs() -> None:
    filled = with_player(page_of(plays_motion=True).encode(), "QUJD").decode()
    assert '<script type="application/json" id="player">"QUJD"</script>' in filled
    assert scripts_of(filled) == scripts_of(page_of())
    still = page_of().encode()
    assert with_player(still, "QUJD") == still
