"""Downloaded files and their names on disk."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from tests.support.scripted_server import ScriptedServer

from marey_client import embedded
from marey_client.cli import lineage
from marey_client.cli.viewing import Drawing
from marey_client.downloads import TakenPaths, download, safe_file_name, write_whole
from marey_client.poses import strips
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


def draw_clips(target: Path) -> None:
    clip: Any = None
    Drawing(target, 1, 1, 0).of_clips([(clip, 1)], None)


def draw_lineage(target: Path) -> None:
    graph: Any = None
    lineage._draw(graph, target)


@pytest.mark.parametrize("draw", [draw_clips, draw_lineage])
def test_a_picture_is_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, draw: Callable[[Path], None]
) -> None:
    target = tmp_path / "new folder" / "picture.svg"
    monkeypatch.setattr(strips, "draw_clips", lambda *_: b"first")
    monkeypatch.setattr(embedded, "draw_lineage", lambda *_: b"first")
    draw(target)
    assert target.read_bytes() == b"first"

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        draw(target)
    assert [(path, path.read_bytes()) for path in target.parent.iterdir()] == [(target, b"first")]


def test_a_pipe_gets_the_content_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_whole(pipe, "motion")
    assert os.read(reader, 100) == b"motion"
    os.close(reader)
    assert pipe.is_fifo()
