"""Reports in a real Chromium: on a phone and on a desk, without script or WebGL, from disk and from a server."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.every_report import ORIGIN, REPORTS, evaluation_page, write_reports
from tests.support.rest_server import Server, stored_file
from tests.support.tiers import chromium
from tests.support.vitest_runs import run_vitest

from marey_reports.drawing.page import scripts_of
from marey_schemas.documents.report_pages import with_origin, with_player
from marey_server.handlers.browser.pages import packed_player

pytestmark = pytest.mark.timeout(900)

MOST_PAGE_BYTES = 4_000_000
"""Greatest size of the report of the evaluation of a few takes, with the player and two trials."""


def stored_evaluation(owner: httpx.Client, page: str) -> str:
    """Store an evaluation with a report as a worker does, and return its path."""
    report: dict[str, Any] = {
        "schema": "marey/evaluation-report@1",
        "title": "walks",
        "html": stored_file(owner, page.encode()),
        "scripts": scripts_of(page),
        "figures": [],
    }
    parts = {"evaluation": {"schema": "marey/evaluation@1", "verdict": "Good.", "headline": {}}, "report": report}
    made = owner.post("/projects/lab/evaluations", json={"name": "walks-eval", "parts": parts})
    assert made.status_code == 201, made.text
    return f"/projects/lab/evaluations/{made.json()['id']}"


@pytest.mark.soak
@pytest.mark.chromium
def test_every_report_fits_every_screen_and_plays_its_motion(
    server: Server, owner: httpx.Client, tmp_path: Path
) -> None:
    shown = list(write_reports(tmp_path, REPORTS))
    answer = owner.get(f"{stored_evaluation(owner, evaluation_page())}/report")
    assert answer.status_code == 200
    assert len(answer.content) < MOST_PAGE_BYTES
    (tmp_path / "served.html").write_bytes(answer.content)
    player = packed_player()
    assert player is not None
    played = with_player(with_origin(evaluation_page().encode(), ORIGIN), player.content)
    (tmp_path / "played.html").write_bytes(played)
    given = {
        "chromium": chromium(),
        "folder": tmp_path.as_uri(),
        "names": shown,
        "served": {"file": str(tmp_path / "served.html"), "policy": answer.headers["Content-Security-Policy"]},
    }
    run_vitest("browser", "browser/reports.test.ts", MAREY_WEB_GIVEN=json.dumps(given))
