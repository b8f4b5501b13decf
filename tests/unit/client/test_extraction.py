"""Files that are extracted from an archive: names that file systems refuse, or take for the same name."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from marey_client.archives.extraction import extract_archive
from marey_versions.records import DatasetEntry

MOST_BYTES = 255
"""Greatest length of a file name in usual file systems."""


def archive_of(*entries: tuple[str, str]) -> Any:
    """Return an archive whose newest version has entries with these paths and kinds, without references."""
    found = [
        DatasetEntry(path, kind, {"part": f"sha256:{number:064x}"}, ()) for number, (path, kind) in enumerate(entries)
    ]
    return SimpleNamespace(
        manifest=SimpleNamespace(commit="newest"),
        versions=lambda: SimpleNamespace(entries=lambda _commit: iter(found)),
        array=None,
        tree=lambda _kind, digest: {"schema": "marey/document@1", "digest": digest},
    )


def extracted(folder: Path, *entries: tuple[str, str]) -> dict[str, str]:
    """Extract entries; return the path of each entry, as its file states it, by the path of the file."""
    written = list(extract_archive(cast(Any, archive_of(*entries)), folder))
    assert len(set(written)) == len(entries)
    return {path.relative_to(folder).as_posix(): json.loads(path.read_text())["path"] for path in written}


def test_names_that_a_file_system_takes_for_the_same_have_files_of_their_own(tmp_path: Path) -> None:
    paths = ["Walk", "walk", "caf\u00e9", "cafe\u0301", "Day/a", "day/A", "stra\u00dfe", "STRASSE"]
    found = extracted(tmp_path, *((path, "clip") for path in paths))
    assert sorted(found.values()) == sorted(paths)
    assert len({path.casefold() for path in found}) == len(paths)


@pytest.mark.parametrize("kind", ["clip", "annotation", "evaluation"])
@pytest.mark.parametrize("letter", ["x", "\u00e9", "\U0001f600"])
def test_the_longest_names_fit_into_file_names_with_their_endings(tmp_path: Path, kind: str, letter: str) -> None:
    longest = letter * 255
    found = extracted(tmp_path, (longest, kind), (longest + "2", kind), (f"{longest}/{longest}", kind))
    for path in found:
        assert path.endswith(".json")
        assert all(len(name.encode()) <= MOST_BYTES for name in path.split("/"))


def test_a_folder_with_the_name_of_a_file_takes_its_place(tmp_path: Path) -> None:
    found = extracted(tmp_path, ("a", "clip"), ("a.clip.json/b", "clip"), ("A.CLIP.JSON/c", "clip"))
    assert sorted(found.values()) == ["A.CLIP.JSON/c", "a", "a.clip.json/b"]


def test_paths_stay_in_the_folder(tmp_path: Path) -> None:
    found = extracted(tmp_path / "out", ("../../x", "clip"), ("..", "clip"), ("a/../../b", "clip"), ("/etc/c", "clip"))
    assert len(found) == 4
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
