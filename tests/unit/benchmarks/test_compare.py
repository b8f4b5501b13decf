"""Comparison of two runs of the benchmarks in one table."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest
from benchmarks import compare
from benchmarks.timing import Row

READ = Row("read a clip", "516 kB; the server's processor: 2.9 ms each", "900/s", "bare 1800/s", 0.5, "> 999/s", False)
READ_LATER = Row(
    "read a clip", "516 kB; the server's processor: 2.1 ms each", "1200/s", "bare 1800/s", 0.67, "> 999/s", True
)
SMALL, LARGE = (Row("DTW", f"{frames} x {frames}", f"{ms} ms") for frames, ms in ((200, 2), (1000, 9)))


def cells(table: str) -> list[list[str]]:
    """Return the cells of each row of a table, without its headings."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]


def test_a_row_of_both_runs_shows_both_figures_and_the_later_verdict() -> None:
    [shown] = cells(compare.as_markdown([SMALL], [Row("DTW", "200 x 200", "1 ms", "librosa", 3.25, "≥ 3x", True)]))

    assert shown == ["DTW", "200 x 200", "librosa", "2 ms", "", "1 ms", "3.2x", "≥ 3x", "met"]


def test_rows_are_paired_by_size_whatever_their_order() -> None:
    pairs = list(compare.matched([SMALL, LARGE], [LARGE, SMALL]))

    assert pairs == [(LARGE, LARGE), (SMALL, SMALL)]


def test_a_size_that_differs_in_its_figures_alone_is_the_same_row() -> None:
    [shown] = cells(compare.as_markdown([READ], [READ_LATER]))

    assert shown[1] == f"{READ_LATER.size} (before: {READ.size})"
    assert shown[2:7] == ["bare 1800/s", "900/s", "0.5x", "1200/s", "0.7x"]


def test_rows_of_one_run_alone_are_shown_as_new_or_absent() -> None:
    generated, real = (
        Row("files read", f"120 {origin} files", "1 s", goal="≥ 15x", met=False) for origin in ("generated", "real")
    )

    new, absent = cells(compare.as_markdown([generated], [real]))

    assert new == ["files read", "120 real files", "", "(new)", "", "1 s", "", "≥ 15x", "**missed**"]
    assert absent == ["files read", "120 generated files", "", "1 s", "", "(absent)", "", "≥ 15x", ""]


def test_the_command_prints_the_table_of_two_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before, after = tmp_path / "before.json", tmp_path / "after.json"
    before.write_text(json.dumps([asdict(READ)]), encoding="utf-8")
    after.write_text(json.dumps([asdict(READ_LATER)]), encoding="utf-8")
    monkeypatch.setattr("sys.argv", ["compare", str(before), str(after)])

    assert compare.main() == 0
    assert capsys.readouterr().out == compare.as_markdown([READ], [READ_LATER]) + "\n"


@pytest.mark.parametrize("text", ["{", "[1]", '[{"work": "read"}]'])
def test_a_file_that_holds_no_run_is_refused(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "before.json"
    file.write_text(text, encoding="utf-8")
    monkeypatch.setattr("sys.argv", ["compare", str(file), str(file)])

    with pytest.raises(SystemExit) as stopped:
        compare.main()

    assert stopped.value.code == 2
    assert "not the JSON of a run of the benchmarks" in capsys.readouterr().err
