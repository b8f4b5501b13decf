"""Fields of a take record that a new revision of a clip keeps."""

from __future__ import annotations

from typing import Any

import pytest

from marey_schemas.documents.clips import ClipInfo, with_earlier_facts


def imported(message: str, *, angle_deg: float = 83.0, file: str | None = "a") -> dict[str, Any]:
    """Return the part `info` of an imported clip with one warning."""
    source = {"format": "bvh"} | ({} if file is None else {"file": f"sha256:{file * 64}"})
    return {"source": source, "checks": [{"code": "jump", "message": message, "values": {"angle_deg": angle_deg}}]}


@pytest.mark.parametrize(
    ("new", "earlier", "kept"),
    [
        ({}, {"consent_until": "2020-01-31", "comment": "limps"}, {"consent_until": "2020-01-31", "comment": "limps"}),
        ({"action": "run"}, {"action": "walk"}, {"action": "run"}),
        ({"consent_until": "2027-01-31"}, {"consent_until": "2020-01-31"}, {"consent_until": "2020-01-31"}),
        ({"consent_until": "2020-01-31"}, {"consent_until": "2027-01-31"}, {"consent_until": "2020-01-31"}),
        ({"consent_for": ["games", "films"]}, {"consent_for": ["films"]}, {"consent_for": ["films"]}),
        ({"tags": ["a"]}, {"tags": ["b"], "source": {"format": "bvh"}}, {"tags": ["a"]}),
        (imported("new words"), imported("old words"), imported("old words")),
        (imported("new words"), {"source": imported("")["source"]}, imported("new words")),
        ({"source": imported("")["source"]}, {"source": imported("")["source"]}, {"source": imported("")["source"]}),
        (imported("new words", angle_deg=90.0), imported("old words"), imported("new words", angle_deg=90.0)),
        (imported("new words", file="b"), imported("old words"), imported("new words", file="b")),
        (imported("new words", file=None), imported("old words", file=None), imported("new words", file=None)),
    ],
)
def test_a_revision_keeps_facts_and_the_stricter_consent(
    new: dict[str, Any], earlier: dict[str, Any], kept: dict[str, Any]
) -> None:
    assert with_earlier_facts(new, earlier) == kept
    ClipInfo.model_validate(kept)
