"""Commits from archives and other servers: what is refused before it reaches the store."""

import pytest
from pydantic import ValidationError

from marey_schemas.datasets.contents import ReceivedCommit

COMMIT = {"tree": "sha256:" + "0" * 64, "parents": (), "author": "ada", "message": "first", "changes": ()}
TIME = "2026-11-23T10:00:00.000000Z"


def test_a_time_in_the_form_of_commits_is_accepted() -> None:
    assert ReceivedCommit.model_validate({**COMMIT, "at": TIME}).at == TIME


@pytest.mark.parametrize(
    "text", ["", "yesterday", "2026-11-23", "2026-11-23T10:00:00Z", TIME[:-2] + "Z", "2026-13" + TIME[7:]]
)
def test_any_other_time_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValidationError, match=f"must be written like {TIME}"):
        ReceivedCommit.model_validate({**COMMIT, "at": text})
