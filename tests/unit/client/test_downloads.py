"""Downloaded files and their names on disk."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer

from marey_client.downloads import TakenPaths, download, safe_file_name
from marey_server.http.streaming import attachment


def answer(file_name: str, content: bytes = b"motion") -> httpx.Response:
    return httpx.Response(200, content=content, headers={"Content-Disposition": attachment(file_name)})


def fetch(script: ScriptedServer, folder: Path, **options: Any) -> Path:
    return download(script.marey().transport, "/clips/clip_1/export", folder, name="walk.bvh", **options)


@pytest.mark.parametrize(
    "name", ["walk.bvh", "Спокойная ходьба.bvh", "50% größer.bvh", "marcheuse 🚶‍♀️.bvh", 'a "b".bvh']
)
def test_a_file_has_the_name_that_the_server_gives_it_in_any_language(
    script: ScriptedServer, tmp_path: Path, name: str
) -> None:
    script.answers = [answer(name)]
    assert fetch(script, tmp_path) == tmp_path / name.replace('"', "_")


def test_a_server_that_gives_no_name_or_a_plain_one_is_understood(script: ScriptedServer, tmp_path: Path) -> None:
    script.answers = [
        httpx.Response(200, content=b""),
        httpx.Response(200, content=b"", headers={"Content-Disposition": 'attachment; filename="run.bvh"'}),
        httpx.Response(200, content=b"", headers={"Content-Disposition": "attachment"}),
    ]
    assert [fetch(script, tmp_path).name for _ in range(3)] == ["walk.bvh", "run.bvh", "walk.bvh"]


@pytest.mark.parametrize("name", ["歩" * 250 + ".bvh", "a" * 255 + ".bvh", "ä" * 200 + "." + "b" * 100])
def test_a_name_that_no_file_system_takes_is_shortened_and_keeps_its_ending(tmp_path: Path, name: str) -> None:
    short = safe_file_name(name)
    (tmp_path / short).write_bytes(b"motion")
    assert len(short.encode()) <= 240
    assert short.endswith(".bvh") == name.endswith(".bvh")
    assert name.startswith(short.removesuffix(".bvh"))


@pytest.mark.parametrize("names", [("walk.bvh", "walk.bvh"), ("Walk.bvh", "walk.bvh"), ("a:b.bvh", "a?b.bvh")])
def test_files_of_one_download_do_not_replace_each_other(
    script: ScriptedServer, tmp_path: Path, names: tuple[str, str]
) -> None:
    script.answers = [answer(name, name.encode()) for name in names]
    beside = TakenPaths()
    first, second = (fetch(script, tmp_path, beside=beside) for _ in names)
    assert second.name == f"{Path(safe_file_name(names[1])).stem} (2).bvh"
    assert [path.read_bytes() for path in (first, second)] == [name.encode() for name in names]


def test_a_download_that_is_tried_again_keeps_its_name_and_replaces_an_older_file(
    script: ScriptedServer, tmp_path: Path
) -> None:
    (tmp_path / "walk.bvh").write_bytes(b"older")

    def breaks_off() -> Iterator[bytes]:
        yield b"mot"
        raise httpx.ReadError("connection lost")

    broken = httpx.Response(200, content=breaks_off(), headers={"Content-Disposition": attachment("walk.bvh")})
    script.answers = [broken, answer("walk.bvh")]
    assert fetch(script, tmp_path) == tmp_path / "walk.bvh"
    assert (tmp_path / "walk.bvh").read_bytes() == b"motion"
    assert [path.name for path in tmp_path.iterdir()] == ["walk.bvh"]
