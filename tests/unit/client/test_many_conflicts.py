"""Decisions about many conflicts at once on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from marey_client.cli.datasets.combining import Decisions, _print_result
from marey_client.cli.datasets.proposals import _decided
from marey_client.cli.terminal.failures import WrongUsage
from marey_schemas.datasets.merges import EntryConflict, MergeAnswer, Resolution, Side
from marey_schemas.kinds import Kind

if TYPE_CHECKING:
    from marey_client.handles.proposals import ProposalHandle
    from marey_client.handles.versions import DatasetHandle

ROUND = 40
"""Greatest number of conflicts in an answer of the pretended server."""
HEAD = "sha256:" + "2" * 64


def conflict(number: int, reason: str = "") -> EntryConflict:
    return EntryConflict(
        path=f"models/walk {number:03d}", kind=Kind.MODEL, parts=("model", "tree"), base=None, ours=None, theirs=None,
        reason=reason,
    )  # fmt: skip


def answer(conflicts: Sequence[EntryConflict]) -> MergeAnswer:
    return MergeAnswer(
        commit=None, base=None, ours="sha256:" + "1" * 64, theirs=None, changes=0, conflicts=tuple(conflicts[:ROUND]),
        conflict_count=len(conflicts),
    )  # fmt: skip


def left(resolutions: Sequence[Resolution], conflicts: Sequence[EntryConflict]) -> MergeAnswer:
    """Answer as a server whose conflicts stay until they are decided whole, or part by part."""
    decided = {one.path for one in resolutions if one.part in (None, "tree")}
    halves = {one.path for one in resolutions if one.part == "model"}
    return answer(
        [
            one.model_copy(update={"parts": ("tree",)}) if one.path in halves else one
            for one in conflicts
            if one.path not in decided or one.reason
        ]
    )


def test_the_conflicts_that_nobody_decided_are_decided_by_one_side() -> None:
    conflicts = [conflict(number) for number in range(100)]
    given = [
        Resolution(path=conflicts[3].path, kind=Kind.MODEL, take=Side.OURS),
        Resolution(path=conflicts[50].path, kind=Kind.MODEL, take=Side.BASE, part="model"),
    ]
    found = Decisions(given, "theirs").complete(lambda resolutions: left(resolutions, conflicts))
    assert found[:2] == given
    assert sorted((one.path, one.part) for one in found[2:]) == [
        (one.path, "tree" if one is conflicts[50] else None) for one in conflicts if one is not conflicts[3]
    ]
    assert {one.take for one in found[2:]} == {Side.THEIRS}
    assert left(found, conflicts).conflict_count == 0


def test_without_a_side_for_the_others_nothing_is_asked() -> None:
    def ask(_resolutions: Sequence[Resolution]) -> MergeAnswer:
        raise AssertionError("nothing is to be asked")

    assert Decisions([], None).complete(ask) == []


def test_a_conflict_that_its_decision_does_not_end_is_decided_once() -> None:
    stuck = conflict(1, reason="the other entry cannot go back")
    found = Decisions([], "ours").complete(lambda resolutions: left(resolutions, [stuck]))
    assert [one.path for one in found] == [stuck.path]


def test_a_hundred_conflicts_are_a_table_and_a_count(capsys: pytest.CaptureFixture[str]) -> None:
    _print_result(answer([conflict(number) for number in range(100)]), "main")
    printed = capsys.readouterr()
    assert printed.out.count("models/walk") == ROUND
    assert f"the first {ROUND} conflicts are listed" in printed.err
    assert "100 conflicts; nothing was recorded" in printed.err


def test_an_unknown_side_is_refused() -> None:
    with pytest.raises(WrongUsage, match="write ours, theirs, base"):
        Decisions([], "mine").complete(lambda _resolutions: answer([]))


class Proposed:
    """Simulated dataset whose first proposal has three conflicts."""

    def __init__(self) -> None:
        self.conflicts = [conflict(number) for number in range(3)]
        self.previewed: list[tuple[str, str, bool]] = []
        self.reads = 0

    def merge(
        self, version: str, *, into: str, resolutions: Sequence[Resolution] = (), preview: bool = False
    ) -> MergeAnswer:
        self.previewed.append((version, into, preview))
        return left(resolutions, self.conflicts)

    def read(self) -> Any:
        self.reads += 1
        return SimpleNamespace(head=HEAD, target="main")


def test_the_conflicts_of_the_newest_proposed_commit_are_decided() -> None:
    on = Proposed()
    decided, seen = _decided(cast("DatasetHandle", on), cast("ProposalHandle", on), Decisions([], "ours"))
    assert [(one.path, one.take) for one in decided] == [(one.path, Side.OURS) for one in on.conflicts]
    assert seen == HEAD
    assert set(on.previewed) == {(HEAD, "main", True)}


def test_decisions_without_others_need_no_look_at_the_proposal() -> None:
    on = Proposed()
    assert _decided(cast("DatasetHandle", on), cast("ProposalHandle", on), Decisions([], None)) == ([], None)
    assert (on.reads, on.previewed) == (0, [])
