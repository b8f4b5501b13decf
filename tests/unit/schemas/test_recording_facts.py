"""Fields of a take record that a new revision of a clip keeps."""

from __future__ import annotations

from typing import Any

import pytest

from marey_schemas.documents.clips import ClipInfo, with_earlier_facts


@pytest.mark.parametrize(
    ("new", "earlier", "kept"),
    [
        ({}, {"consent_until": "2020-01-31", "comment": "limps"}, {"consent_until": "2020-01-31", "comment": "limps"}),
        ({"action": "run"}, {"action": "walk"}, {"action": "run"}),
        ({"consent_until": "2027-01-31"}, {"consent_until": "2020-01-31"}, {"consent_until": "2020-01-31"}),
        ({"consent_until": "2020-01-31"}, {"consent_until": "2027-01-31"}, {"consent_until": "2020-01-31"}),
        ({"consent_for": ["games", "films"]}, {"consent_for": ["films"]}, {"consent_for": ["films"]}),
        ({"tags": ["a"]}, {"tags": ["b"], "source": {"format": "bvh"}}, {"tags": ["a"]}),
    ],
)
def test_a_revision_keeps_facts_and_the_stricter_consent(
    new: dict[str, Any], earlier: dict[str, Any], kept: dict[str, Any]
) -> None:
    assert with_earlier_facts(new, earlier) == kept
    ClipInfo.model_validate(kept)
