"""JSON files given to commands."""

import io
import sys
from pathlib import Path

import pytest

from marey_client.cli.terminal.failures import WrongUsage
from marey_client.cli.terminal.typed_values import read_json


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"\xff\xfe\x00", "given.json is not text in UTF-8"),
        (b"", "given.json is not JSON: Expecting value"),
        (b"{", "given.json is not JSON"),
        (b"[" * 100_000, "given.json is not JSON"),
        (b"9" * 5000, "given.json is not JSON"),
    ],
)
def test_what_is_no_json_is_refused_with_the_name_of_the_file(tmp_path: Path, data: bytes, told: str) -> None:
    (tmp_path / "given.json").write_bytes(data)
    with pytest.raises(WrongUsage, match=told):
        read_json(tmp_path / "given.json")


def test_a_file_that_is_not_there_or_is_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(WrongUsage, match="nowhere cannot be read: No such file"):
        read_json(tmp_path / "nowhere")
    with pytest.raises(WrongUsage, match="cannot be read: Is a directory"):
        read_json(tmp_path)


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    (tmp_path / "given.json").write_bytes(b"\xef\xbb\xbf[1]")
    assert read_json(tmp_path / "given.json") == [1]


def test_standard_input_is_read_as_utf_8_and_may_be_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO('"é"'.encode()), encoding="latin-1"))
    assert read_json("-") == "é"
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"\xff")))
    with pytest.raises(WrongUsage, match="standard input is not text in UTF-8"):
        read_json("-")
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(WrongUsage, match="standard input is closed"):
        read_json("-")
