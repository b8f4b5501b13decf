"""Previews of a purge of several places, without a server."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, cast

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer

from marey_client.cli import purging
from marey_client.handles.purges import combined, without_contained
from marey_schemas.kinds import Kind
from marey_schemas.purges import HeldItem, PurgeAnswer, PurgedItem


def preview(purged: Sequence[str], refused: Sequence[str] = ()) -> PurgeAnswer:
    """Return a preview in which each purged item has ten bytes."""
    return PurgeAnswer(
        preview=True,
        purged=tuple(PurgedItem(item=one, kind=Kind.CLIP, path=one) for one in purged),
        refused=tuple(HeldItem(item=one, kind=Kind.CLIP, path=one, holders=()) for one in refused),
        freed_bytes=10 * len(purged),
    )


def test_bytes_of_an_item_in_a_folder_that_is_purged_too_count_once() -> None:
    previews = [preview(["a"]), preview(["a", "b", "c"]), preview(["d"]), preview(["d"]), preview(["b", "c"])]
    needed = without_contained(previews)
    assert needed == [1, 2]
    whole = combined([previews[place] for place in needed])
    assert [one.item for one in whole.purged] == ["a", "b", "c", "d"]
    assert whole.freed_bytes == 40


def test_an_item_that_is_purged_with_its_holder_is_not_reported_as_refused() -> None:
    previews = [preview([], ["skeleton"]), preview(["skeleton", "clip"])]
    assert without_contained(previews) == [1]


def test_previews_without_items_are_left_out() -> None:
    assert without_contained([preview([]), preview(["a"]), preview([])]) == [1]
    assert without_contained([preview([])]) == []


def answer(made: PurgeAnswer) -> httpx.Response:
    return httpx.Response(200, content=made.model_dump_json(), headers={"Content-Type": "application/json"})


def test_an_item_in_a_purged_folder_is_not_purged_again(
    script: ScriptedServer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(purging, "connect", lambda _context: script.marey())
    clip, other = "clip_00000000000000000000000001", "clip_00000000000000000000000002"
    done = preview([clip, other]).model_copy(update={"preview": False})
    script.answers = [answer(one) for one in (preview([clip, other]), preview([clip]), done)]
    purging.purge(cast(Any, None), ["lab/", f"lab/{clip}"], yes=True)
    assert [json.loads(one.content).get("preview", False) for one in script.requests] == [True, True, False]
    assert "2 items purged for good; garbage collection can free about 20 bytes" in capsys.readouterr().err
